"""What training starts with, as the cap allows: a start that fills it leaves density control nothing to place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.ply import read_splat, read_splat_header
from splatpipe.pipeline.splat.sparse_count import sparse_count

START_SHARE = 0.5  # of the cap, that the start may fill with dense points: the rest is for where detail is


@dataclass(frozen=True)
class InitialGaussians:
    """The initial Gaussians.

    Attributes:
        gaussians: Those of the sparse points first, then the dense ones.
        sparse: How many are of sparse points.
    """

    gaussians: Gaussians
    sparse: int

    @property
    def dense(self) -> int:
        """How many are dense points."""
        return len(self.gaussians) - self.sparse

    def within(self, cap: int) -> Gaussians:
        """Those that training starts with: taken evenly from the dense ones, and from the sparse ones beyond the cap.

        Args:
            cap: Most Gaussians of the training.
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
    """How many Gaussians training starts with: the dense ones leave room to grow, and go before any sparse point does.

    Args:
        sparse: Gaussians of sparse points.
        dense: Those of dense points.
        cap: Most Gaussians of the training.
    """
    room = max(0, int(START_SHARE * cap) - sparse)
    return min(cap, sparse + min(dense, room))


def read_start(path: Path) -> InitialGaussians:
    """Read what `initialize` left.

    Raises:
        SplatpipeError: if it is no splat.
    """
    gaussians = read_splat(path)
    return InitialGaussians(gaussians, sparse_count(read_splat_header(path).comments, len(gaussians)))
