"""How well a model explains the verified matches: each pair of photos is checked against the estimated cameras.

Most verified matches are not observations of the model, so they reveal what its reprojection error cannot: unplaced
photos explain nothing, a bend leaves the matches across it unexplained, and a wrong lens most matches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.sfm.model.pixel_tolerance_scale import pixel_tolerance_scale
from splatpipe.pipeline.sfm.model.structure import observed_points
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

EXPLAINED_PX = 4.0  # distance from the epipolar line that verification itself allows; more in large photos
MIN_MATCHES = 15  # matches of a pair that counts as contradicting; COLMAP's own minimum for a pair
MIN_PARALLAX = 2.0  # times EXPLAINED_PX: minimum parallax of a match for the sign of its depth to be meaningful

Rays = Float64[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Agreement:
    """Agreement of each verified pair of photos with a model; one row per pair, sorted by image ids.

    Attributes:
        pairs: Image ids, the smaller first.
        placed: Whether the model has both photos.
        matches: Number of verified matches.
        explained: How many of them are within ``EXPLAINED_PX`` of the epipolar line and in front of both cameras.
        closeness: Sum over the matches of a weight that is 1 on the line and falls to 0 at ``EXPLAINED_PX`` from it.
        held_out: Number of verified matches that are not two observations of the same model point.
        held_out_explained: How many of those are explained.
        median_px: Median distance from the epipolar line; infinite for a match behind a camera; NaN if not placed.
        bounds_px: ``EXPLAINED_PX``, wider in large photos.
    """

    pairs: Int64[np.ndarray, "n 2"]
    placed: Bool[np.ndarray, " n"]
    matches: Int64[np.ndarray, " n"]
    explained: Int64[np.ndarray, " n"]
    closeness: Float64[np.ndarray, " n"]
    held_out: Int64[np.ndarray, " n"]
    held_out_explained: Int64[np.ndarray, " n"]
    median_px: Float64[np.ndarray, " n"]
    bounds_px: Float64[np.ndarray, " n"]

    @property
    def score(self) -> float:
        """How many of all verified matches the model explains and how closely, 0 to 1.

        Pairs are weighted by the square root of their matches: a bend shows in wide-baseline pairs, which have few.
        """
        weights = np.sqrt(self.matches)
        total = float(weights.sum())
        return float((weights * self.closeness / np.maximum(self.matches, 1)).sum()) / total if total > 0.0 else 0.0


def contradicting(agreement: Agreement) -> Bool[np.ndarray, " n"]:
    """Return the mask of pairs of placed photos for which the model explains less than half of the matches."""
    enough = agreement.placed & (agreement.matches >= MIN_MATCHES)
    return np.asarray(enough & (2 * agreement.explained < agreement.matches))


def compare(
    model: pycolmap.Reconstruction,
    verified: ViewGraph,
    instead: Mapping[int, Float64[np.ndarray, "3 4"]] | None = None,
    rays: Mapping[int, Rays] | None = None,
) -> Agreement:
    """Check every verified pair against a model.

    Args:
        model: With the keypoints of ``verified``.
        verified: The view graph.
        instead: Other poses of its photos, camera from world, in a frame of their own, to which no points belong.
        rays: ``rays_of`` the same, if they are known.
    """
    placed = sorted(model.reg_image_ids())
    rays = rays_of(model, verified) if rays is None else rays
    poses = instead or {number: model.images[number].cam_from_world().matrix() for number in placed}
    points = {
        number: _points(None if instead else model.images[number], len(verified.keypoints[number])) for number in rays
    }
    pairs = sorted(verified.matches)
    rows = np.zeros((len(pairs), 4), np.int64)
    closeness = np.zeros(len(pairs))
    median = np.full(len(pairs), np.nan)
    bounds = np.full(len(pairs), EXPLAINED_PX)
    both = np.array([i in rays and j in rays for i, j in pairs], bool)
    for row, (i, j) in enumerate(pairs):
        found = verified.matches[i, j]
        rows[row, 0] = rows[row, 2] = len(found)
        if not both[row]:
            continue
        cameras = model.images[i].camera, model.images[j].camera
        focal = (cameras[0].mean_focal_length() + cameras[1].mean_focal_length()) / 2.0
        bounds[row] = EXPLAINED_PX * pixel_tolerance_scale(cameras)
        bound = bounds[row] / focal
        errors = epipolar_errors(rays[i][found[:, 0]], rays[j][found[:, 1]], poses[i], poses[j], bound)
        good = errors <= bound
        closeness[row] = np.maximum(1.0 - errors / bound, 0.0).sum()
        own = (points[i][found[:, 0]] == points[j][found[:, 1]]) & (points[i][found[:, 0]] >= 0)
        rows[row, 1:] = good.sum(), (~own).sum(), (good & ~own).sum()
        median[row] = float(np.sort(errors)[len(errors) // 2]) * focal  # half of them may be infinite
    matches, explained, held_out, held_out_explained = rows.T
    listed = np.array(pairs, np.int64).reshape(-1, 2)
    return Agreement(listed, both, matches, explained, closeness, held_out, held_out_explained, median, bounds)


def epipolar_errors(
    one: Rays,
    two: Rays,
    one_from_world: Float64[np.ndarray, "3 4"],
    two_from_world: Float64[np.ndarray, "3 4"],
    noise: float,
) -> Float64[np.ndarray, " n"]:
    """Compute the distances of matches from their epipolar lines in two calibrated photos.

    The Sampson distance (Hartley and Zisserman, Multiple View Geometry, 11.4.3); infinite for points behind a camera
    if their parallax exceeds the noise.

    Args:
        one: Matched keypoints in the first photo, undistorted, in units of the focal length.
        two: The same in the second.
        one_from_world: Pose of the first photo.
        two_from_world: Pose of the second photo.
        noise: Keypoint noise, in units of the focal length.

    Returns:
        Distances in units of the focal length.
    """
    turn = two_from_world[:, :3] @ one_from_world[:, :3].T
    shift = two_from_world[:, 3] - turn @ one_from_world[:, 3]
    length = float(np.linalg.norm(shift))
    shift = shift / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    cross = np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]])
    essential = cross @ turn
    first, second = np.column_stack([one, np.ones(len(one))]), np.column_stack([two, np.ones(len(two))])
    lines, back = first @ essential.T, second @ essential
    off = np.einsum("ij,ij->i", second, lines)
    slope = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    errors = np.abs(off) / np.sqrt(np.maximum(slope, 1e-18))
    turned = first @ turn.T
    normal = np.stack(
        [
            turned[:, 1] * second[:, 2] - turned[:, 2] * second[:, 1],
            turned[:, 2] * second[:, 0] - turned[:, 0] * second[:, 2],
            turned[:, 0] * second[:, 1] - turned[:, 1] * second[:, 0],
        ],
        axis=1,
    )
    ahead_one = -np.einsum("ij,ij->i", second @ cross.T, normal)
    ahead_two = -np.einsum("ij,ij->i", lines, normal)
    angle = np.linalg.norm(normal, axis=1) / (np.linalg.norm(turned, axis=1) * np.linalg.norm(second, axis=1))
    behind = (np.minimum(ahead_one, ahead_two) < 0.0) & (angle > MIN_PARALLAX * noise)
    # Where a lens's distortion cannot be inverted, there is no ray.
    return np.where(behind | ~np.isfinite(errors), np.inf, errors)


def rays_of(model: pycolmap.Reconstruction, verified: ViewGraph) -> dict[int, Rays]:
    """Return the keypoints of each placed photo with matches, undistorted, in units of the focal length."""
    result = {}
    for number in sorted(
        set(model.reg_image_ids()).intersection(number for pair in verified.matches for number in pair)
    ):
        places = np.asarray(verified.keypoints[number], np.float64).reshape(-1, 2)
        result[number] = np.asarray(model.images[number].camera.cam_from_img(places), np.float64).reshape(-1, 2)
    return result


def _points(image: pycolmap.Image | None, count: int) -> Int64[np.ndarray, " n"]:
    """Return the id of the point that each keypoint of a photo observes, -1 for none."""
    result = np.full(count, -1, np.int64)
    if image is not None:
        keypoints, ids = observed_points(image)
        result[keypoints] = ids
    return result
