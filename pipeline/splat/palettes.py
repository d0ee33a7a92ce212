"""Palettes of vectors: up to 65,536 of them that stand for a million, and the nearest one to each vector.

k-means (S. Lloyd, "Least squares quantization in PCM", 1982) with the search of inverted files (H. Jégou, M. Douze,
C. Schmid, "Product quantization for nearest neighbor search", 2011): the palette is divided into cells, and a vector is
compared with the entries of the cells about its own, instead of with all of them, which would be 6e12 operations a
million vectors. Matrix products are done on one thread: on more they may round differently.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

ITERATIONS = 3  # more makes the error smaller by less than a hundredth each
_CELL_ITERATIONS = 6
_ENTRIES_A_CELL = 128
_CANDIDATES = 1024  # entries that a vector is compared with, at least
_BLOCK = 1 << 20  # numbers in a block of distances: 4 MB, which stay in the cache
_ROWS_AT_ONCE = 1 << 16
_LEAST_SHARE = 1e-6  # of the mean error: of rows without any error, too, a start is made
_HALVINGS = 100  # of a factor's range, which may be wide
_MOST_FITTED = 1 << 20  # vectors that a palette is fitted to: of more, evenly spaced ones


def fit_palette(
    rows: Float[Tensor, "n d"], size: int, weights: Float[Tensor, " n"] | None = None, iterations: int = ITERATIONS
) -> tuple[Float[Tensor, "k d"], Int64[Tensor, " n"]]:
    """Vectors whose squares of distances to all rows sum up to little.

    Args:
        rows: Finite, float32 on the CPU.
        size: Most vectors in the palette, > 0; as many where there are as many different rows.
        weights: Of each row, positive; alike without.
        iterations: Rounds of k-means.

    Returns:
        The palette, and which of its vectors is nearest to each row, or nearly.
    """
    with one_thread():
        step = max(-(-len(rows) // _MOST_FITTED), 1)
        fitted = rows[::step].contiguous()
        weights = torch.ones(len(fitted)) if weights is None else weights[::step].contiguous()
        palette = fitted[_start(fitted, weights, size)]
        labels = CellIndex.of(palette).nearest(fitted)
        for _ in range(iterations):
            palette = _means(fitted, weights, labels, palette)
            labels = CellIndex.of(palette).nearest(fitted, labels)
        if step > 1:
            all_labels = torch.zeros(len(rows), dtype=torch.int64)
            all_labels[::step] = labels
            labels = CellIndex.of(palette).nearest(rows, all_labels)
        return palette, labels


def nearest_entries(
    rows: Float[Tensor, "n d"], palette: Float[Tensor, "k d"], before: Int64[Tensor, " n"]
) -> Int64[Tensor, " n"]:
    """Which of a palette's vectors is nearest to each row, or nearly; `before` where none is found that is nearer."""
    with one_thread():
        return CellIndex.of(palette).nearest(rows, before)


def _start(rows: Float[Tensor, "n d"], weights: Float[Tensor, " n"], size: int) -> Int64[Tensor, " k"]:
    """Which rows to begin with: the more of them, the more error there would be without, and none of them twice.

    In many dimensions the best number of entries in a region is nearly proportional to that (P. L. Zador, "Asymptotic
    quantization error of continuous signals and the quantization dimension", 1982).
    """
    if len(rows) <= size:
        return torch.arange(len(rows))
    errors = (weights * ((rows - rows.mean(0)) ** 2).sum(1)).double()
    errors += errors.mean() * _LEAST_SHARE + torch.finfo(torch.float64).tiny
    low, high = 0.0, size / float(errors.min())
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        enough = float((errors * middle).clamp_max(1.0).sum()) >= size
        low, high = (low, middle) if enough else (middle, high)
    passed = torch.cumsum((errors * high).clamp_max(1.0), 0).floor()
    return torch.nonzero(torch.diff(passed, prepend=passed.new_zeros(1)))[:size, 0]


@dataclass(frozen=True, eq=False)
class CellIndex:
    """A palette's entries in cells of what is near one another.

    Attributes:
        entries: Of the palette, cell after cell.
        places: Of each entry in the palette that was given.
        centres: Of the cells.
        bounds: Where each cell's entries begin, and the end.
    """

    entries: Float[Tensor, "k d"]
    places: Int64[Tensor, " k"]
    centres: Float[Tensor, "c d"]
    bounds: Int64[Tensor, " c1"]

    @classmethod
    def of(cls, palette: Float[Tensor, "k d"]) -> CellIndex:
        """Divide a palette."""
        count = max(len(palette) // _ENTRIES_A_CELL, 1)
        centres = palette[torch.arange(count) * len(palette) // count].clone()
        ones = torch.ones(len(palette))
        for _ in range(_CELL_ITERATIONS):
            centres = _means(palette, ones, _nearest(palette, centres), centres)
        cells = _nearest(palette, centres)
        places = torch.argsort(cells, stable=True)
        bounds = torch.searchsorted(cells[places], torch.arange(count + 1))
        return cls(palette[places], places, centres, bounds)

    def nearest(self, rows: Float[Tensor, "n d"], before: Int64[Tensor, " n"] | None = None) -> Int64[Tensor, " n"]:
        """Which of the palette is nearest to each row, among the cells about its own and the one that was before.

        That one is what makes every round of k-means better than the last: an entry that stands for one row alone moves
        off it a little, into a cell that may not be looked into.
        """
        cells = _nearest(rows, self.centres)
        order = torch.argsort(cells, stable=True)
        bounds = torch.searchsorted(cells[order], torch.arange(len(self.centres) + 1)).tolist()
        known = None if before is None else torch.argsort(self.places)[before]
        found = torch.empty(len(rows), dtype=torch.int64)
        for cell in range(len(self.centres)):
            those = order[bounds[cell] : bounds[cell + 1]]
            if len(those):
                candidates = self._candidates(cell)
                nearest = candidates[_nearest(rows[those], self.entries[candidates])]
                found[those] = nearest if known is None else self._nearer(rows[those], known[those], nearest)
        return self.places[found]

    def _nearer(
        self, rows: Float[Tensor, "n d"], one: Int64[Tensor, " n"], other: Int64[Tensor, " n"]
    ) -> Int64[Tensor, " n"]:
        """Of two entries a row."""
        distances = (((rows - self.entries[each]) ** 2).sum(1) for each in (one, other))
        return torch.where(next(distances) <= next(distances), one, other)

    def _candidates(self, cell: int) -> Int64[Tensor, " m"]:
        """Entries of the nearest cells, as many as needed."""
        near = torch.argsort(((self.centres - self.centres[cell]) ** 2).sum(1), stable=True)
        reach = torch.cumsum((self.bounds[1:] - self.bounds[:-1])[near], 0)
        cells = near[: int(torch.searchsorted(reach, _CANDIDATES)) + 1].tolist()
        return torch.cat([torch.arange(int(self.bounds[i]), int(self.bounds[i + 1])) for i in cells])


def _nearest(rows: Float[Tensor, "n d"], entries: Float[Tensor, "m d"]) -> Int64[Tensor, " n"]:
    """By |e|² / 2 − r · e, which is half the square of the distance but for what is the row's own."""
    halves, columns = (entries * entries).sum(1) / 2, entries.T.contiguous()
    found = torch.empty(len(rows), dtype=torch.int64)
    step = max(_BLOCK // len(entries), 1)
    for start in range(0, len(rows), step):
        part = slice(start, start + step)
        found[part] = torch.addmm(halves, rows[part], columns, alpha=-1.0).argmin(1)
    return found


def _means(
    rows: Float[Tensor, "n d"], weights: Float[Tensor, " n"], labels: Int64[Tensor, " n"], before: Float[Tensor, "k d"]
) -> Float[Tensor, "k d"]:
    """Weighted means of the rows of each label; as before where there are none."""
    mass, sums = (torch.zeros(shape, dtype=torch.float64) for shape in ((len(before), 1), before.shape))
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        weight = weights[part, None].double()
        mass.index_add_(0, labels[part], weight)
        sums.index_add_(0, labels[part], rows[part] * weight)
    return torch.where(mass > 0.0, sums / mass.clamp_min(1e-30), before).to(before.dtype)


@contextmanager
def one_thread() -> Iterator[None]:
    """Matrix products on one thread: the same bits for any number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
