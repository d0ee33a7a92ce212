"""Merging trained blocks: each Gaussian belongs to the block whose cell contains its centre.

A block trains its cell and a margin, so that Gaussians at its border are trained with those on the other side; only
the cell of its result is used. Blocks are merged in order of their numbers, whatever the order of training. Models are
read one at a time, once to count and once to write.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.cells.partition import Partition


def owned(partition: Partition, block: int, gaussians: Gaussians) -> Gaussians:
    """The Gaussians of a block's model that lie in its own cell, in their order.

    Args:
        partition: The cells.
        block: The block's number.
        gaussians: The trained model: cell, margin, and Gaussians that moved out of both.
    """
    owners = partition.owners(gaussians.means.detach().double().numpy(force=True))
    return gaussians.select(torch.from_numpy(np.flatnonzero(owners == block)))


def count_and_degree(partition: Partition, read: Callable[[int], Gaussians]) -> tuple[int, int]:
    """The number of Gaussians of the whole scene, and their SH degree.

    Args:
        partition: The cells.
        read: As for ``own_pieces``.

    Raises:
        ValueError: if the SH degrees differ.
    """
    found = [_count(partition, block, read(block)) for block in range(len(partition.cells))]
    if len({degree for _count_of_own, degree in found}) != 1:
        raise ValueError("blocks are of several SH degrees")
    return sum(count for count, _degree in found), found[0][1]


def own_pieces(partition: Partition, read: Callable[[int], Gaussians]) -> Iterator[Gaussians]:
    """The whole scene, piece by piece; each model is freed before the next is read.

    Args:
        partition: The cells.
        read: Reads a block's trained model by number, without frozen Gaussians.
    """
    for block in range(len(partition.cells)):
        yield from (owned(partition, block, piece) for piece in read(block).pieces())


def _count(partition: Partition, block: int, model: Gaussians) -> tuple[int, int]:
    """Number of a model's Gaussians in its own cell, and its SH degree."""
    means = (piece.means.detach().double().numpy(force=True) for piece in model.pieces())
    return sum(int((partition.owners(each) == block).sum()) for each in means), model.sh_degree
