"""What merging two Gaussians changes in pictures: the integral of the squared difference, in closed form."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int64

from splatpipe.pipeline.splat.moments import Moments, ellipsoid_areas, joint_covariances, shares
from splatpipe.pipeline.splat.sh import C0

_PLANES = ((0, 1, 3), (0, 2, 5), (3, 4, 5))  # of the six numbers of a covariance: what is seen along z, y and x
_LOST_COVER = 0.25
"""Variance that what lies behind has about mid-grey, summed over three channels: half of one of contrast would be 0.25
each, and what lies behind a Gaussian is most often alike."""
_ROWS_AT_ONCE = 1 << 15  # what one step needs stays in the cache


def merge_costs(
    moments: Moments,
    colours: Float32[np.ndarray, "n c"],
    pairs: Int64[np.ndarray, "e 2"],
    least_variance: float,
) -> Float64[np.ndarray, " e"]:
    """Squared differences that merges make, each pair alone, in pictures along the three axes: colour² · world units².

    A Gaussian's picture is opacity · (colour − what lies behind) · exp(−½ dᵀS⁻¹d), with S the covariance without the
    axis that one looks along. Two such pictures' product has the integral 2π √(|S||T| / |S+T|) exp(−½ dᵀ(S+T)⁻¹d), so
    that of the squared difference of the pair and of the one Gaussian with its moments is six of these. Colours are
    averaged over all directions: the spherical harmonics are orthonormal.

    Args:
        moments: Of all Gaussians.
        colours: All their coefficients of spherical harmonics.
        pairs: Which two.
        least_variance: Added along every axis, world units squared: keeps flat Gaussians seen from the edge finite.
    """
    costs = np.empty(len(pairs))
    for start in range(0, len(pairs), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        i, j = pairs[rows].T
        costs[rows] = _pair_costs(moments.select(i), moments.select(j), colours[i], colours[j], least_variance)
    return costs


def _pair_costs(
    one: Moments,
    other: Moments,
    one_colour: Float32[np.ndarray, "e c"],
    other_colour: Float32[np.ndarray, "e c"],
    least_variance: float,
) -> Float64[np.ndarray, " e"]:
    share = shares(one, other)
    rest = 1.0 - share
    joint = joint_covariances(one, other, share)
    opacity = _opacities(one.masses() + other.masses(), joint)
    aa, bb, ab = (
        _likeness(x, y) for x, y in ((one_colour, one_colour), (other_colour, other_colour), (one_colour, other_colour))
    )
    mm = share * share * aa + 2.0 * share * rest * ab + rest * rest * bb
    am, bm = share * aa + rest * ab, share * ab + rest * bb
    apart = other.means - one.means
    costs = np.zeros(len(share))
    for (xx, xy, yy), (x, y) in zip(_PLANES, ((0, 1), (0, 2), (1, 2)), strict=True):
        s, t, m = (
            (c[:, xx] + least_variance, c[:, xy], c[:, yy] + least_variance)
            for c in (one.covariances, other.covariances, joint)
        )
        dx, dy = apart[:, x], apart[:, y]
        costs += one.opacities**2 * aa * _overlap(s, s, 0.0 * dx, 0.0 * dy)
        costs += other.opacities**2 * bb * _overlap(t, t, 0.0 * dx, 0.0 * dy)
        costs += opacity**2 * mm * _overlap(m, m, 0.0 * dx, 0.0 * dy)
        costs += 2.0 * one.opacities * other.opacities * ab * _overlap(s, t, dx, dy)
        costs -= 2.0 * one.opacities * opacity * am * _overlap(s, m, rest * dx, rest * dy)
        costs -= 2.0 * other.opacities * opacity * bm * _overlap(t, m, share * dx, share * dy)
    return np.asarray(np.maximum(costs, 0.0))


def _likeness(one: Float32[np.ndarray, "e c"], other: Float32[np.ndarray, "e c"]) -> Float64[np.ndarray, " e"]:
    """Mean over all directions of the product of two colours, each less what lies behind them."""
    return np.asarray(np.einsum("ec,ec->e", one, other).astype(np.float64) * (C0 * C0) + _LOST_COVER)


def _opacities(masses: Float64[np.ndarray, " e"], covariances: Float64[np.ndarray, "e 6"]) -> Float64[np.ndarray, " e"]:
    """Of Gaussians of these masses, at most 1."""
    areas = covariance_areas(covariances)
    return np.asarray(np.minimum(np.divide(masses, areas, out=np.zeros_like(masses), where=areas > 0.0), 1.0))


def covariance_areas(covariances: Float64[np.ndarray, "e 6"]) -> Float64[np.ndarray, " e"]:
    """Surfaces of the ellipsoids of one standard deviation."""
    return ellipsoid_areas(np.sqrt(np.maximum(_eigenvalues(covariances), 0.0)))


def _eigenvalues(covariances: Float64[np.ndarray, "e 6"]) -> Float64[np.ndarray, "e 3"]:
    """Of symmetric matrices of three rows, by the cosine (O. K. Smith, CACM 4(4), 1961)."""
    xx, xy, xz, yy, yz, zz = covariances.T
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    half = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = np.divide(half, 2.0 * spread**3, out=np.ones_like(half), where=spread > 0.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) / 3.0
    most, least = mean + 2.0 * spread * np.cos(angle), mean + 2.0 * spread * np.cos(angle + 2.0 * np.pi / 3.0)
    return np.stack([least, 3.0 * mean - most - least, most], axis=1)


_Plane = tuple[Float64[np.ndarray, " e"], Float64[np.ndarray, " e"], Float64[np.ndarray, " e"]]


def _overlap(
    s: _Plane, t: _Plane, dx: Float64[np.ndarray, " e"], dy: Float64[np.ndarray, " e"]
) -> Float64[np.ndarray, " e"]:
    """Integrals of products of two Gaussians of height one in the plane, with centres so far apart."""
    xx, xy, yy = s[0] + t[0], s[1] + t[1], s[2] + t[2]
    both = xx * yy - xy * xy
    dets = np.maximum((s[0] * s[2] - s[1] * s[1]) * (t[0] * t[2] - t[1] * t[1]), 0.0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        exponent = -0.5 * (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / both
        found = 2.0 * np.pi * np.sqrt(dets / both) * np.exp(np.minimum(exponent, 0.0))
    return np.where(both > 0.0, found, 0.0)
