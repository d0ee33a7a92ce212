"""The reference of projection, spherical harmonics and blending of features: slow, plain torch, differentiable.

Formulas as in ``reference``; the native kernels (``feature_kernels``) compute the same. On any device, in float32 and
float64. Tensors of a batch lead with s scenes; their v views are in order of the scenes, v / s of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from splatpipe.pipeline.raster.definitions import (
    ALPHA_MIN,
    MAX_QUAT_NORM2,
    MAX_SCREEN_PX,
    MAX_VARIANCE_PX2,
    TRANSMITTANCE_MIN,
)
from splatpipe.pipeline.raster.feature_definitions import BlendOptions, Projected, ProjectionOptions, Steps, View
from splatpipe.pipeline.raster.reference import projection_jacobian, rotation_from_quats
from splatpipe.pipeline.splat.model.sh import eval_sh

REACH_SIGMAS = 3.33
"""Even an opaque Gaussian has alpha < 1/255 beyond this many standard deviations."""
_PAIRS_AT_ONCE = 1 << 22
"""Pixel-Gaussian pairs in memory at a time."""


def project_reference(
    views: Sequence[View],
    options: ProjectionOptions,
    means: Float[Tensor, "s n 3"],
    quats: Float[Tensor, "s n 4"],
    scales: Float[Tensor, "s n 3"],
    opacities: Float[Tensor, "s n"],
) -> Projected:
    """Project Gaussians to every view; the opacities only bound the radii.

    Args:
        views: v of them.
        options: How.
        means: Centres, world units.
        quats: Orientations (w, x, y, z), of any length.
        scales: Standard deviations along the axes, world units, of either sign.
        opacities: 0..1.
    """
    scene = [index * len(means) // len(views) for index in range(len(views))]
    each = [
        _project(view, options, means[s], quats[s], scales[s], opacities[s].detach())
        for s, view in zip(scene, views, strict=True)
    ]
    means2d, depths, covariances, determinants, compensations, slants, radii = (
        torch.stack(parts) for parts in zip(*each, strict=True)
    )
    return Projected(
        means2d,
        depths,
        covariances,
        determinants.detach(),
        compensations if options.compensate else None,
        slants if options.slants else None,
        radii,
    )


def _project(
    view: View,
    options: ProjectionOptions,
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
) -> tuple[Tensor, ...]:
    """The fields of ``Projected`` for one view, all of them."""
    with torch.no_grad():
        radii = _radii(view, options, (means, quats, scales), opacities)
        rows = torch.nonzero(radii[:, 0])[:, 0]
    # Of these only: what is not finite of others must not reach the gradient.
    fields = _fields(view, options, means[rows], quats[rows], scales[rows])[:-1]
    shown = (field.new_zeros(len(means), *field.shape[1:]).index_copy(0, rows, field) for field in fields)
    return *shown, radii


def _fields(view: View, options: ProjectionOptions, means: Tensor, quats: Tensor, scales: Tensor) -> tuple[Tensor, ...]:
    """Those of ``Projected`` without radii, and the depth's gradient along the axes (n, 3), of any Gaussian."""
    camera, blur = view.camera, options.blur_px2
    pose = means.new_tensor(camera.cam_from_world)
    points = means @ pose[:3, :3].T + pose[:3, 3]  # (n, 3)
    x, y, z = points.unbind(-1)
    means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)

    axes = rotation_from_quats(quats) * scales[:, None, :]  # (n, 3, 3)
    row_x, row_y = (projection_jacobian(points, camera) @ pose[:3, :3] @ axes).unbind(-2)  # Σ' = B Bᵀ
    row_z = torch.einsum("j,njk->nk", pose[2, :3], axes)
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)
    sharp = (torch.linalg.cross(row_x, row_y) ** 2).sum(-1)  # det B Bᵀ (Cauchy-Binet)
    determinants = sharp + blur * (xx + yy) + blur**2
    covariances = torch.stack([xx + blur, xy, yy + blur], -1)
    slants = torch.stack([(row_z * row_x).sum(-1), (row_z * row_y).sum(-1)], -1)

    ratio = sharp / determinants
    free = ratio > options.compensation_min  # a root of 0 has no derivative
    compensations = torch.where(free, torch.sqrt(torch.where(free, ratio, 1.0)), options.compensation_min**0.5)
    return means2d, z, covariances, determinants, compensations, slants, row_z


def _radii(
    view: View, options: ProjectionOptions, gaussians: tuple[Tensor, Tensor, Tensor], opacities: Float[Tensor, " n"]
) -> Int32[Tensor, "n 2"]:
    """Radii of the boxes around alpha ≥ 1/255, whole pixels; 0 where a Gaussian is not visible."""
    means2d, z, covariances, determinants, compensations, _, row_z = _fields(view, options, *gaussians)
    shown = opacities * compensations if options.compensate else opacities
    sigmas = torch.sqrt(2.0 * torch.log(shown.clamp_min(ALPHA_MIN) / ALPHA_MIN)).clamp_max(REACH_SIGMAS)
    radii = torch.ceil(sigmas[:, None] * torch.sqrt(covariances[:, [0, 2]]))
    usable = (
        (z >= options.near)
        & (z <= options.far)
        & (z > 0.0)
        & ((gaussians[1] ** 2).sum(-1) <= MAX_QUAT_NORM2)
        & ((options.plane_sigmas * row_z).square().sum(-1) < z * z)
        & (covariances[:, [0, 2]] <= MAX_VARIANCE_PX2).all(-1)
        & (determinants > 0.0)
        & (means2d.abs() <= MAX_SCREEN_PX).all(-1)
        & (shown >= ALPHA_MIN)
    )
    size = radii.new_tensor([view.camera.width, view.camera.height])
    seen = usable & (radii > 0).all(-1) & (radii > options.radius_clip).any(-1)
    seen = seen & (means2d + radii > 0).all(-1) & (means2d - radii < size).all(-1)
    return torch.where(seen[:, None], radii, 0.0).to(torch.int32)


def sh_colours_reference(
    views: Sequence[View],
    degree: int,
    means: Float[Tensor, "s n 3"],
    sh: Float[Tensor, "f n k 3"],
    radii: Int32[Tensor, "v n 2"],
) -> Float[Tensor, "v n 3"]:
    """Colours of spherical harmonics, + 0.5, clamped at 0; zeros where not visible.

    Args:
        views: v of them.
        degree: That is used, 0..3.
        means: Centres, world units.
        sh: Coefficients of each scene, or of each view.
        radii: Of the projection.
    """
    colours = []
    for index, view in enumerate(views):
        seen = (radii[index] > 0).all(-1)[:, None]
        towards = means[index * len(means) // len(views)] - means.new_tensor(view.centre)
        towards = torch.where(seen, towards, towards.new_tensor([0.0, 0.0, 1.0]))
        directions = towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
        colour = eval_sh(degree, sh[index * len(sh) // len(views)], directions) + 0.5
        colours.append(torch.where(seen, colour.clamp_min(0.0), 0.0))
    return torch.stack(colours)


def blend_reference(
    options: BlendOptions,
    splats: Projected,
    opacities: Float[Tensor, "v n"],
    features: Float[Tensor, "f n d"],
    backgrounds: Float[Tensor, "v d"] | None,
    magnitudes: Float[Tensor, "v n 2"] | None,
) -> tuple[Float[Tensor, "v h w d"], Float[Tensor, "v h w"]]:
    """Blend the visible splats of every view from near to far.

    Args:
        options: How.
        splats: Of the projection. With slants, the last channel of the features varies within a splat as the depth at
            which a ray peaks in the Gaussian does.
        opacities: With the factors of the anti-aliased variant.
        features: Of each scene, or of each view.
        backgrounds: Behind everything; None for zeros.
        magnitudes: The backward pass adds the sums of the pixels' absolute gradients by the centres to it.

    Returns:
        The features, and alpha.
    """
    pictures = []
    for index in range(len(splats.means2d)):
        seen = torch.nonzero((splats.radii[index] > 0).all(-1))[:, 0]
        rows = seen[torch.argsort(splats.depths[index].detach()[seen], stable=True)]
        behind = features.new_zeros(features.shape[-1]) if backgrounds is None else backgrounds[index]
        values = (
            splats.means2d[index][rows],
            splats.covariances[index][rows],
            splats.determinants[index][rows],
            opacities[index][rows],
            features[index * len(features) // len(splats.means2d)][rows],
            torch.zeros_like(splats.means2d[index][rows]) if splats.slants is None else splats.slants[index][rows],
        )
        sums = None if magnitudes is None else (magnitudes[index], rows)
        height = max(1, _PAIRS_AT_ONCE // (max(1, len(rows)) * options.width))
        bands = []
        for top in range(0, options.height, height):
            size = (top, min(top + height, options.height))
            bands.append(
                checkpoint(
                    _blend_rows, size, options, sums, behind, *values, use_reentrant=False, preserve_rng_state=False
                )
            )
        pictures.append(tuple(torch.cat(parts) for parts in zip(*bands, strict=True)))
    shown, alpha = (torch.stack(parts) for parts in zip(*pictures, strict=True))
    return shown, alpha


class _SumMagnitudes(torch.autograd.Function):
    """Broadcasts centres (n, 2) to r x w pixels; adds the pixels' absolute gradients to some rows of a tensor."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, rows: int, columns: int, sums: tuple[Tensor, Tensor]) -> Tensor:
        ctx.sums = sums
        return means2d[:, None, None].expand(-1, rows, columns, -1)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None, None]:
        magnitudes, index = ctx.sums
        magnitudes.index_add_(0, index, upstream[0].abs().sum((1, 2)))
        return upstream[0].sum((1, 2)), None, None, None


def _blend_rows(
    size: tuple[int, int],
    options: BlendOptions,
    sums: tuple[Tensor, Tensor] | None,
    background: Float[Tensor, " d"],
    means2d: Float[Tensor, "n 2"],
    covariances: Float[Tensor, "n 3"],
    exact: Float[Tensor, " n"],
    opacities: Float[Tensor, " n"],
    features: Float[Tensor, "n d"],
    slants: Float[Tensor, "n 2"],
) -> tuple[Tensor, Tensor]:
    """Rows top..bottom of the images: features (r, w, d) and alpha (r, w)."""
    top, bottom = size
    ys = torch.arange(top, bottom, dtype=means2d.dtype, device=means2d.device) + 0.5
    xs = torch.arange(options.width, dtype=means2d.dtype, device=means2d.device) + 0.5
    centres = means2d[:, None, None]
    if sums is not None:
        centres = _SumMagnitudes.apply(means2d, bottom - top, options.width, sums)  # type: ignore[no-untyped-call]
    dx, dy = xs[None, None, :] - centres[..., 0], ys[None, :, None] - centres[..., 1]  # (n, r, w), or broadcast
    xx, xy, yy = (each[:, None, None] for each in covariances.unbind(-1))
    cancelled = xx * yy - xy * xy
    determinants = exact[:, None, None] + (cancelled - cancelled.detach())  # its value from one, its gradient from both
    # dᵀ Σ'⁻¹ d as a sum of squares, which does not cancel in long thin splats.
    distance2 = (dx - xy / yy * dy) ** 2 * (yy / determinants) + dy**2 / yy  # (n, r, w)
    alphas = (opacities[:, None, None] * torch.exp(-0.5 * distance2)).clamp_max(options.alpha_max)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, 0.0)
    # The transmittance never grows, so once below the limit it stays there for all that follow.
    alphas = torch.where(torch.cumprod(1.0 - alphas, 0) >= TRANSMITTANCE_MIN, alphas, 0.0)
    left = torch.cat([alphas.new_ones(1, *distance2.shape[1:]), torch.cumprod(1.0 - alphas, 0)])  # (n + 1, r, w)
    weights = alphas * left[:-1]
    shown = torch.einsum("nrw,nd->rwd", weights, features) + left[-1][..., None] * background
    zx, zy = (each[:, None, None] for each in slants.unbind(-1))
    # Of the depth; its gradient by the centre does not count as a magnitude.
    dx, dy = (xs[None, :] - means2d[:, None, 0])[:, None, :], (ys[None, :] - means2d[:, None, 1])[:, :, None]
    rise = ((yy * zx - xy * zy) * dx + (xx * zy - xy * zx) * dy) / determinants  # (zx, zy)ᵀ Σ'⁻¹ d
    shown = torch.cat([shown[..., :-1], shown[..., -1:] + (weights * rise).sum(0)[..., None]], -1)
    return shown, 1.0 - left[-1]


REFERENCE = Steps(project_reference, sh_colours_reference, blend_reference)
