"""Greedy matching: the cheapest edge, then the cheapest one that shares no end with it, and so on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64


def match_cheapest(
    edges: Int64[np.ndarray, "e 2"], costs: Float64[np.ndarray, " e"], count: int
) -> Int64[np.ndarray, " m"]:
    """Compute a greedy matching without a loop over the edges.

    The greedy choice takes every edge that is the cheapest at both of its ends; once these and all edges that touch
    them are removed, others become cheapest (R. Preis, "Linear Time 1/2-Approximation Algorithm for Maximum Weighted
    Matching in General Graphs", 1999). Of equal costs the earlier edge counts as cheaper.

    Args:
        edges: Two different ends each.
        costs: Cost of each edge, not NaN.
        count: Number of vertices; all ends are below it.

    Returns:
        Indices of the matching's edges, cheapest first.
    """
    order = np.argsort(costs, kind="stable")
    left = np.arange(len(order))  # by rank
    ends = edges[order]
    taken: list[Int64[np.ndarray, " k"]] = []
    free = np.ones(count, dtype=bool)
    while len(left):
        a, b = ends[left].T
        best = np.full(count, len(order))
        np.minimum.at(best, a, left)
        np.minimum.at(best, b, left)
        chosen = left[(best[a] == left) & (best[b] == left)]
        free[ends[chosen].ravel()] = False
        taken.append(chosen)
        left = left[free[a] & free[b]]
    ranks = np.sort(np.concatenate(taken)) if taken else np.empty(0, dtype=np.int64)
    return np.asarray(order[ranks])
