"""How much of a splat is spent on what lies outside of a boundary: a backdrop for those who look past what counts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64

SHARE = 0.5  # Gaussians outside for each one inside
FEWEST = 5_000  # outside, however few are inside: fewer leave holes that photos fill from inside


def backdrop_limit(inside: int, cap: int | None = None) -> int:
    """The most Gaussians outside of a boundary.

    Args:
        inside: Those inside.
        cap: On all of them, of which the backdrop gets its share at most; None for none.
    """
    most = max(FEWEST, int(SHARE * inside))
    return most if cap is None else min(most, int(SHARE / (1.0 + SHARE) * cap))


def coarse_start(inside: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, " k"]:
    """Rows of points to start with: all inside and, evenly, as many of the others as a backdrop may have; in order."""
    rows, others = np.flatnonzero(inside), np.flatnonzero(~inside)
    count = min(len(others), backdrop_limit(len(rows)))
    evenly = others[np.arange(count) * len(others) // max(count, 1)]
    return np.asarray(np.sort(np.concatenate([rows, evenly])), np.int64)
