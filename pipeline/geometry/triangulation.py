"""Robust triangulation of points from marks in photos, some of which may be wrong."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

MAX_PAIRS = 400  # hypotheses per point; with a third of its marks right, one pair in nine is right
MAX_ROUNDS = 20
STEP_TOLERANCE = 1e-12  # length of a step over the point's depth at which iterations end
MIN_PARALLAX_RAD = np.radians(1.0)  # below it the depth is a guess


@dataclass(frozen=True)
class Rays:
    """One point in several photos.

    Attributes:
        cam_from_world: Camera poses.
        rays: Undistorted image points, x/z and y/z in the camera frame.
        pixels: Derivative of the photo's pixels with respect to ``rays`` at the marks, including lens distortion,
            because marks err in pixels.
    """

    cam_from_world: Float64[np.ndarray, "n 3 4"]
    rays: Float64[np.ndarray, "n 2"]
    pixels: Float64[np.ndarray, "n 2 2"]

    def __len__(self) -> int:
        return len(self.rays)

    def only(self, chosen: Bool[np.ndarray, " n"]) -> Rays:
        """The chosen rays."""
        return Rays(self.cam_from_world[chosen], self.rays[chosen], self.pixels[chosen])

    def residuals_px(self, point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "n 2"]:
        """Reprojection errors of a point, projected minus marked; infinite behind a camera."""
        seen = self.cam_from_world[:, :, :3] @ point + self.cam_from_world[:, :, 3]
        ahead = seen[:, 2] > 0.0
        depth = np.where(ahead, seen[:, 2], 1.0)[:, None]
        residuals = np.einsum("nij,nj->ni", self.pixels, seen[:, :2] / depth - self.rays)
        return np.where(ahead[:, None], residuals, np.inf)

    def jacobian(self, point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "n 2 3"]:
        """Jacobian of the residuals with respect to the point."""
        rotations = self.cam_from_world[:, :, :3]
        seen = rotations @ point + self.cam_from_world[:, :, 3]
        in_camera = np.zeros((len(self), 2, 3))
        in_camera[:, 0, 0] = in_camera[:, 1, 1] = 1.0 / seen[:, 2]
        in_camera[:, :, 2] = -seen[:, :2] / seen[:, 2:] ** 2
        return np.asarray(self.pixels @ in_camera @ rotations)

    def directions(self) -> Float64[np.ndarray, "n 3"]:
        """Unit vectors from the cameras to the point, in the world."""
        along = np.concatenate([self.rays, np.ones((len(self), 1))], axis=1)
        along = np.einsum("nji,nj->ni", self.cam_from_world[:, :, :3], along)
        return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))

    def centres(self) -> Float64[np.ndarray, "n 3"]:
        """Projection centres in the world."""
        return np.asarray(-np.einsum("nji,nj->ni", self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]))


@dataclass(frozen=True)
class TriangulatedPoint:
    """A triangulated point and how its rays agree.

    Attributes:
        xyz: World position.
        covariance: Covariance of the position for marks with a standard deviation of one pixel.
        agree: Which rays are inliers.
        residuals_px: Reprojection errors of all rays.
    """

    xyz: Float64[np.ndarray, " 3"]
    covariance: Float64[np.ndarray, "3 3"]
    agree: Bool[np.ndarray, " n"]
    residuals_px: Float64[np.ndarray, "n 2"]


def triangulate(rays: Rays, tolerance_px: float) -> TriangulatedPoint | None:
    """Triangulate the point where most rays meet: pairs are hypotheses, the best is refined on its inliers.

    Args:
        rays: At least two.
        tolerance_px: Rays with a larger reprojection error are left out.

    Returns:
        The point; None if no two rays meet in front of their cameras with enough parallax to fix the depth.
    """
    pairs = list(itertools.combinations(range(len(rays)), 2))
    chosen = pairs[:: max(1, len(pairs) // MAX_PAIRS)]
    best: tuple[int, float] = (0, 0.0)
    agree = np.zeros(len(rays), dtype=bool)
    for pair in chosen:
        picked = np.zeros(len(rays), dtype=bool)
        picked[list(pair)] = True
        point = _meeting(rays.only(picked))
        if point is None:
            continue
        errors = np.linalg.norm(rays.residuals_px(point), axis=1)
        near = errors <= tolerance_px
        score = (int(near.sum()), -float(errors[near].sum()))
        if near[list(pair)].all() and score > best:
            best, agree = score, near
    if agree.sum() < 2:
        return None
    point = _meeting(rays.only(agree))
    for _ in range(3):  # recompute the inliers at the refined point
        if point is None:
            return None
        point = _refined(rays.only(agree), point)
        near = np.linalg.norm(rays.residuals_px(point), axis=1) <= tolerance_px
        if near.sum() < 2:
            return None
        if (near == agree).all():
            break
        agree = near
    if point is None:
        return None
    jacobian = rays.only(agree).jacobian(point).reshape(-1, 3)
    return TriangulatedPoint(point, np.linalg.pinv(jacobian.T @ jacobian), agree, rays.residuals_px(point))


def _meeting(rays: Rays) -> Float64[np.ndarray, " 3"] | None:
    """The point nearest to the rays; None if they are parallel or antiparallel, or meet behind a camera."""
    directions, centres = rays.directions(), rays.centres()
    if np.arccos(np.clip(np.abs(directions @ directions.T), 0.0, 1.0)).max() < MIN_PARALLAX_RAD:
        return None
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    ahead = np.einsum("ni,ni->n", point - centres, directions) > 0.0
    return np.asarray(point) if ahead.all() else None


def _refined(rays: Rays, point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    """The point that minimizes the squared reprojection errors (Gauss-Newton)."""
    depth = float(np.linalg.norm(rays.centres() - point, axis=1).min())
    for _ in range(MAX_ROUNDS):
        residuals = rays.residuals_px(point)
        if not np.isfinite(residuals).all():
            break
        jacobian = rays.jacobian(point).reshape(-1, 3)
        step = np.linalg.lstsq(jacobian, -residuals.ravel(), rcond=None)[0]
        length = float(np.linalg.norm(step))
        step *= min(1.0, 0.5 * depth / max(length, 1e-300))
        point = point + step
        if length < STEP_TOLERANCE * depth:
            break
    return point
