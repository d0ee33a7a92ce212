"""Which photos see the same, by the sparse points that they share, and how deep each of them has to look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import load_points_and_tracks

BEST_ANGLE_DEG = 10.0  # between two rays: less of it is imprecise, with more of it a place looks unlike
NARROW_DEG = 4.0  # spread of the weight below the best angle
WIDE_DEG = 10.0  # and above
LEAST_SHARED = 8  # points; two photos with fewer overlap by chance or by an edge
LEAST_POINTS = 20  # a photo with fewer has no range of depths to trust
PERCENTILES = (1.0, 99.0)  # of the depths: the few wrong points lie outside
DEEPEST = 1000.0  # the far end over the near one at most, whatever the points say
FARTHER = 10.0  # times farther than the farthest: of hills and trees behind, few points tell; a few planes more


@dataclass(frozen=True)
class SparseVisibility:
    """Which view saw which sparse point.

    Attributes:
        xyz: Positions of all points, world units, in the order of their ids.
        seen: For each view the rows of the points that it saw, ascending.
    """

    xyz: Float64[np.ndarray, "n 3"]
    seen: tuple[Int64[np.ndarray, " _"], ...]


def load_tracks(dataset: Path, names: Sequence[str]) -> SparseVisibility:
    """The finite sparse points of a dataset and the views that saw them.

    Args:
        dataset: The folder that `undistort` left.
        names: Of the views wanted, in the order wanted.

    Raises:
        StageError: if the model is broken.
    """
    points, seen = load_points_and_tracks(dataset)
    finite = np.asarray(np.isfinite(points.xyz).all(axis=1))
    return SparseVisibility(points.xyz, tuple(rows[finite[rows]] for rows in (seen[name] for name in names)))


def neighbours(tracks: SparseVisibility, cameras: Sequence[Camera], most: int) -> list[list[int]]:
    """For each view the others to compare it with, the best first.

    A shared point counts the more, the nearer the angle between its two rays is to ``BEST_ANGLE_DEG`` (the shape of the
    weight is that of Yao et al., "MVSNet", ECCV 2018, section 4.1; its constants are ours).

    Args:
        tracks: Of the same views.
        cameras: Theirs.
        most: At most so many neighbours a view.
    """
    views = np.concatenate([np.full(rows.size, view) for view, rows in enumerate(tracks.seen)] or [np.zeros(0, int)])
    rows = np.concatenate([*tracks.seen, np.zeros(0, np.int64)])
    order = np.argsort(rows, kind="stable")  # all observations of a point lie together
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
        score = np.where(shared >= LEAST_SHARED, np.bincount(others, weights, minlength=len(cameras)), 0.0)
        score[view] = 0.0
        ranked = np.argsort(-score, kind="stable")[:most]
        found.append([int(other) for other in ranked if score[other] > 0.0])
    return found


def _angle_weights(
    points: Float64[np.ndarray, "n 3"], one: Float64[np.ndarray, " 3"], others: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, " n"]:
    """How well two camera centres see a point between them, 0 to 1."""
    a, b = one - points, others - points
    across = np.linalg.norm(np.cross(a, b), axis=1)
    angle = np.degrees(np.arctan2(across, (a * b).sum(axis=1)))
    spread = np.where(angle < BEST_ANGLE_DEG, NARROW_DEG, WIDE_DEG)
    return np.asarray(np.exp(-0.5 * np.square((angle - BEST_ANGLE_DEG) / spread)))


def inverse_depths(tracks: SparseVisibility, view: int, camera: Camera, wider: float) -> tuple[float, float] | None:
    """The range of inverse depths to look at: that of the view's own points, a little nearer and much farther.

    Args:
        tracks: Of all views.
        view: Its number.
        camera: Its own.
        wider: Times nearer than the nearest points.

    Returns:
        Smallest and largest, in 1 / world units, both above 0; None where the view has too few points.
    """
    pose = camera.cam_from_world
    depths = tracks.xyz[tracks.seen[view]] @ pose[2, :3] + pose[2, 3]
    depths = depths[depths > 0.0]
    if depths.size < LEAST_POINTS:
        return None
    near, far = (float(depth) for depth in np.percentile(depths, PERCENTILES))
    return 1.0 / (far * FARTHER), wider / max(near, far / DEEPEST)
