"""The initial Gaussians within the cap: a start that fills it would leave density control nothing to place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from splatpipe.pipeline.splat.containers.ply import read_splat, read_splat_header
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sparse_count import sparse_count

START_SHARE = 0.5  # share of the cap that the start may fill with dense points: the rest is for detail


@dataclass(frozen=True)
class InitialGaussians:
    """The initial Gaussians.

    Attributes:
        gaussians: From sparse points first, then from dense points.
        sparse: Number of Gaussians from sparse points.
    """

    gaussians: Gaussians
    sparse: int

    @property
    def dense(self) -> int:
        """Number of Gaussians from dense points."""
        return len(self.gaussians) - self.sparse

    def within(self, cap: int) -> Gaussians:
        """The Gaussians to start with: the dense ones are thinned evenly, and above the cap the sparse ones too.

        Args:
            cap: Maximum number of Gaussians in the training.
        """
        count = started(self.sparse, self.dense, cap)
        if count == len(self.gaussians):
            return self.gaussians
        sparse = min(self.sparse, count)
        dense = count - sparse
        rows = [_evenly(self.sparse, sparse), self.sparse + _evenly(self.dense, dense)]
        return self.gaussians.select(torch.cat(rows))


def _evenly(rows: int, count: int) -> torch.Tensor:
    return torch.arange(count) * rows // max(count, 1)


def started(sparse: int, dense: int, cap: int) -> int:
    """Number of Gaussians at the start: dense ones leave room to grow, and are dropped before any sparse one.

    Args:
        sparse: Number of Gaussians from sparse points.
        dense: Number of Gaussians from dense points.
        cap: Maximum number of Gaussians in the training.
    """
    room = max(0, int(START_SHARE * cap) - sparse)
    return min(cap, sparse + min(dense, room))


def read_start(path: Path) -> InitialGaussians:
    """Read the output of `initialize`.

    Raises:
        SplatpipeError: if it is not a splat.
    """
    gaussians = read_splat(path)
    return InitialGaussians(gaussians, sparse_count(read_splat_header(path).comments, len(gaussians)))
