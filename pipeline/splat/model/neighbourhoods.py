"""Order Gaussians so that each run of a few hundred lies in a small box, for finer quantization per run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64, UInt64

from splatpipe.pipeline.splat.model.gaussians import Gaussians

_INDEX_BITS = 32


def in_neighbourhoods(
    means: Float[torch.Tensor, "n 3"], run: int, weights: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Int64[torch.Tensor, " n"]:
    """Order points by splitting them at the median of their box's longest side, recursively, down to runs.

    A k-d tree (J. L. Bentley, "Multidimensional binary search trees used for associative searching", 1975) whose halves
    hold whole runs. Unlike a space-filling curve through the whole box, it is robust to points far outside, and no run
    has jumps.

    Args:
        means: Points, finite.
        run: Points per run, except for the last one.
        weights: Factors on the side lengths, larger for axes that are quantized more coarsely.

    Returns:
        Indices of the points in that order; within a run the original order is kept. Deterministic.

    Raises:
        ValueError: if there are 2³² points or more.
    """
    if len(means) >= 1 << _INDEX_BITS:
        raise ValueError("too many points for an index of 32 bits")
    columns = np.ascontiguousarray(means.detach().numpy().astype(np.float32).T)  # in the current order
    factors = np.asarray(weights)
    order = np.arange(columns.shape[1], dtype=np.int64)
    todo = [(0, len(order))]
    while todo:
        start, end = todo.pop()
        runs = -(-(end - start) // run)
        if runs < 2:
            continue
        there = columns[:, start:end]
        sides = [float(side.max()) - float(side.min()) for side in there]
        middle = runs // 2 * run
        keys = _sortable(there[int(np.argmax(sides * factors))])
        lower = keys < np.partition(keys, middle)[middle]
        moved = np.concatenate([np.flatnonzero(lower), np.flatnonzero(~lower)])
        for column in there:
            column[:] = column[moved]
        order[start:end] = order[start:end][moved]
        todo += [(start + middle, end), (start, start + middle)]
    return torch.from_numpy(order)


def reordered(
    gaussians: Gaussians,
    order: Int64[torch.Tensor, " n"],
    rows: int,
    turn: Float64[torch.Tensor, "3 3"] | None = None,
) -> Iterator[Gaussians]:
    """Iterate over the Gaussians in an order, in pieces.

    Args:
        gaussians: All Gaussians; the pieces are copies.
        order: Their indices in order.
        rows: Gaussians per piece, except for the last one.
        turn: Rotation to another frame, if any.
    """
    nowhere = torch.zeros(3, dtype=torch.float64)
    for start in range(0, len(order), rows):
        some = order[start : start + rows]
        piece = Gaussians(*(tensor.index_select(0, some) for tensor in gaussians.tensors().values()))

        yield piece if turn is None else piece.transformed(1.0, turn, nowhere)


def _sortable(values: Float32[np.ndarray, " n"]) -> UInt64[np.ndarray, " n"]:
    """Unique integers that sort like the values; the lower bits hold the index."""
    bits = values.view(np.int32)
    ordered = np.where(bits < 0, ~bits, bits ^ np.int32(-(1 << 31))).view(np.uint32)
    return np.asarray(ordered.astype(np.uint64) << np.uint64(_INDEX_BITS) | np.arange(len(values), dtype=np.uint64))
