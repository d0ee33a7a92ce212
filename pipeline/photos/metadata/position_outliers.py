"""Detection of photo positions that cannot be right, given the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

METRES_PER_DEGREE = 111_195.0  # on a sphere: accurate enough to detect distant positions
FAR_M = 500.0  # nobody photographs one building with a drone from farther away
FAR_SPREADS = 20.0  # times the median distance from the middle: long corridors are valid captures, too
MIN_POSITIONS = 3  # with two, there is no telling which one is wrong


def find_misplaced(places: Mapping[str, tuple[float, float]]) -> dict[str, str]:
    """Find photos whose stated position is far from all others.

    Args:
        places: Latitude and longitude in degrees, by photo.

    Returns:
        The reason by photo, as the end of a sentence that starts with the photo's name.
    """
    if len(places) < MIN_POSITIONS:
        return {}
    degrees = np.array(list(places.values()), dtype=np.float64)
    # Longitudes about the first, as they may straddle 180°.
    relative = np.stack([degrees[:, 0], (degrees[:, 1] - degrees[0, 1] + 180.0) % 360.0 - 180.0], axis=1)
    middle = np.median(relative, axis=0)
    distances = _distances_m(relative, middle)
    limit = max(FAR_M, FAR_SPREADS * float(np.median(distances)))
    swapped = np.stack([degrees[:, 1], (degrees[:, 0] - degrees[0, 1] + 180.0) % 360.0 - 180.0], axis=1)
    mirrored = _distances_m(swapped, middle) <= limit
    wrong = {}
    for name, distance, is_mirrored in zip(places, distances, mirrored, strict=True):
        if distance > limit:
            far = f"is stated {distance / 1000.0:,.1f} km from the others"
            wrong[name] = "has latitude and longitude swapped" if is_mirrored else far
    return wrong


def median_distance_m(first: Sequence[tuple[float, float]], second: Sequence[tuple[float, float]]) -> float:
    """Median distance in metres between two sets of positions of the same photos; 0 without any.

    Args:
        first: Latitude and longitude in degrees.
        second: The same, of the other set.
    """
    if not first:
        return 0.0
    apart = np.array(first, dtype=np.float64) - np.array(second, dtype=np.float64)
    apart[:, 1] = (apart[:, 1] + 180.0) % 360.0 - 180.0
    apart[:, 1] *= np.cos(np.radians(np.array(second, dtype=np.float64)[:, 0]))
    return float(METRES_PER_DEGREE * np.median(np.hypot(apart[:, 0], apart[:, 1])))


def _distances_m(places: Float64[np.ndarray, "n 2"], middle: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, " n"]:
    """Distances in metres, along the meridian and the parallel; accurate enough to detect distant positions."""
    east = (places[:, 1] - middle[1]) * np.cos(np.radians(middle[0]))
    return np.asarray(METRES_PER_DEGREE * np.hypot(places[:, 0] - middle[0], east))
