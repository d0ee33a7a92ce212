"""Photos that were left, placed against a finished model: a pose from points that their verified matches lead to.

A photo at the wrong place is worse than a missing one. So a pose has to hold for much of what the matches say, over the
picture, through more than one placed photo, and the pose of every second match has to explain the others as well.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float32, Float64, Int64

from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.sfm.view_graph import ViewGraph

ERROR = 0.003  # of the longer side, within which a point has to lie: COLMAP's 12 pixels of a photo of 4,000
LEAST_ERROR_PX = 4.0  # of small photos: keypoints of a coarse scale err by pixels
LEAST_INLIERS = 15  # keypoints; COLMAP's least of a pair
MANY_INLIERS = 30  # COLMAP's least of a pose
LEAST_SHARE = 0.25  # of the keypoints that lead to a point; COLMAP's least of a pose
LARGE_SHARE = 0.5  # demanded where there are few: most of what the matches say has to agree
CELLS = 4  # a side, over the picture
LEAST_CELLS = 4  # of the 16: a pose from one corner turns about it
HELD_OUT = 0.6  # of the share among every second match, which the pose of these must reach among the others
LEAST_PARTNERS = 2  # placed photos: one alone may show a twin of the place


@dataclass(frozen=True)
class PoseCorrespondences:
    """What a photo's verified matches with placed photos say it sees.

    Attributes:
        keypoints: (k,) of the photo; one may be said to see several points.
        rows: (k,) of the model's points.
        partners: (k,) the placed photo that says so; the first of them.
    """

    keypoints: Int64[np.ndarray, " k"]
    rows: Int64[np.ndarray, " k"]
    partners: Int64[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True)
class PoseEstimate:
    """Where a photo was taken.

    Attributes:
        pose: cam_from_world.
        camera: As it was calibrated, or refined on the way where the model has no photo of it.
        observations: Keypoint and point of each inlier, each keypoint once.
        share: Of the keypoints that lead to points, those that agree.
    """

    pose: pycolmap.Rigid3d
    camera: pycolmap.Camera
    observations: list[tuple[int, int]]
    share: float


def sightings(verified: ViewGraph, rows: Mapping[int, Int64[np.ndarray, " _"]], number: int) -> PoseCorrespondences:
    """Gather what leads from a photo's keypoints to points.

    Args:
        verified: The view graph.
        rows: Of placed photos, the point of each keypoint, or -1.
        number: The photo.
    """
    found: dict[tuple[int, int], int] = {}
    for partner, mine, theirs in partners_of(verified, number):
        if partner in rows:
            points = rows[partner][theirs]
            for keypoint, point in zip(mine[points >= 0].tolist(), points[points >= 0].tolist(), strict=True):
                found.setdefault((keypoint, point), partner)
    entries = np.array([(*pair, found[pair]) for pair in sorted(found)], np.int64).reshape(-1, 3)
    return PoseCorrespondences(entries[:, 0], entries[:, 1], entries[:, 2])


def partners_of(verified: ViewGraph, number: int) -> list[tuple[int, Int64[np.ndarray, " _"], Int64[np.ndarray, " _"]]]:
    """Photos that share verified matches with one: their number, its keypoints, theirs; by number."""
    found = []
    for (i, j), matches in verified.matches.items():
        if number in (i, j):
            rows = matches.astype(np.int64)
            found.append((j, rows[:, 0], rows[:, 1]) if number == i else (i, rows[:, 1], rows[:, 0]))
    return sorted(found, key=lambda entry: entry[0])


def place(
    seen: PoseCorrespondences,
    keypoints: Float32[np.ndarray, "n 2"],
    points: Float64[np.ndarray, "m 3"],
    camera: pycolmap.Camera,
    calibrated: bool,
    seed: int,
) -> PoseEstimate | None:
    """The pose of a photo; None where it is not sure.

    Args:
        seen: What it sees.
        keypoints: All of its, pixels.
        points: The model's.
        camera: Its own; refined only where it is not calibrated.
        calibrated: Whether the model tells its focal length.
        seed: Of RANSAC.
    """
    total = len(np.unique(seen.keypoints))
    if total < LEAST_INLIERS:
        return None
    places, spots = keypoints[seen.keypoints].astype(np.float64), points[seen.rows]
    limit = max(LEAST_ERROR_PX, ERROR * max(camera.width, camera.height))
    camera = copy.deepcopy(camera)
    answer = _estimate(places, spots, camera, calibrated, limit, seed)
    if answer is None:
        return None
    pose, inliers = answer
    held = len(np.unique(seen.keypoints[inliers]))
    share = held / total
    if not _enough(held, share) or not _spread(places[inliers], camera):
        return None
    if len(np.unique(seen.partners[inliers])) < LEAST_PARTNERS and not (held >= MANY_INLIERS and share >= LARGE_SHARE):
        return None
    if not _foretells(seen.keypoints, places, spots, camera, limit, seed):
        return None
    taken = dict(zip(seen.keypoints[inliers][::-1].tolist(), seen.rows[inliers][::-1].tolist(), strict=True))
    observations = sorted({row: (keypoint, row) for keypoint, row in sorted(taken.items(), reverse=True)}.values())
    return PoseEstimate(pose, camera, observations, share)


def _enough(held: int, share: float) -> bool:
    return (held >= MANY_INLIERS and share >= LEAST_SHARE) or (held >= LEAST_INLIERS and share >= LARGE_SHARE)


def _estimate(
    places: Float64[np.ndarray, "k 2"],
    spots: Float64[np.ndarray, "k 3"],
    camera: pycolmap.Camera,
    calibrated: bool,
    limit_px: float,
    seed: int,
) -> tuple[pycolmap.Rigid3d, Bool[np.ndarray, " k"]] | None:
    """COLMAP's pose from points; the camera is refined in place unless it is calibrated."""
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = limit_px
    estimation.ransac.random_seed = seed
    estimation.estimate_focal_length = not calibrated and not camera.has_prior_focal_length
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = not calibrated
    found = pycolmap.estimate_and_refine_absolute_pose(places, spots, camera, estimation, refinement)
    return None if found is None else (found["cam_from_world"], np.asarray(found["inlier_mask"], bool))


def _spread(places: Float64[np.ndarray, "k 2"], camera: pycolmap.Camera) -> bool:
    """Whether places lie in enough parts of the picture."""
    size = np.array([camera.width, camera.height], np.float64)
    cells = np.clip((places / size * CELLS).astype(int), 0, CELLS - 1)
    return len(np.unique(cells[:, 0] * CELLS + cells[:, 1])) >= LEAST_CELLS


def _foretells(
    keypoints: Int64[np.ndarray, " k"],
    places: Float64[np.ndarray, "k 2"],
    spots: Float64[np.ndarray, "k 3"],
    camera: pycolmap.Camera,
    limit_px: float,
    seed: int,
) -> bool:
    """Whether the pose of every second keypoint explains the others nearly as well, and the other way round."""
    _, order = np.unique(keypoints, return_inverse=True)
    for odd in (0, 1):
        mine = order % 2 == odd
        answer = _estimate(places[mine], spots[mine], copy.deepcopy(camera), True, limit_px, seed)
        if answer is None:
            return False
        explained = _explained(places, spots, camera, answer[0], limit_px)
        own = len(np.unique(keypoints[explained & mine])) / len(np.unique(keypoints[mine]))
        others = len(np.unique(keypoints[explained & ~mine])) / max(len(np.unique(keypoints[~mine])), 1)
        if others < HELD_OUT * own:
            return False
    return True


def _explained(
    places: Float64[np.ndarray, "k 2"],
    spots: Float64[np.ndarray, "k 3"],
    camera: pycolmap.Camera,
    pose: pycolmap.Rigid3d,
    limit_px: float,
) -> Bool[np.ndarray, " k"]:
    """Which points a pose puts where they were seen."""
    shown, _ = project_through_lens(camera, pose.matrix(), spots)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.linalg.norm(shown - places, axis=1) <= limit_px)
