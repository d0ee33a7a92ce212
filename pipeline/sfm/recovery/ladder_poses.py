"""Place leftover photos in a finished model: resection from the points that their verified matches lead to.

A misplaced photo is worse than a missing one. So a pose must agree with a large share of the matches, spread over the
image and over more than one placed photo, and a pose from half of the keypoints must explain the other half as well.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float32, Float64, Int64

from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

MAX_ERROR_SHARE = 0.003  # reprojection tolerance as a share of the longer side: COLMAP's 12 pixels in a photo of 4,000
MIN_ERROR_PX = 4.0  # minimum tolerance for small photos: coarse-scale keypoints are off by pixels
MIN_INLIERS = 15  # keypoints; COLMAP's minimum for a pair
MANY_INLIERS = 30  # COLMAP's minimum for a pose
MIN_SHARE = 0.25  # inliers over the keypoints that lead to a point; COLMAP's minimum for a pose
LARGE_SHARE = 0.5  # required where inliers are few: most matches must agree
CELLS = 4  # grid cells along each side of the image
MIN_CELLS = 4  # grid cells with inliers, out of 16: a pose from one corner alone can pivot about it
HELD_OUT = 0.6  # a pose from half of the keypoints must explain this fraction of its own inlier share in the other half
MIN_PARTNERS = 2  # placed photos: a single one may show a look-alike of the place


@dataclass(frozen=True)
class PoseCorrespondences:
    """2D-3D correspondences of a photo, from its verified matches with placed photos.

    Attributes:
        keypoints: (k,) keypoint indices of the photo; one may correspond to several points.
        rows: (k,) rows of the model's points.
        partners: (k,) the placed photo that gives the correspondence; the first if there are several.
    """

    keypoints: Int64[np.ndarray, " k"]
    rows: Int64[np.ndarray, " k"]
    partners: Int64[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True)
class PoseEstimate:
    """Estimated pose of a photo.

    Attributes:
        pose: cam_from_world.
        camera: As calibrated, or refined with the pose if the model has no other photo of it.
        observations: Keypoint and point of each inlier, each keypoint once.
        share: Share of the keypoints with correspondences that are inliers.
    """

    pose: pycolmap.Rigid3d
    camera: pycolmap.Camera
    observations: list[tuple[int, int]]
    share: float


def sightings(verified: ViewGraph, rows: Mapping[int, Int64[np.ndarray, " _"]], number: int) -> PoseCorrespondences:
    """Collect the correspondences between a photo's keypoints and the model's points.

    Args:
        verified: The view graph.
        rows: For each placed photo that matches it, the point row of each keypoint, or -1.
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
    """List the photos with verified matches to one, sorted by number: their number, its keypoints, their keypoints."""
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
    """Estimate the pose of a photo; None if it is uncertain.

    Args:
        seen: Its correspondences.
        keypoints: All of its keypoints, pixels.
        points: The model's points.
        camera: Its camera; a copy is refined if it is not calibrated.
        calibrated: Whether the model determines its focal length.
        seed: For RANSAC.
    """
    total = len(np.unique(seen.keypoints))
    if total < MIN_INLIERS:
        return None
    places, spots = keypoints[seen.keypoints].astype(np.float64), points[seen.rows]
    limit = max(MIN_ERROR_PX, MAX_ERROR_SHARE * max(camera.width, camera.height))
    camera = copy.deepcopy(camera)
    answer = _estimate(places, spots, camera, calibrated, limit, seed)
    if answer is None:
        return None
    pose, inliers = answer
    held = len(np.unique(seen.keypoints[inliers]))
    share = held / total
    if not _enough(held, share) or not _spread(places[inliers], camera):
        return None
    if len(np.unique(seen.partners[inliers])) < MIN_PARTNERS and not (held >= MANY_INLIERS and share >= LARGE_SHARE):
        return None
    if not _cross_validates(seen.keypoints, places, spots, camera, limit, seed):
        return None
    taken = dict(zip(seen.keypoints[inliers][::-1].tolist(), seen.rows[inliers][::-1].tolist(), strict=True))
    observations = sorted({row: (keypoint, row) for keypoint, row in sorted(taken.items(), reverse=True)}.values())
    return PoseEstimate(pose, camera, observations, share)


def _enough(held: int, share: float) -> bool:
    return (held >= MANY_INLIERS and share >= MIN_SHARE) or (held >= MIN_INLIERS and share >= LARGE_SHARE)


def _estimate(
    places: Float64[np.ndarray, "k 2"],
    spots: Float64[np.ndarray, "k 3"],
    camera: pycolmap.Camera,
    calibrated: bool,
    limit_px: float,
    seed: int,
) -> tuple[pycolmap.Rigid3d, Bool[np.ndarray, " k"]] | None:
    """Run COLMAP's absolute pose estimation; the camera is refined in place unless it is calibrated."""
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = limit_px
    estimation.ransac.random_seed = seed
    estimation.estimate_focal_length = not calibrated and not camera.has_prior_focal_length
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = not calibrated
    found = pycolmap.estimate_and_refine_absolute_pose(places, spots, camera, estimation, refinement)
    return None if found is None else (found["cam_from_world"], np.asarray(found["inlier_mask"], bool))


def _spread(places: Float64[np.ndarray, "k 2"], camera: pycolmap.Camera) -> bool:
    """Whether the keypoints lie in enough grid cells of the image."""
    size = np.array([camera.width, camera.height], np.float64)
    cells = np.clip((places / size * CELLS).astype(int), 0, CELLS - 1)
    return len(np.unique(cells[:, 0] * CELLS + cells[:, 1])) >= MIN_CELLS


def _cross_validates(
    keypoints: Int64[np.ndarray, " k"],
    places: Float64[np.ndarray, "k 2"],
    spots: Float64[np.ndarray, "k 3"],
    camera: pycolmap.Camera,
    limit_px: float,
    seed: int,
) -> bool:
    """Cross-validate: whether a pose from either half of the keypoints explains the other half nearly as well."""
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
    """Return the mask of points whose reprojection error under a pose is within the limit."""
    projected, _ = project_through_lens(camera, pose.matrix(), spots)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.linalg.norm(projected - places, axis=1) <= limit_px)
