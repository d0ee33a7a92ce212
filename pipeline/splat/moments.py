"""Gaussians by their moments: mass, mean and covariance, and the one Gaussian that has those of two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit

from splatpipe.pipeline.splat.gaussians import Gaussians

_LOG_SCALE_MOST = 40.0  # the square of the square of e^40 is a float64 still, and no scene is so large
_OPACITY_LEAST, _OPACITY_MOST = 1e-7, 1.0 - 1e-6  # of a merged Gaussian: their logits are float32s, and finite
_AREA_POWER = 1.6075
"""Exponent of Knud Thomsen's formula for an ellipsoid's surface (2004), within 1.061 %."""
GROWTH = 0.45
"""Power of the excess over opaque by which a merged Gaussian's area grows. At 0 surfaces whose Gaussians overlap become
thin, at 1 their edges spread."""
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True, eq=False)
class Moments:
    """What n Gaussians are, apart from their colours.

    Attributes:
        means: Centres, world units.
        covariances: xx, xy, xz, yy, yz, zz; world units squared.
        opacities: 0..1.
        areas: Surfaces of the ellipsoids of one standard deviation. A quarter of it is a convex body's mean shadow
            (Cauchy), so that opacity times area stands for what a Gaussian covers, seen from anywhere: its mass.
    """

    means: Float64[np.ndarray, "n 3"]
    covariances: Float64[np.ndarray, "n 6"]
    opacities: Float64[np.ndarray, " n"]
    areas: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.means)

    def masses(self) -> Float64[np.ndarray, " n"]:
        """Opacity times area."""
        return np.asarray(self.opacities * self.areas)

    def select(self, index: Int64[np.ndarray, " m"]) -> Moments:
        """Those of an index, copied."""
        return Moments(self.means[index], self.covariances[index], self.opacities[index], self.areas[index])


def moments_of(gaussians: Gaussians) -> Moments:
    """Their moments, in float64; a scale beyond e^±40 counts as that."""
    means, log_scales, quats, logits = (
        tensor.detach().cpu().numpy().astype(np.float64)
        for tensor in (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits)
    )
    scales = np.exp(np.clip(log_scales, -_LOG_SCALE_MOST, _LOG_SCALE_MOST))
    axes = _rotations(quats) * scales[:, None, :]
    covariances = np.stack([(axes[:, a] * axes[:, b]).sum(1) for a, b in _upper()], axis=1)
    return Moments(means, covariances, expit(logits), ellipsoid_areas(scales))


def ellipsoid_areas(scales: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Surfaces of ellipsoids by their half axes (Thomsen's approximation)."""
    x, y, z = np.power(scales, _AREA_POWER).T
    return np.asarray(4.0 * np.pi * np.power((x * y + x * z + y * z) / 3.0, 1.0 / _AREA_POWER))


def shares(one: Moments, other: Moments) -> Float64[np.ndarray, " n"]:
    """What part of each pair's mass its first has; half where both have none."""
    first, both = one.masses(), one.masses() + other.masses()
    return np.asarray(np.divide(first, both, out=np.full(len(first), 0.5), where=both > 0.0))


def joint_covariances(one: Moments, other: Moments, share: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 6"]:
    """Covariances of pairs taken together, each about its common mean (law of total variance).

    Args:
        one: The pairs' first.
        other: Their second.
        share: The first's part of the mass.
    """
    apart = other.means - one.means
    between = np.stack([apart[:, a] * apart[:, b] for a, b in _upper()], axis=1)
    first, second = share[:, None], (1.0 - share)[:, None]
    return np.asarray(first * one.covariances + second * other.covariances + first * second * between)


def merge_pairs(one: Gaussians, other: Gaussians) -> Gaussians:
    """One Gaussian for each pair, with the pair's mean and covariance, weighted by mass, and with its mass.

    The weights are those of Kerbl et al., "A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very
    Large Datasets" (2024): opacity times surface. An opacity that would exceed 1 is held there, since files and viewers
    know no more, and the Gaussian grows by a part of what is lost (``GROWTH``).

    Args:
        one: The pairs' first.
        other: Their second; of the same SH degree.
    """
    ours, theirs = moments_of(one), moments_of(other)
    share = shares(ours, theirs)
    first, second = share[:, None], (1.0 - share)[:, None]
    means = first * ours.means + second * theirs.means
    variances, axes = np.linalg.eigh(joint_covariances(ours, theirs, share)[:, _SYMMETRIC])
    log_scales = 0.5 * np.log(np.maximum(variances, np.exp(-2.0 * _LOG_SCALE_MOST)))
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a reflection
    x, y, z, w = Rotation.from_matrix(axes).as_quat(canonical=True).T
    masses, areas = ours.masses() + theirs.masses(), ellipsoid_areas(np.exp(log_scales))
    opacities = masses / areas
    log_scales += 0.5 * GROWTH * np.log(np.maximum(opacities, 1.0))[:, None]
    opacities = np.clip(opacities, _OPACITY_LEAST, _OPACITY_MOST)
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
    """Matrices of quaternions (w, x, y, z) of any length; the identity for none."""
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    units = np.divide(quats, lengths, out=np.tile([1.0, 0.0, 0.0, 0.0], (len(quats), 1)), where=lengths > 0.0)
    return np.asarray(Rotation.from_quat(units[:, [1, 2, 3, 0]]).as_matrix()) if len(quats) else np.empty((0, 3, 3))
