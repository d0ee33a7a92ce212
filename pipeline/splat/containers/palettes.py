"""Vector palettes: up to 65,536 entries that stand for a million vectors, and the nearest entry to each vector.

k-means (S. Lloyd, "Least squares quantization in PCM", 1982) with inverted-file search (H. Jégou, M. Douze, C. Schmid,
"Product quantization for nearest neighbor search", 2011): the palette is divided into cells, and a vector is compared
with the entries of the cells around its own instead of all, which would take 6e12 operations per million vectors.
Matrix products run on one thread: on more they may round differently.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

ITERATIONS = 3  # each further one reduces the error by less than 1 %
_CELL_ITERATIONS = 6
_ENTRIES_A_CELL = 128
_CANDIDATES = 1024  # entries that a vector is compared with, at least
_BLOCK = 1 << 20  # numbers in a block of distances: 4 MB, which fit into the cache
_ROWS_AT_ONCE = 1 << 16
_MIN_SHARE = 1e-6  # added share of the mean error: lets rows without error be chosen, too
_HALVINGS = 100  # bisections of a factor's range, which may be wide
_MAX_FITTED = 1 << 20  # vectors that a palette is fitted to: an evenly spaced subset of more


def fit_palette(
    rows: Float[Tensor, "n d"], size: int, weights: Float[Tensor, " n"] | None = None, iterations: int = ITERATIONS
) -> tuple[Float[Tensor, "k d"], Int64[Tensor, " n"]]:
    """Fit a palette with a small sum of squared distances to all rows.

    Args:
        rows: Vectors, finite, float32 on the CPU.
        size: Maximum number of palette entries, > 0; reached if there are as many different rows.
        weights: Positive weight of each row; None for equal weights.
        iterations: Rounds of k-means.

    Returns:
        The palette, and the index of the (approximately) nearest entry to each row.
    """
    with one_thread():
        step = max(-(-len(rows) // _MAX_FITTED), 1)
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
    """Index of the (approximately) nearest palette entry to each row; `before` where none nearer is found."""
    with one_thread():
        return CellIndex.of(palette).nearest(rows, before)


def _start(rows: Float[Tensor, "n d"], weights: Float[Tensor, " n"], size: int) -> Int64[Tensor, " k"]:
    """Distinct rows to start with, their density proportional to the rows' squared distance from the mean.

    In many dimensions the optimal number of entries in a region is nearly proportional to that error (P. L. Zador,
    "Asymptotic quantization error of continuous signals and the quantization dimension", 1982).
    """
    if len(rows) <= size:
        return torch.arange(len(rows))
    errors = (weights * ((rows - rows.mean(0)) ** 2).sum(1)).double()
    errors += errors.mean() * _MIN_SHARE + torch.finfo(torch.float64).tiny
    low, high = 0.0, size / float(errors.min())
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        enough = float((errors * middle).clamp_max(1.0).sum()) >= size
        low, high = (low, middle) if enough else (middle, high)
    passed = torch.cumsum((errors * high).clamp_max(1.0), 0).floor()
    return torch.nonzero(torch.diff(passed, prepend=passed.new_zeros(1)))[:size, 0]


@dataclass(frozen=True, eq=False)
class CellIndex:
    """A palette's entries, grouped into cells of nearby entries.

    Attributes:
        entries: Palette entries, cell by cell.
        places: Index of each entry in the original palette.
        centres: Centres of the cells.
        bounds: Start of each cell's entries, and the end.
    """

    entries: Float[Tensor, "k d"]
    places: Int64[Tensor, " k"]
    centres: Float[Tensor, "c d"]
    bounds: Int64[Tensor, " c1"]

    @classmethod
    def of(cls, palette: Float[Tensor, "k d"]) -> CellIndex:
        """Build the index of a palette."""
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
        """Index of the palette entry nearest to each row, among the cells around its own and the previous entry.

        Including the previous entry makes every round of k-means at least as good as the last: an entry that stands for
        a single row may move slightly, into a cell that is not searched.
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
        """The nearer of two entries for each row."""
        distances = (((rows - self.entries[each]) ** 2).sum(1) for each in (one, other))
        return torch.where(next(distances) <= next(distances), one, other)

    def _candidates(self, cell: int) -> Int64[Tensor, " m"]:
        """Entries of as many of the nearest cells as needed."""
        near = torch.argsort(((self.centres - self.centres[cell]) ** 2).sum(1), stable=True)
        reach = torch.cumsum((self.bounds[1:] - self.bounds[:-1])[near], 0)
        cells = near[: int(torch.searchsorted(reach, _CANDIDATES)) + 1].tolist()
        return torch.cat([torch.arange(int(self.bounds[i]), int(self.bounds[i + 1])) for i in cells])


def _nearest(rows: Float[Tensor, "n d"], entries: Float[Tensor, "m d"]) -> Int64[Tensor, " n"]:
    """Index of the nearest entry by |e|² / 2 − r · e, half the squared distance up to a term of the row alone."""
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
    """Weighted means of the rows of each label; unchanged for labels without rows."""
    mass, sums = (torch.zeros(shape, dtype=torch.float64) for shape in ((len(before), 1), before.shape))
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        weight = weights[part, None].double()
        mass.index_add_(0, labels[part], weight)
        sums.index_add_(0, labels[part], rows[part] * weight)
    return torch.where(mass > 0.0, sums / mass.clamp_min(1e-30), before).to(before.dtype)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: bit-identical for any number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
