"""How many Gaussians a splat may spend outside the boundary: the backdrop behind the area of interest."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64

SHARE = 0.5  # Gaussians outside for each one inside
MIN_OUTSIDE = 5_000  # outside, however few are inside: with fewer, the inside grows to fill the holes in the photos


def backdrop_limit(inside: int, cap: int | None = None) -> int:
    """The maximum number of Gaussians outside the boundary.

    Args:
        inside: Number of Gaussians inside.
        cap: Limit on all Gaussians, of which the backdrop gets at most its share; None for no limit.
    """
    most = max(MIN_OUTSIDE, int(SHARE * inside))
    return most if cap is None else min(most, int(SHARE / (1.0 + SHARE) * cap))


def coarse_start(inside: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, " k"]:
    """Rows of the points to start with, ascending: all inside, and evenly spaced others up to the backdrop's limit."""
    rows, others = np.flatnonzero(inside), np.flatnonzero(~inside)
    count = min(len(others), backdrop_limit(len(rows)))
    evenly = others[np.arange(count) * len(others) // max(count, 1)]
    return np.asarray(np.sort(np.concatenate([rows, evenly])), np.int64)
