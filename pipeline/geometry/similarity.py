"""Similarity transforms (scale, rotation, translation) and their least-squares fit between two point sets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.equality import equal_fields

SIMILARITY = 7  # unknowns of a small change: a rotation vector, the log scale, the position of the points' mean
RANK_TOLERANCE = 1e-12  # an eigenvalue below this, relative to the largest, is rounding: nothing determines its axis


@dataclass(frozen=True, eq=False)
class Similarity:
    """``x_target = scale * rotation @ x_source + translation``.

    Attributes:
        scale: Positive scale factor.
        rotation: (3, 3), proper rotation.
        translation: (3,), in the target's units.
    """

    scale: float
    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, " 3"]

    def __eq__(self, other: object) -> bool:
        return equal_fields(self, other)

    __hash__ = None  # type: ignore[assignment]  # equal by their values, which include arrays

    @staticmethod
    def identity() -> Similarity:
        """The identity transform."""
        return Similarity(1.0, np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: Float64[np.ndarray, "4 4"]) -> Similarity:
        """The similarity of a homogeneous matrix.

        Raises:
            ValueError: if it is not a similarity: sheared, mirrored or not finite.
        """
        linear = matrix[:3, :3]
        determinant = float(np.linalg.det(linear)) if np.isfinite(matrix).all() else 0.0
        if determinant <= 0.0 or not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
            raise ValueError("not a similarity: mirrored, degenerate or not affine")
        scale = determinant ** (1.0 / 3.0)
        rotation = linear / scale
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
            raise ValueError("not a similarity: sheared")
        return Similarity(scale, rotation, matrix[:3, 3].copy())

    def matrix(self) -> Float64[np.ndarray, "4 4"]:
        """The homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Transform points from the source to the target frame."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.translation)

    def inverse(self) -> Similarity:
        """The transform from target to source."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def compose(self, first: Similarity) -> Similarity:
        """``first``, then this one: ``(self.compose(first)).matrix() == self.matrix() @ first.matrix()``."""
        return Similarity(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.scale * (self.rotation @ first.translation) + self.translation,
        )

    def camera_pose(self, cam_from_source: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """A rigid camera pose relative to the target instead of the source frame; depths grow by the scale."""
        pose = np.eye(4)
        pose[:3, :3] = cam_from_source[:3, :3] @ self.rotation.T
        pose[:3, 3] = self.scale * cam_from_source[:3, 3] - pose[:3, :3] @ self.translation
        return pose


def fit_similarity(
    source: Float64[np.ndarray, "*batch n 3"],
    target: Float64[np.ndarray, "*batch n 3"],
    weights: Float64[np.ndarray, "*batch n"],
) -> tuple[Float64[np.ndarray, "*batch"], Float64[np.ndarray, "*batch 3 3"], Float64[np.ndarray, "*batch 3"]]:
    """Weighted least-squares similarity in closed form (Umeyama, PAMI 1991, eqs. 40 to 42); also for a batch.

    Returns:
        Scale, rotation (always proper), translation.
    """
    weights = weights[..., None] / weights.sum(axis=-1)[..., None, None]
    source_mean, target_mean = (weights * source).sum(axis=-2), (weights * target).sum(axis=-2)
    source_from_mean, target_from_mean = source - source_mean[..., None, :], target - target_mean[..., None, :]
    covariance = np.swapaxes(weights * target_from_mean, -1, -2) @ source_from_mean
    u, singular, vt = np.linalg.svd(covariance)
    signs = np.ones_like(singular)
    signs[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = (u * signs[..., None, :]) @ vt
    variance = (weights * source_from_mean**2).sum(axis=(-1, -2))
    scale = (singular * signs).sum(axis=-1) / np.where(variance > 0.0, variance, 1.0)
    translation = target_mean - scale[..., None] * (rotation @ source_mean[..., None])[..., 0]
    return np.asarray(scale), rotation, translation


def rotation_from_vector(vector: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3 3"]:
    """The rotation matrices of rotation vectors in radians."""
    from scipy.spatial.transform import Rotation  # half a CPU second, which the report need not pay

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def turn_between(have: Float64[np.ndarray, "k 3"], want: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, " 3"]:
    """Rotation vector (radians) that best turns unit vectors into others; the smallest if several are equally good."""
    if len(have) == 1:
        axis = np.cross(have[0], want[0])
        sine, cosine = float(np.linalg.norm(axis)), float(have[0] @ want[0])
        if sine < 1e-12:
            return np.zeros(3) if cosine > 0.0 else np.array([math.pi, 0.0, 0.0])
        return np.asarray(axis / sine * math.atan2(sine, cosine))
    u, _, vt = np.linalg.svd(want.T @ have)
    rotation = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    twice_sine = float(np.linalg.norm(axis))
    angle = math.atan2(twice_sine, float(np.trace(rotation)) - 1.0)
    return np.asarray(axis / max(twice_sine, 1e-300) * angle)


def cross_matrix(vectors: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """``cross_matrix(a) @ b == cross(a, b)``."""
    matrix = np.zeros((*vectors.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -vectors[..., 2], vectors[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = vectors[..., 2], -vectors[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -vectors[..., 1], vectors[..., 0]
    return matrix


def similarity_jacobian(
    similarity: Similarity, source: Float64[np.ndarray, "n 3"], about: Float64[np.ndarray, " 3"] | None = None
) -> Float64[np.ndarray, "n 3 7"]:
    """Jacobian of the transformed points with respect to a rotation vector, the log scale and a translation.

    Rotation and scale are about the given source point, or else the points' mean, which decorrelates the unknowns.
    """
    middle = source.mean(axis=0) if about is None else about
    arms = similarity.scale * ((source - middle) @ similarity.rotation.T)
    jacobian = np.zeros((len(arms), 3, SIMILARITY))
    jacobian[:, :, :3] = -cross_matrix(arms)
    jacobian[:, :, 3] = arms
    jacobian[:, :, 4:] = np.eye(3)
    return jacobian


def moved_similarity(
    similarity: Similarity, source: Float64[np.ndarray, "n 3"], step: Float64[np.ndarray, " 7"]
) -> Similarity:
    """The similarity after a step in the unknowns of ``similarity_jacobian``."""
    mean = source.mean(axis=0)
    centre = similarity.apply(mean[None])[0] + step[4:]
    rotation = rotation_from_vector(step[:3]) @ similarity.rotation
    scale = similarity.scale * math.exp(float(np.clip(step[3], -1.0, 1.0)))
    return Similarity(scale, rotation, centre - scale * (rotation @ mean))


def solve_step(
    information: Float64[np.ndarray, "p p"], gradient: Float64[np.ndarray, " p"]
) -> Float64[np.ndarray, " p"]:
    """Solve the normal equations; zero along undetermined directions. Unknowns are scaled to equal size first."""
    sizes = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(sizes, sizes)
    return np.asarray(np.linalg.pinv(scaled, rcond=RANK_TOLERANCE, hermitian=True) @ (gradient / sizes) / sizes)
