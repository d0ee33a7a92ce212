"""Estimate the overlap of photos from positions, angles and focal lengths alone.

Each photo's rays are cast to where they may end: to the ground, and to where the views of the photos cross, such as the
building at the centre of an orbit. The share of these points inside another image, weighted by the similarity of the
two views, says whether the pair is worth matching.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int

GRID = 5  # rays across an image, and as many down
# times the height above ground or the distance to the crossing: anything beyond is small in the image
MAX_DISTANCE_RATIO = 4.0
MIN_HEIGHT_M = 2.0
CROSSING_DEG = 15.0  # minimum angle between views to determine where they cross
CROSSING_MISS = 0.3  # gap between two view axes over the distance: beyond it they do not point at the same thing
MIN_CROSSINGS = 3
MARGIN = 0.1  # slack on an image's border over half its size: angles are off by a few degrees
ALIKE_DEG, UNLIKE_DEG = 15.0, 90.0  # SIFT matching is unaffected up to the first angle, and fails beyond the second


@dataclass(frozen=True)
class StatedPoses:
    """Stated poses and fields of view of photos; all NaN for a photo whose pose is unknown.

    Attributes:
        centres_m: East, north, up relative to any origin.
        enu_from_camera: Rotations; camera x right, y down, z forward.
        half_size: Tangents of half the field of view, across and down.
        ground_m: Height of the ground below each photo, in the same axes.
        noise_m: Relative standard deviation of the positions.
    """

    centres_m: Float64[np.ndarray, "n 3"]
    enu_from_camera: Float64[np.ndarray, "n 3 3"]
    half_size: Float64[np.ndarray, "n 2"]
    ground_m: Float64[np.ndarray, " n"]
    noise_m: float = 0.0

    def __len__(self) -> int:
        return len(self.centres_m)

    def known(self) -> Bool[np.ndarray, " n"]:
        """Return the mask of photos whose pose is known."""
        return np.asarray(np.isfinite(self.centres_m).all(axis=1) & np.isfinite(self.axes).all(axis=1))

    @property
    def axes(self) -> Float64[np.ndarray, "n 3"]:
        """Unit viewing directions."""
        return np.asarray(self.enu_from_camera[:, :, 2])


def overlaps(views: StatedPoses, candidates: int) -> dict[tuple[int, int], float]:
    """Estimate the share of two photos' points that both see, weighted by the similarity of the views.

    Args:
        views: The photos.
        candidates: Number of nearest photos to consider for each photo.

    Returns:
        From 0 (exclusive) to 1, the mean of both directions, by pair (i, j), i < j; pairs without overlap are omitted.
    """
    known = np.flatnonzero(views.known())
    crossings = crossing_distances(views)
    shares: dict[tuple[int, int], float] = {}
    for i in known.tolist():
        distances = ((views.centres_m[known] - views.centres_m[i]) ** 2).sum(axis=1)
        near = known[np.argsort(distances, kind="stable")[: candidates + 1]]
        points = _points(views, i, float(crossings[i]))
        for j, share in zip(near.tolist(), _share_seen(views, i, near, points).tolist(), strict=True):
            if j != i and share > 0.0:
                pair = (min(i, j), max(i, j))
                shares[pair] = shares.get(pair, 0.0) + share / 2.0
    return shares


def crossing_distances(views: StatedPoses) -> Float64[np.ndarray, " n"]:
    """Return the median distance along each photo's axis to where other views cross it; NaN if too few do."""
    distances = np.full(len(views), np.nan)
    axes = views.axes
    for i in range(len(views)):
        cosines = axes @ axes[i]
        sines2 = np.maximum(1.0 - cosines**2, 1e-12)
        base = views.centres_m - views.centres_m[i]
        along, back = base @ axes[i], np.einsum("nk,nk->n", base, axes)
        own = (along - cosines * back) / sines2
        other = (cosines * along - back) / sines2
        gap = np.linalg.norm(base + other[:, None] * axes - own[:, None] * axes[i], axis=1)
        crosses = np.abs(cosines) < np.cos(np.radians(CROSSING_DEG))
        crosses &= (own > MIN_HEIGHT_M) & (other > MIN_HEIGHT_M) & (gap < CROSSING_MISS * np.minimum(own, other))
        if np.count_nonzero(crosses) >= MIN_CROSSINGS:
            distances[i] = np.median(own[crosses])
    return distances


def _points(views: StatedPoses, i: int, crossing_m: float) -> Float64[np.ndarray, "m 3"]:
    """Return the points where the rays of a photo may end."""
    steps = (np.arange(GRID) + 0.5) / GRID * 2.0 - 1.0
    across, down = np.meshgrid(steps * views.half_size[i, 0], steps * views.half_size[i, 1])
    rays = np.stack([across.ravel(), down.ravel(), np.ones(GRID * GRID)], axis=1) @ views.enu_from_camera[i].T
    height = max(float(views.centres_m[i, 2] - views.ground_m[i]), MIN_HEIGHT_M)
    reach = MAX_DISTANCE_RATIO * (height if np.isnan(crossing_m) else max(height, crossing_m))
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0.0, height / np.maximum(-rays[:, 2], 1e-9), np.inf)
    depths = to_ground[to_ground <= reach]
    points = [views.centres_m[i] + depths[:, None] * rays[to_ground <= reach]]
    if not np.isnan(crossing_m):
        in_front = to_ground > crossing_m  # the other rays hit the ground first
        points.append(views.centres_m[i] + crossing_m * rays[in_front])
    elif not len(depths):
        points.append(views.centres_m[i] + reach / 2.0 * rays)
    return np.concatenate(points)


def _share_seen(
    views: StatedPoses, i: int, others: Int[np.ndarray, " k"], points: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, " k"]:
    """Return the weighted share of photo i's points that each of the others sees."""
    to_point = points[None] - views.centres_m[others][:, None]  # (k, m, 3)
    in_camera = np.einsum("kmx,kxc->kmc", to_point, views.enu_from_camera[others])
    half_size = views.half_size[others][:, None]
    distances = np.linalg.norm(to_point, axis=2)
    slack = MARGIN + views.noise_m / np.maximum(distances, 1.0)[:, :, None] / half_size
    depth = np.maximum(in_camera[:, :, 2:], 0.0)
    inside = (np.abs(in_camera[:, :, :2]) <= (1.0 + slack) * half_size * depth).all(axis=2)
    own = points - views.centres_m[i]
    own_distances = np.linalg.norm(own, axis=1)
    cosines = np.einsum("kmx,mx->km", to_point, own) / np.maximum(distances * own_distances, 1e-9)
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    alike = np.clip((UNLIKE_DEG - angles) / (UNLIKE_DEG - ALIKE_DEG), 0.0, 1.0)
    scale = np.minimum(distances, own_distances) / np.maximum(np.maximum(distances, own_distances), 1e-9)
    return np.asarray((inside * alike * scale).mean(axis=1))
