"""Neighbouring photos by shared sparse points, and the depth range to search in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks

BEST_ANGLE_DEG = 10.0  # between two rays: smaller angles are imprecise, and at larger ones appearance differs too much
NARROW_DEG = 4.0  # spread of the weight below the best angle
WIDE_DEG = 10.0  # and above
MIN_SHARED = 8  # points; two photos with fewer overlap by chance or only at an edge
MIN_POINTS = 20  # a photo with fewer has no reliable depth range
DEPTH_PERCENTILES = (1.0, 99.0)  # percentiles that bound a photo's depths: without the few wrong points
MAX_DEPTH_RATIO = 1000.0  # far over near end of a photo's depth range, at most
FAR_MARGIN = 10.0  # depth searched over that of the farthest points: hills and trees behind have few


@dataclass(frozen=True)
class SparseVisibility:
    """Which view observes which sparse point.

    Attributes:
        xyz: Positions of all points, world units, in the order of their ids.
        seen: For each view the rows of the points that it observes, ascending.
    """

    xyz: Float64[np.ndarray, "n 3"]
    seen: tuple[Int64[np.ndarray, " _"], ...]


def load_tracks(dataset: Path, names: Sequence[str]) -> SparseVisibility:
    """Load a dataset's sparse points and which of the finite ones each view observes.

    Args:
        dataset: The folder that `undistort` wrote.
        names: Names of the views, in the order wanted.

    Raises:
        StageError: if the model is broken.
    """
    points, seen = load_points_and_tracks(dataset)
    finite = np.asarray(np.isfinite(points.xyz).all(axis=1))
    return SparseVisibility(points.xyz, tuple(rows[finite[rows]] for rows in (seen[name] for name in names)))


def neighbours(tracks: SparseVisibility, cameras: Sequence[Camera], most: int) -> list[list[int]]:
    """For each view, the indices of the views to match it with, best first.

    A shared point counts more the nearer the angle between its two rays is to ``BEST_ANGLE_DEG`` (the weight has the
    shape of Yao et al., "MVSNet", ECCV 2018, section 4.1; its constants are ours).

    Args:
        tracks: Sparse points of the same views.
        cameras: Cameras of the views.
        most: Maximum number of neighbours per view.
    """
    views = np.concatenate([np.full(rows.size, view) for view, rows in enumerate(tracks.seen)] or [np.zeros(0, int)])
    rows = np.concatenate([*tracks.seen, np.zeros(0, np.int64)])
    order = np.argsort(rows, kind="stable")  # groups all observations of a point
    views, begins = views[order], np.searchsorted(rows[order], np.arange(len(tracks.xyz) + 1))
    centres = np.array([camera.centre() for camera in cameras]).reshape(-1, 3)
    found = []
    for view, own in enumerate(tracks.seen):
        lengths = begins[own + 1] - begins[own]
        starts = np.repeat(begins[own] - (np.cumsum(lengths) - lengths), lengths)
        others = views[starts + np.arange(lengths.sum())]
        points = np.repeat(own, lengths)
        weights = _angle_weights(tracks.xyz[points], centres[view], centres[others])
        shared = np.bincount(others, minlength=len(cameras))
        score = np.where(shared >= MIN_SHARED, np.bincount(others, weights, minlength=len(cameras)), 0.0)
        score[view] = 0.0
        by_score = np.argsort(-score, kind="stable")[:most]
        found.append([int(other) for other in by_score if score[other] > 0.0])
    return found


def _angle_weights(
    points: Float64[np.ndarray, "n 3"], one: Float64[np.ndarray, " 3"], others: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, " n"]:
    """Weight of each point by the angle between the rays from two camera centres, 0 to 1."""
    a, b = one - points, others - points
    across = np.linalg.norm(np.cross(a, b), axis=1)
    angle = np.degrees(np.arctan2(across, (a * b).sum(axis=1)))
    spread = np.where(angle < BEST_ANGLE_DEG, NARROW_DEG, WIDE_DEG)
    return np.asarray(np.exp(-0.5 * np.square((angle - BEST_ANGLE_DEG) / spread)))


def inverse_depths(tracks: SparseVisibility, view: int, camera: Camera, wider: float) -> tuple[float, float] | None:
    """The range of inverse depths to search: that of the view's own points, a little nearer and much farther.

    Args:
        tracks: Sparse points of all views.
        view: Index of the view.
        camera: The view's camera.
        wider: How many times nearer than the nearest points to search.

    Returns:
        Smallest and largest inverse depth, in 1 / world units, both above 0; None if the view has too few points.
    """
    pose = camera.cam_from_world
    depths = tracks.xyz[tracks.seen[view]] @ pose[2, :3] + pose[2, 3]
    depths = depths[depths > 0.0]
    if depths.size < MIN_POINTS:
        return None
    near, far = (float(depth) for depth in np.percentile(depths, DEPTH_PERCENTILES))
    return 1.0 / (far * FAR_MARGIN), wider / max(near, far / MAX_DEPTH_RATIO)
