"""Thinning for distant viewing: the Gaussians in a voxel become one with their first two moments.

Weights are opacity times projected area (a standard deviation squared), because the total light has to be preserved:
the merged Gaussian gets it through its opacity and, beyond the rasterizer's cap on opacity, through its size.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from splatpipe.pipeline.raster.definitions import ALPHA_MAX
from splatpipe.pipeline.splat.model.gaussians import Gaussians

MIN_VARIANCE = 1e-30  # world units squared: coplanar Gaussians have none across the plane, or less by rounding
MIN_OPACITY = 1e-6  # whose logit is still finite


def thinned(gaussians: Gaussians, voxel: Float64[np.ndarray, " n"]) -> Gaussians:
    """Merge the Gaussians that share a voxel; a Gaussian alone in its voxel stays bit-identical.

    Args:
        gaussians: Finite, on the CPU.
        voxel: Voxel side for each Gaussian, world units; rounded down to a power of two.
    """
    means = gaussians.means.detach().double().numpy()
    levels = np.floor(np.log2(voxel)).astype(np.int64)
    keys = np.column_stack([levels, np.floor(means / np.exp2(levels)[:, None]).astype(np.int64)])
    _, group, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    if len(counts) == len(gaussians):
        return gaussians
    alone = counts[group] == 1
    several = np.flatnonzero(~alone)
    members = several[np.argsort(group[several], kind="stable")]
    starts = np.flatnonzero(np.diff(group[members], prepend=-1))
    kept = gaussians.select(torch.from_numpy(np.flatnonzero(alone)))
    return Gaussians.concat([kept, _merged(gaussians.select(torch.from_numpy(members)), starts)])


def _merged(gaussians: Gaussians, starts: Int64[np.ndarray, " g"]) -> Gaussians:
    """One Gaussian for each run that begins at a row of ``starts``."""
    means, quats = (tensor.detach().double().numpy() for tensor in (gaussians.means, gaussians.quats))
    scales = np.exp(gaussians.log_scales.detach().double().numpy())
    opacities = torch.sigmoid(gaussians.opacity_logits.detach().double()).numpy()
    turns = Rotation.from_quat(np.where(np.any(quats, axis=1)[:, None], quats, [1.0, 0, 0, 0]), scalar_first=True)
    axes = turns.as_matrix() * scales[:, None, :]
    weights = np.maximum(opacities, MIN_OPACITY) * scales.prod(axis=1) ** (2.0 / 3.0)
    lengths = np.diff(starts, append=len(means))
    total = np.add.reduceat(weights, starts)
    share = weights / np.repeat(total, lengths)
    centre = np.add.reduceat(share[:, None] * means, starts)
    apart = means - np.repeat(centre, lengths, axis=0)
    spread = axes @ axes.transpose(0, 2, 1) + apart[:, :, None] * apart[:, None, :]
    values, vectors = np.linalg.eigh(np.add.reduceat(share[:, None, None] * spread, starts))
    vectors[..., 0] *= np.sign(np.linalg.det(vectors))[:, None]  # rotations, no mirrors
    sigma = np.sqrt(np.maximum(values, MIN_VARIANCE))
    light = total / sigma.prod(axis=1) ** (2.0 / 3.0)
    sigma *= np.sqrt(np.maximum(light / ALPHA_MAX, 1.0))[:, None]
    opacity = np.clip(light, MIN_OPACITY, ALPHA_MAX)
    harmonics = gaussians.sh.detach().double().numpy()
    return Gaussians(
        torch.from_numpy(centre).float(),
        torch.from_numpy(np.log(sigma)).float(),
        torch.from_numpy(Rotation.from_matrix(vectors).as_quat(canonical=True, scalar_first=True)).float(),
        torch.from_numpy(np.log(opacity / (1.0 - opacity))).float(),
        torch.from_numpy(np.add.reduceat(share[:, None, None] * harmonics, starts)).float(),
    )
