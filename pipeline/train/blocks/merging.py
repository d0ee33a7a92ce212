"""Trained blocks put together: each Gaussian belongs to one block, by where its centre lies.

A block trains its cell and a margin, so that what is at its border has seen what is on the other side; of its result
only the cell is taken. What lies in no cell is the coarse model's. The blocks come in the order of their numbers,
whatever the order in which they were trained.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.partition import BACKDROP, Partition


def owned(partition: Partition, block: int, gaussians: Gaussians) -> Gaussians:
    """Those of a block's, or of the backdrop's, Gaussians that are its own, in their order.

    Args:
        partition: The cells.
        block: Its number, or `BACKDROP`.
        gaussians: What it trained: cell and margin, and what wandered off; for the backdrop the coarse model.
    """
    owners = partition.owners(gaussians.means.detach().double().numpy(force=True))
    return gaussians.select(torch.from_numpy(np.flatnonzero(owners == block)))


def merged(partition: Partition, coarse: Gaussians, trained: Mapping[int, Gaussians]) -> Gaussians:
    """The whole scene.

    Args:
        partition: The cells.
        coarse: The coarse model, for what lies in no cell.
        trained: What each block trained, without what it drew frozen.

    Raises:
        ValueError: if a block is missing or unknown, or the SH degrees differ.
    """
    if sorted(trained) != list(range(len(partition.cells))):
        raise ValueError(f"blocks {sorted(trained)} of {len(partition.cells)} are there")
    parts = [owned(partition, block, trained[block]) for block in range(len(partition.cells))]
    return Gaussians.concat([*parts, owned(partition, BACKDROP, coarse)])
