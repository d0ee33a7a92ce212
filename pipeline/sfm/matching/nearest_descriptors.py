"""Matching of two photos' descriptors: mutual nearest neighbours that pass the ratio test.

A photo's descriptors are grouped into cells around words of its own. Another photo's descriptors are compared only with
the cells of their words; what looks like a match there is compared with everything, in both directions. So every match
is one that comparing everything with everything would give; a descriptor whose neighbour is in none of its cells has
none (1 % of the matches).

Descriptors and words are whole numbers of 8 bits: their products stay below 2**23, exact in float32 whatever the order
of summation. So matches are the same for any linear algebra library and instruction set.
Of equal neighbours the first is taken; the ratio test then rejects it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8, UInt32

from splatpipe.pipeline.sfm.pairing.retrieval import assign, refine_words

UNIT = 512 * 512  # the product of a descriptor with itself, up to rounding
# COLMAP's tests with whole numbers. The squared distance of two descriptors is 2 * (UNIT - product).
RATIO_FRACTION = (16, 25)  # 0.8 squared: the nearest must be closer than 0.8 times the second nearest
LEAST_PRODUCT = UNIT - math.floor(0.49 * UNIT / 2)  # a distance of at most 0.7 times 512
NEAR_WORDS = 6  # searched words of about 70 in a photo of 5,000: cells overlap, a neighbour is rarely outside
WORD_SAMPLE = 2048  # descriptors that a photo's words are learnt from
WORD_ROUNDS = 5  # k-means iterations for the words; they need not converge
BLOCK = 512  # rows that are multiplied at once: 16 MB for 8,000 columns


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

    values: Float32[np.ndarray, "n 128"]
    words: Float32[np.ndarray, "words 128"]
    members: Int64[np.ndarray, " m"]
    starts: Int64[np.ndarray, " bounds"]
    gathered: Float32[np.ndarray, "m 128"]


@dataclass(frozen=True)
class Nearest:
    """The nearest and the second nearest of each query: the nearest's row, both products (0 if there is none)."""

    rows: Int64[np.ndarray, " n"]
    best: Float32[np.ndarray, " n"]
    second: Float32[np.ndarray, " n"]

    def clear(self) -> Bool[np.ndarray, " n"]:
        """Return which are close enough, and clearly closer than the second nearest."""
        numerator, denominator = RATIO_FRACTION
        closer = denominator * np.maximum(UNIT - self.best, 0.0) < numerator * (UNIT - self.second)
        return np.asarray((self.best >= LEAST_PRODUCT) & closer)


def group_descriptors(descriptors: UInt8[np.ndarray, "n 128"]) -> DescriptorCells:
    """Group a photo's descriptors into about as many cells as each then has members, before cells overlap."""
    values = descriptors.astype(np.float32)
    count = len(values)
    if count == 0:
        return DescriptorCells(values, values, np.zeros(0, np.int64), np.zeros(1, np.int64), values)
    sample = values[:: -(-count // WORD_SAMPLE)]
    chosen = round(math.sqrt(count))
    words = refine_words(sample, sample[np.arange(chosen) * len(sample) // chosen], WORD_ROUNDS)
    closeness = 2.0 * (values @ words.T) - (words * words).sum(axis=1)
    near = min(NEAR_WORDS, chosen)
    least = np.partition(closeness, chosen - near, axis=1)[:, chosen - near, None]
    inside, members = np.nonzero((closeness >= least).T)  # more than so many where words are equally near
    starts = np.concatenate([[0], np.cumsum(np.bincount(inside, minlength=chosen))])
    return DescriptorCells(values, words, members, starts, values[members])


def match_descriptors(first: UInt8[np.ndarray, "n 128"], second: DescriptorCells) -> UInt32[np.ndarray, "m 2"]:
    """Return matches (row in the first, row in the second photo) in the order of the first's rows."""
    if min(len(first), len(second.values)) == 0:
        return np.zeros((0, 2), np.uint32)
    values = first.astype(np.float32)
    found = _nearest_in_cells(values, second)
    here = np.flatnonzero(found.clear())
    there = found.rows[here]
    columns, of = np.unique(there, return_inverse=True)
    back = nearest(second.values[columns], values)
    mutual = back.clear()[of] & (back.rows[of] == here)
    here, there = here[mutual], there[mutual]
    again = nearest(values[here], second.values)
    kept = again.clear() & (again.rows == there)
    return np.stack([here[kept], there[kept]], axis=1).astype(np.uint32)


def nearest(queries: Float32[np.ndarray, "n 128"], values: Float32[np.ndarray, "m 128"]) -> Nearest:
    """Compare each query with all values (at least one)."""
    count = len(queries)
    found = Nearest(np.zeros(count, np.int64), np.zeros(count, np.float32), np.zeros(count, np.float32))
    for start in range(0, count, BLOCK):
        block = slice(start, start + BLOCK)
        products = queries[block] @ values.T
        rows = products.argmax(axis=1)
        each = np.arange(len(rows))
        found.rows[block] = rows
        found.best[block] = products[each, rows]
        products[each, rows] = 0.0
        found.second[block] = products.max(axis=1)
    return found


def _nearest_in_cells(queries: Float32[np.ndarray, "n 128"], cells: DescriptorCells) -> Nearest:
    """Compare each query with the members of its word's cell."""
    count = len(queries)
    labels = assign(queries, cells.words)
    order = np.argsort(labels, kind="stable")
    ends = np.cumsum(np.bincount(labels, minlength=len(cells.words)))
    found = Nearest(np.zeros(count, np.int64), np.zeros(count, np.float32), np.zeros(count, np.float32))
    for rows, start, end in zip(np.split(order, ends[:-1]), cells.starts[:-1], cells.starts[1:], strict=True):
        if len(rows) and end > start:
            inside = nearest(queries[rows], cells.gathered[start:end])
            found.rows[rows] = cells.members[start + inside.rows]
            found.best[rows] = inside.best
            found.second[rows] = inside.second
    return found
