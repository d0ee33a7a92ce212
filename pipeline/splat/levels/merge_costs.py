"""The cost of merging two Gaussians: how much they differ from the merged one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int64

from splatpipe.pipeline.splat.model.moments import Moments, joint_covariances, shares

COLOUR_WEIGHT = 4.0
"""Weight of a pair's colour variance against the divergence of its shapes: tuned on the demo's model."""
_ROWS_AT_ONCE = 1 << 15  # one step's data fit into the cache


def merge_costs(
    moments: Moments,
    colours: Float32[np.ndarray, "n c"],
    pairs: Int64[np.ndarray, "e 2"],
    least_variance: float,
) -> Float64[np.ndarray, " e"]:
    """Costs of merging pairs, each independent of the others: shape plus colour, dimensionless and scale-invariant.

    Shape: a bound on the Kullback-Leibler divergence of the pair from the Gaussian with its moments, ½ (log|P| −
    s log|P₁| − (1 − s) log|P₂|) of the joint covariance and the pair's own, with s the first's share of the mass (A. R.
    Runnalls, "Kullback-Leibler Approach to Gaussian Mixture Reduction", IEEE Transactions on Aerospace and Electronic
    Systems 43(3), 2007). Merges that would thicken a wall or widen a pole cost much. Colour: the mass-weighted variance
    of the SH coefficients, which are orthonormal, so all directions count equally.

    Args:
        moments: Moments of all Gaussians.
        colours: All their SH coefficients.
        pairs: Indices of each pair.
        least_variance: Added along every axis, world units squared, > 0: flatter Gaussians count as equally flat.
    """
    costs = np.empty(len(pairs))
    volumes = _log_volumes(moments.covariances, least_variance)
    for start in range(0, len(pairs), _ROWS_AT_ONCE):
        i, j = pairs[start : start + _ROWS_AT_ONCE].T
        one, other = moments.select(i), moments.select(j)
        share = shares(one, other)
        joint = _log_volumes(joint_covariances(one, other, share), least_variance)
        shape = 0.5 * (joint - share * volumes[i] - (1.0 - share) * volumes[j])
        apart = colours[i] - colours[j]
        variance = share * (1.0 - share) * np.einsum("ec,ec->e", apart, apart)
        costs[start : start + len(i)] = shape + COLOUR_WEIGHT * variance
    return np.maximum(np.nan_to_num(costs, nan=np.inf), 0.0)


def _log_volumes(covariances: Float64[np.ndarray, "n 6"], least_variance: float) -> Float64[np.ndarray, " n"]:
    """Log determinants from the Cholesky factors' diagonals, which avoids cancellation for flat Gaussians."""
    xx, xy, xz, yy, yz, zz = covariances.T
    first = xx + least_variance
    second = np.maximum(yy + least_variance - xy * xy / first, least_variance)
    mixed = yz - xy * xz / first
    third = np.maximum(zz + least_variance - xz * xz / first - mixed * mixed / second, least_variance)
    return np.asarray(np.log(first) + np.log(second) + np.log(third))
