"""Trained blocks put together: each Gaussian belongs to one block, by where its centre lies.

A block trains its cell and a margin, so that what is at its border has seen what is on the other side; of its result
only the cell is taken. The blocks come in the order of their numbers, whatever the order in which they were trained.
Models are read one at a time, to be counted and to be written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.partition import Partition


def owned(partition: Partition, block: int, gaussians: Gaussians) -> Gaussians:
    """Those of a block's Gaussians that are its own, in their order.

    Args:
        partition: The cells.
        block: Its number.
        gaussians: What it trained: cell and margin, and what wandered off.
    """
    owners = partition.owners(gaussians.means.detach().double().numpy(force=True))
    return gaussians.select(torch.from_numpy(np.flatnonzero(owners == block)))


def counted(partition: Partition, read: Callable[[int], Gaussians]) -> tuple[int, int]:
    """The Gaussians of the whole scene, and their SH degree.

    Args:
        partition: The cells.
        read: As of ``own_pieces``.

    Raises:
        ValueError: if the SH degrees differ.
    """
    found = [_count(partition, block, read(block)) for block in range(len(partition.cells))]
    if len({degree for _count_of_own, degree in found}) != 1:
        raise ValueError("blocks are of several SH degrees")
    return sum(count for count, _degree in found), found[0][1]


def own_pieces(partition: Partition, read: Callable[[int], Gaussians]) -> Iterator[Gaussians]:
    """The whole scene, piece by piece; each model is let go before the next is read.

    Args:
        partition: The cells.
        read: Gives what the block of a number trained, without what it drew frozen.
    """
    for block in range(len(partition.cells)):
        yield from (owned(partition, block, piece) for piece in read(block).pieces())


def _count(partition: Partition, block: int, model: Gaussians) -> tuple[int, int]:
    """A model's own Gaussians, and its degree."""
    means = (piece.means.detach().double().numpy(force=True) for piece in model.pieces())
    return sum(int((partition.owners(each) == block).sum()) for each in means), model.sh_degree
