"""Points from the rays of photos that show them, of which some may be marked wrongly."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

MAX_PAIRS = 400  # hypotheses of one point; with a third of its marks right, one pair in nine is
ROUNDS = 20
TOLERANCE = 1e-12  # of a step, relative to the point's depth
LEAST_PARALLAX_RAD = np.radians(1.0)  # below it the depth is a guess


@dataclass(frozen=True)
class Rays:
    """One point in several photos.

    Attributes:
        cam_from_world: Poses.
        rays: Undistorted image points, x/z and y/z in the camera.
        pixels: Derivative of the photo's pixels by them, at the marks: with the lens, as marks err in pixels.
    """

    cam_from_world: Float64[np.ndarray, "n 3 4"]
    rays: Float64[np.ndarray, "n 2"]
    pixels: Float64[np.ndarray, "n 2 2"]

    def __len__(self) -> int:
        return len(self.rays)

    def only(self, chosen: Bool[np.ndarray, " n"]) -> Rays:
        """Some of them."""
        return Rays(self.cam_from_world[chosen], self.rays[chosen], self.pixels[chosen])

    def residuals_px(self, point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "n 2"]:
        """Where the photos would show the point less where they do; infinite behind a camera."""
        seen = self.cam_from_world[:, :, :3] @ point + self.cam_from_world[:, :, 3]
        ahead = seen[:, 2] > 0.0
        depth = np.where(ahead, seen[:, 2], 1.0)[:, None]
        residuals = np.einsum("nij,nj->ni", self.pixels, seen[:, :2] / depth - self.rays)
        return np.where(ahead[:, None], residuals, np.inf)

    def jacobian(self, point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "n 2 3"]:
        """Of the residuals by the point."""
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
        """Of the cameras, in the world."""
        return np.asarray(-np.einsum("nji,nj->ni", self.cam_from_world[:, :, :3], self.cam_from_world[:, :, 3]))


@dataclass(frozen=True)
class TriangulatedPoint:
    """A point and what its rays say of it.

    Attributes:
        xyz: In the world.
        covariance: Of it, for marks of one pixel.
        agree: Which rays meet there.
        residuals_px: Of all of them.
    """

    xyz: Float64[np.ndarray, " 3"]
    covariance: Float64[np.ndarray, "3 3"]
    agree: Bool[np.ndarray, " n"]
    residuals_px: Float64[np.ndarray, "n 2"]


def triangulate(rays: Rays, tolerance_px: float) -> TriangulatedPoint | None:
    """The point where most of the rays meet: every pair is a hypothesis, the best is refined on those that agree.

    Args:
        rays: At least two.
        tolerance_px: Rays that miss the point by more take no part.

    Returns:
        None where no two rays meet ahead of their cameras at an angle that tells the depth.
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
    for _ in range(3):  # those that agree with the refined point
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
    """The point nearest to the rays; None where they are parallel, head-on or not, or meet behind a camera."""
    directions, centres = rays.directions(), rays.centres()
    if np.arccos(np.clip(np.abs(directions @ directions.T), 0.0, 1.0)).max() < LEAST_PARALLAX_RAD:
        return None
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    ahead = np.einsum("ni,ni->n", point - centres, directions) > 0.0
    return np.asarray(point) if ahead.all() else None


def _refined(rays: Rays, point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    """Least squares of the reprojection errors (Gauss-Newton)."""
    depth = float(np.linalg.norm(rays.centres() - point, axis=1).min())
    for _ in range(ROUNDS):
        residuals = rays.residuals_px(point)
        if not np.isfinite(residuals).all():
            break
        jacobian = rays.jacobian(point).reshape(-1, 3)
        step = np.linalg.lstsq(jacobian, -residuals.ravel(), rcond=None)[0]
        length = float(np.linalg.norm(step))
        step *= min(1.0, 0.5 * depth / max(length, 1e-300))
        point = point + step
        if length < TOLERANCE * depth:
            break
    return point
