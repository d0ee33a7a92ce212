"""Matching of two photos' descriptors: mutual nearest neighbours that pass the ratio test.

A photo's descriptors are grouped into cells around words of its own. Another photo's descriptors are compared only with
the cells of their words; what looks like a match there is compared with everything, in both directions. So every match
is one that comparing everything with everything would give; a descriptor whose neighbour is in none of its cells has
none (1 % of the matches).

Descriptors and words are whole numbers of 8 bits, whose products are exact. So matches are the same for any linear
algebra library and instruction set.
Of equal neighbours the first is taken; the ratio test then rejects it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt8, UInt32

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.sfm.pairing.retrieval import assign, refine_words

UNIT = 512 * 512  # the product of a descriptor with itself, up to rounding
# COLMAP's tests with whole numbers. The squared distance of two descriptors is 2 * (UNIT - product).
RATIO_FRACTION = (16, 25)  # 0.8 squared: the nearest must be closer than 0.8 times the second nearest
LEAST_PRODUCT = UNIT - math.floor(0.49 * UNIT / 2)  # a distance of at most 0.7 times 512
NEAR_WORDS = 6  # searched words of about 70 in a photo of 5,000: cells overlap, a neighbour is rarely outside
WORD_SAMPLE = 2048  # descriptors that a photo's words are learnt from
WORD_ROUNDS = 5  # k-means iterations for the words; they need not converge


@dataclass(frozen=True)
class DescriptorCells:
    """A photo's descriptors, grouped.

    Attributes:
        values: All of them.
        words: Centres of the cells.
        members: Rows of ``values``, cell after cell; each is in the cells of its nearest words.
        starts: Where each cell's members start, and the total.
        gathered: ``values[members]``.
    """

    values: UInt8[np.ndarray, "n 128"]
    words: Float32[np.ndarray, "words 128"]
    members: Int64[np.ndarray, " m"]
    starts: Int64[np.ndarray, " bounds"]
    gathered: UInt8[np.ndarray, "m 128"]


@dataclass(frozen=True)
class Nearest:
    """The nearest and the second nearest of each query: the nearest's row, both products (0 if there is none)."""

    rows: Int64[np.ndarray, " n"]
    best: Int32[np.ndarray, " n"]
    second: Int32[np.ndarray, " n"]

    def clear(self) -> Bool[np.ndarray, " n"]:
        """Return which are close enough, and clearly closer than the second nearest."""
        numerator, denominator = RATIO_FRACTION
        closer = denominator * np.maximum(UNIT - self.best, 0) < numerator * (UNIT - self.second)
        return np.asarray((self.best >= LEAST_PRODUCT) & closer)


def group_descriptors(descriptors: UInt8[np.ndarray, "n 128"]) -> DescriptorCells:
    """Group a photo's descriptors into about as many cells as each then has members, before cells overlap."""
    count = len(descriptors)
    if count == 0:
        none = np.zeros((0, 128), np.float32)
        return DescriptorCells(descriptors, none, np.zeros(0, np.int64), np.zeros(1, np.int64), descriptors)
    values = descriptors.astype(np.float32)
    sample = values[:: -(-count // WORD_SAMPLE)]
    chosen = round(math.sqrt(count))
    words = refine_words(sample, sample[np.arange(chosen) * len(sample) // chosen], WORD_ROUNDS)
    closeness = 2.0 * (values @ words.T) - (words * words).sum(axis=1)
    near = min(NEAR_WORDS, chosen)
    least = np.partition(closeness, chosen - near, axis=1)[:, chosen - near, None]
    inside, members = np.nonzero((closeness >= least).T)  # more than so many where words are equally near
    starts = np.concatenate([[0], np.cumsum(np.bincount(inside, minlength=chosen))])
    return DescriptorCells(descriptors, words, members, starts, descriptors[members])


def match_descriptors(first: UInt8[np.ndarray, "n 128"], second: DescriptorCells) -> UInt32[np.ndarray, "m 2"]:
    """Return matches (row in the first, row in the second photo) in the order of the first's rows."""
    if min(len(first), len(second.values)) == 0:
        return np.zeros((0, 2), np.uint32)
    found = _nearest_in_cells(first, second)
    here = np.flatnonzero(found.clear())
    there = found.rows[here]
    columns, of = np.unique(there, return_inverse=True)
    back = nearest(second.values[columns], first)
    mutual = back.clear()[of] & (back.rows[of] == here)
    here, there = here[mutual], there[mutual]
    again = nearest(first[here], second.values)
    kept = again.clear() & (again.rows == there)
    return np.stack([here[kept], there[kept]], axis=1).astype(np.uint32)


def nearest(queries: UInt8[np.ndarray, "n 128"], values: UInt8[np.ndarray, "m 128"]) -> Nearest:
    """Compare each query with all values."""
    return _compared(queries, np.array([0, len(queries)]), values, np.array([0, len(values)]))


def _nearest_in_cells(queries: UInt8[np.ndarray, "n 128"], cells: DescriptorCells) -> Nearest:
    """Compare each query with the members of its word's cell."""
    labels = assign(queries.astype(np.float32), cells.words)
    order = np.argsort(labels, kind="stable")
    bounds = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=len(cells.words)))])
    inside = _compared(queries[order], bounds, cells.gathered, cells.starts)
    back = np.argsort(order, kind="stable")
    is_empty = cells.starts[labels] == cells.starts[labels + 1]
    rows = cells.members[np.where(is_empty, 0, cells.starts[labels] + inside.rows[back])]
    return Nearest(rows, inside.best[back], inside.second[back])


def _compared(
    queries: UInt8[np.ndarray, "n 128"],
    query_bounds: Int64[np.ndarray, " bounds"],
    values: UInt8[np.ndarray, "m 128"],
    value_bounds: Int64[np.ndarray, " bounds"],
) -> Nearest:
    """Compare queries with values, group by group; the rows count from their group's start."""
    count = len(queries)
    found = Nearest(np.zeros(count, np.int64), np.zeros(count, np.int32), np.zeros(count, np.int32))
    pair = (np.ascontiguousarray(queries), query_bounds), (np.ascontiguousarray(values), value_bounds)
    _native.nearest_descriptors(*pair, (found.rows, found.best, found.second))
    return found
