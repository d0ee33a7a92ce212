"""Moments of Gaussians (mass, mean, covariance), and merging a pair into the Gaussian with the same moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit

from splatpipe.pipeline.splat.model.gaussians import Gaussians

_MAX_LOG_SCALE = 40.0  # the fourth power of e^40 still fits a float64, and no scene is this large
_MIN_OPACITY, _MAX_OPACITY = 1e-7, 1.0 - 1e-6  # bounds on a merged Gaussian's opacity: its logit is finite in float32
_AREA_POWER = 1.6075
"""Exponent of Knud Thomsen's formula for an ellipsoid's surface area (2004), accurate to 1.061 %."""
GROWTH = 0.45
"""Power of the excess opacity by which a merged Gaussian's area grows. At 0, surfaces of overlapping Gaussians become
thin; at 1, their edges spread."""
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of n Gaussians, without their colours.

    Attributes:
        means: Centres, world units.
        covariances: xx, xy, xz, yy, yz, zz; world units squared.
        opacities: 0..1.
        areas: Surface areas of the one-sigma ellipsoids, world units squared. A convex body's mean projected area is a
            quarter of its surface area (Cauchy), so opacity times area measures what a Gaussian covers on average over
            all directions: its mass.
    """

    means: Float64[np.ndarray, "n 3"]
    covariances: Float64[np.ndarray, "n 6"]
    opacities: Float64[np.ndarray, " n"]
    areas: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.means)

    def masses(self) -> Float64[np.ndarray, " n"]:
        """Masses: opacity times area, world units squared."""
        return np.asarray(self.opacities * self.areas)

    def select(self, index: Int64[np.ndarray, " m"]) -> Moments:
        """The moments at the given indices, copied."""
        return Moments(self.means[index], self.covariances[index], self.opacities[index], self.areas[index])


def moments_of(gaussians: Gaussians) -> Moments:
    """Moments of Gaussians in float64; scales are clamped to e^±40."""
    means, log_scales, quats, logits = (
        tensor.detach().cpu().numpy().astype(np.float64)
        for tensor in (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits)
    )
    scales = np.exp(np.clip(log_scales, -_MAX_LOG_SCALE, _MAX_LOG_SCALE))
    axes = _rotations(quats) * scales[:, None, :]
    covariances = np.stack([(axes[:, a] * axes[:, b]).sum(1) for a, b in _upper()], axis=1)
    return Moments(means, covariances, expit(logits), ellipsoid_areas(scales))


def ellipsoid_areas(scales: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Surface areas of ellipsoids from their semi-axes (Thomsen's approximation)."""
    x, y, z = np.power(scales, _AREA_POWER).T
    return np.asarray(4.0 * np.pi * np.power((x * y + x * z + y * z) / 3.0, 1.0 / _AREA_POWER))


def shares(one: Moments, other: Moments) -> Float64[np.ndarray, " n"]:
    """Each pair's share of mass in its first Gaussian; a half where both have no mass."""
    first, both = one.masses(), one.masses() + other.masses()
    return np.asarray(np.divide(first, both, out=np.full(len(first), 0.5), where=both > 0.0))


def joint_covariances(one: Moments, other: Moments, share: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 6"]:
    """Joint covariances of pairs about their common means (law of total variance), world units squared.

    Args:
        one: First Gaussian of each pair.
        other: Second Gaussian of each pair.
        share: The first's share of the mass.
    """
    apart = other.means - one.means
    between = np.stack([apart[:, a] * apart[:, b] for a, b in _upper()], axis=1)
    first, second = share[:, None], (1.0 - share)[:, None]
    return np.asarray(first * one.covariances + second * other.covariances + first * second * between)


def merge_pairs(one: Gaussians, other: Gaussians) -> Gaussians:
    """Merge each pair into one Gaussian with the pair's mass and its mass-weighted mean and covariance.

    The weights are those of Kerbl et al., "A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very
    Large Datasets" (2024): opacity times surface area. An opacity that would exceed 1 is clamped, since files and
    viewers allow no more, and the Gaussian grows by part of the loss (``GROWTH``).

    Args:
        one: First Gaussian of each pair.
        other: Second Gaussian of each pair; of the same SH degree.
    """
    ours, theirs = moments_of(one), moments_of(other)
    share = shares(ours, theirs)
    first, second = share[:, None], (1.0 - share)[:, None]
    means = first * ours.means + second * theirs.means
    variances, axes = np.linalg.eigh(joint_covariances(ours, theirs, share)[:, _SYMMETRIC])
    log_scales = 0.5 * np.log(np.maximum(variances, np.exp(-2.0 * _MAX_LOG_SCALE)))
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    x, y, z, w = Rotation.from_matrix(axes).as_quat(canonical=True).T
    masses, areas = ours.masses() + theirs.masses(), ellipsoid_areas(np.exp(log_scales))
    opacities = masses / areas
    log_scales += 0.5 * GROWTH * np.log(np.maximum(opacities, 1.0))[:, None]
    opacities = np.clip(opacities, _MIN_OPACITY, _MAX_OPACITY)
    part = torch.from_numpy(share).to(one.sh.dtype)[:, None, None]
    dtype = one.means.dtype
    return Gaussians(
        torch.from_numpy(means).to(dtype),
        torch.from_numpy(log_scales).to(dtype),
        torch.from_numpy(np.stack([w, x, y, z], axis=1)).to(dtype),
        torch.from_numpy(logit(opacities)).to(dtype),
        part * one.sh + (1.0 - part) * other.sh,
    )


def _upper() -> tuple[tuple[int, int], ...]:
    return ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _rotations(quats: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length; the identity for length zero."""
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    units = np.divide(quats, lengths, out=np.tile([1.0, 0.0, 0.0, 0.0], (len(quats), 1)), where=lengths > 0.0)
    return np.asarray(Rotation.from_quat(units[:, [1, 2, 3, 0]]).as_matrix()) if len(quats) else np.empty((0, 3, 3))
