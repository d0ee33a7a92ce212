"""Find two groups of cameras that disagree: the sign of a bent or ghosted model.

Photos are the nodes of a graph whose edges are matches that the model explains (positive) and matches that it
contradicts (negative). The cut is searched along the eigenvector of the signed Laplacian's smallest eigenvalue (Kunegis
et al., Spectral analysis of signed graphs for clustering, SDM 2010), whose signs split the photos into two groups that
agree internally and contradict each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.sfm.judging.agreement import Agreement

MAX_MATCHES = 200  # cap per pair: thousands of matches prove only that two photos are neighbours
MIN_GROUP_PHOTOS = 2  # photos; a single one is a wrong photo, not a bend
MIN_GROUP_SHARE = 0.02  # least share of the photos in a group
MAX_DENSE_PHOTOS = 600  # photos up to which all eigenvectors are computed
POWER_ITERATIONS = 300  # power iterations for an eigenvector above MAX_DENSE_PHOTOS
DIGITS = 8  # decimals of the eigenvector that are kept: the last ones vary with the number of threads
MIN_MATCHES_APART = 1.0  # minimum for the consistent matches across a cut, to avoid dividing by zero


@dataclass(frozen=True)
class GraphCut:
    """The two groups of photos that disagree most.

    Attributes:
        group: Image ids of the smaller group.
        ratio: Ratio of contradicting to consistent matches between the groups.
    """

    group: tuple[int, ...] = ()
    ratio: float = 0.0


def find_cut(agreement: Agreement, contradicts: Bool[np.ndarray, " n"]) -> GraphCut:
    """Return the cut of the placed photos with the largest ratio; empty if nothing contradicts."""
    numbers = np.unique(agreement.pairs[agreement.placed])
    if not contradicts.any() or len(numbers) < 2 * MIN_GROUP_PHOTOS:
        return GraphCut()
    return cut_between(*_weights(agreement, contradicts, numbers), numbers)


def cut_between(
    agree: Float64[np.ndarray, "m m"],
    against: Float64[np.ndarray, "m m"],
    numbers: Int64[np.ndarray, " m"],
    floor: float = MIN_MATCHES_APART,
) -> GraphCut:
    """Return the cut with the largest ratio of what speaks against the two groups' places to what agrees.

    Args:
        agree: Symmetric.
        against: Likewise.
        numbers: Image ids of the rows.
        floor: Least weight of what agrees between two groups.
    """
    best = GraphCut()
    least = max(MIN_GROUP_PHOTOS, int(np.ceil(MIN_GROUP_SHARE * len(numbers))))
    for order in (np.argsort(_eigenvector(agree, against), kind="stable"), *_detached(agree, against)):
        held, contra = _crossing(agree, order), _crossing(against, order)
        ratios = contra / np.maximum(held, floor)
        sizes = np.arange(1, len(order))
        ratios[(sizes < least) | (len(order) - sizes < least)] = 0.0
        at = int(np.argmax(ratios))
        if ratios[at] > best.ratio:
            first, second = order[: at + 1], order[at + 1 :]
            group = first if len(first) <= len(second) else second
            best = GraphCut(tuple(sorted(int(numbers[row]) for row in group)), float(ratios[at]))
    return best


def _weights(
    agreement: Agreement, contradicts: Bool[np.ndarray, " n"], numbers: np.ndarray
) -> tuple[Float64[np.ndarray, "m m"], Float64[np.ndarray, "m m"]]:
    """Return the consistent and the contradicting matches between photos as symmetric matrices."""
    agree = np.zeros((len(numbers), len(numbers)))
    against = np.zeros_like(agree)
    rows = np.searchsorted(numbers, agreement.pairs[agreement.placed])
    explained = np.minimum(agreement.explained[agreement.placed], MAX_MATCHES)
    left = np.minimum((agreement.matches - agreement.explained)[agreement.placed], MAX_MATCHES)
    wrong = contradicts[agreement.placed]
    for matrix, values in ((agree, explained), (against, np.where(wrong, left, 0))):
        np.add.at(matrix, (rows[:, 0], rows[:, 1]), values)
        np.add.at(matrix, (rows[:, 1], rows[:, 0]), values)
    return agree, against


def _eigenvector(agree: Float64[np.ndarray, "m m"], against: Float64[np.ndarray, "m m"]) -> Float64[np.ndarray, " m"]:
    """Return the eigenvector of the smallest eigenvalue of the signed Laplacian, normalised by degree."""
    degree = np.maximum((agree + against).sum(axis=1), 1.0)
    signed = (agree - against) / np.sqrt(degree[:, None] * degree[None, :])
    if len(signed) <= MAX_DENSE_PHOTOS:
        vector = np.linalg.eigh(signed)[1][:, -1]
    else:
        vector = np.cos(np.arange(len(signed), dtype=np.float64))  # any start that is not an eigenvector
        for _ in range(POWER_ITERATIONS):
            vector = vector + signed @ vector
            vector /= np.linalg.norm(vector)
    vector = vector / np.sqrt(degree)
    largest = np.abs(vector).max()
    vector = np.round(vector / largest, DIGITS)
    return np.asarray(vector * np.sign(vector[np.argmax(np.abs(vector))]))


def _detached(agree: Float64[np.ndarray, "m m"], against: Float64[np.ndarray, "m m"]) -> list[np.ndarray]:
    """Return orders that start with the most contradicted photos, to find a small ghosted group."""
    held, contra = agree.sum(axis=1), against.sum(axis=1)
    return [np.argsort(-contra / np.maximum(held + contra, 1.0), kind="stable")]


def _crossing(weights: Float64[np.ndarray, "m m"], order: np.ndarray) -> Float64[np.ndarray, " k"]:
    """Return the weight between the first k photos of an order and the others, for k from 1 to all but one."""
    ordered = weights[np.ix_(order, order)]
    before = np.tril(ordered, -1).sum(axis=1)  # to those that came earlier
    after = np.triu(ordered, 1).sum(axis=1)
    return np.asarray(np.cumsum(after - before)[:-1])
