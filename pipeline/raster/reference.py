"""The reference rasterizer: slow, plain torch, differentiable by autograd in float32 and float64.

Formulas: "EWA Splatting" (Zwicker et al. 2002) for the projection of a Gaussian, "3D Gaussian Splatting" (Kerbl et al.
2023) for blending; see ``definitions`` for the constants. The native backend computes the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.definitions import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUR_PX2,
    COMPENSATION_MIN,
    FRUSTUM_MARGIN,
    MAX_COLOUR,
    MAX_DEPTH,
    MAX_QUAT_NORM2,
    MAX_SCREEN_PX,
    MAX_VARIANCE_PX2,
    MEDIAN_SHIFT_MAX,
    MEDIAN_TRANSMITTANCE,
    PLANE_SIGMAS,
    QUAT_EPSILON,
    RADIUS_SIGMAS,
    TRANSMITTANCE_MIN,
    Render,
    RenderOptions,
)
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import eval_sh

_PAIRS_AT_ONCE = 1 << 22
"""Pixel-Gaussian pairs in memory at a time: about ten tensors of 32 MB each in float64."""


@dataclass(frozen=True)
class Splats:
    """Gaussians projected to the screen, sorted from near to far where that matters.

    Attributes:
        means: Centres, pixels.
        depths: z in the camera, world units.
        covariances: xx, xy, yy with the blur, px².
        determinants: Determinants of the covariances.
        depth_slopes: Change per pixel, along x and y, of the depth at which a ray peaks in the Gaussian.
        opacities: At the centre, compensated in the anti-aliased variant.
        colours: Red, green, blue, ≥ 0.
        usable: False where anything is not finite, before the near plane, across the camera plane or beyond limits.
    """

    means: Float[Tensor, "n 2"]
    depths: Float[Tensor, " n"]
    covariances: Float[Tensor, "n 3"]
    determinants: Float[Tensor, " n"]
    depth_slopes: Float[Tensor, "n 2"]
    opacities: Float[Tensor, " n"]
    colours: Float[Tensor, "n 3"]
    usable: Bool[Tensor, " n"]

    def select(self, index: Tensor) -> Splats:
        """The splats of an index."""
        return Splats(**{name: tensor[index] for name, tensor in vars(self).items()})

    def half_sizes(self) -> Float[Tensor, "n 2"]:
        """Half width and height of the ellipse in which alpha ≥ 1/255, pixels; NaN if there is none."""
        reach = 2.0 * torch.log(self.opacities / ALPHA_MIN)  # squared Mahalanobis distance
        return torch.sqrt(reach[:, None] * self.covariances[:, [0, 2]])

    def radii(self) -> Float[Tensor, " n"]:
        """Three standard deviations along the longer axis, pixels."""
        xx, xy, yy = self.covariances.unbind(-1)
        largest = 0.5 * (xx + yy) + torch.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)
        radii: Tensor = RADIUS_SIGMAS * torch.sqrt(largest)
        return radii


def rotation_from_quats(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length."""
    unit = quats * torch.rsqrt((quats**2).sum(-1, keepdim=True) + QUAT_EPSILON)
    w, x, y, z = unit.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def projection_jacobian(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 2 3"]:
    """d(pixel) / d(point in the camera frame), with x/z and y/z clamped to the widened frustum.

    Args:
        points: Camera frame, z > 0.
        camera: The view; its principal point need not be central. For a window of an image the whole image's frustum
            counts, so that the window renders exactly as in the whole.
    """
    camera = camera.uncropped()
    fx, fy = camera.fx, camera.fy
    x, y, z = points.unbind(-1)
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * camera.width, FRUSTUM_MARGIN * 0.5 * camera.height
    ratio_x = (x / z).clamp(-(camera.cx + margin_x) / fx, (camera.width - camera.cx + margin_x) / fx)
    ratio_y = (y / z).clamp(-(camera.cy + margin_y) / fy, (camera.height - camera.cy + margin_y) / fy)
    zero = torch.zeros_like(z)
    row_x = torch.stack([fx / z, zero, -fx * ratio_x / z], -1)
    row_y = torch.stack([zero, fy / z, -fy * ratio_y / z], -1)
    return torch.stack([row_x, row_y], -2)


def project(gaussians: Gaussians, camera: Camera, options: RenderOptions) -> Splats:
    """Project Gaussians to the screen.

    Args:
        gaussians: The scene.
        camera: The view.
        options: SH degree, near plane, variant.

    Returns:
        All splats, in order; the values of unusable ones are meaningless.
    """
    means = gaussians.means
    pose, centre = means.new_tensor(camera.cam_from_world), means.new_tensor(camera.centre())
    points = means @ pose[:3, :3].T + pose[:3, 3]  # (n, 3)
    x, y, z = points.unbind(-1)
    means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)  # (n, 2)

    axes = rotation_from_quats(gaussians.quats) * torch.exp(gaussians.log_scales)[:, None, :]  # (n, 3, 3)
    jacobian = projection_jacobian(points, camera) @ pose[:3, :3]  # (n, 2, 3) J W
    row_x, row_y = (jacobian @ axes).unbind(-2)  # rows of the Jacobian B (n, 2, 3), with Σ' = B Bᵀ
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)
    sharp = (torch.linalg.cross(row_x, row_y) ** 2).sum(-1)  # det Σ' without cancellation (Cauchy-Binet)
    determinants = sharp + BLUR_PX2 * (xx + yy) + BLUR_PX2**2
    covariances = torch.stack([xx + BLUR_PX2, xy, yy + BLUR_PX2], -1)

    row_z = torch.einsum("j,njk->nk", pose[2, :3], axes)  # gradient of the depth; row_x, row_y are those of x, y
    zx, zy = (row_z * row_x).sum(-1), (row_z * row_y).sum(-1)
    slopes_x, slopes_y = (yy + BLUR_PX2) * zx - xy * zy, (xx + BLUR_PX2) * zy - xy * zx
    depth_slopes = torch.stack([slopes_x, slopes_y], -1) / determinants[:, None]  # Σ'⁻¹ (zx, zy)

    opacities = torch.sigmoid(gaussians.opacity_logits)
    if options.antialias:
        opacities = opacities * torch.sqrt((sharp / determinants).clamp_min(COMPENSATION_MIN))
    towards = means - centre
    dirs = towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
    colours = eval_sh(options.sh_degree, gaussians.sh, dirs) + 0.5

    raw = torch.cat([means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits[:, None]], -1)
    usable = (
        raw.isfinite().all(-1)
        & ((gaussians.quats**2).sum(-1) <= MAX_QUAT_NORM2)
        & (z > options.near)
        & ((PLANE_SIGMAS * row_z).square().sum(-1) < z * z)
        & (z <= MAX_DEPTH)
        & (means2d.abs() <= MAX_SCREEN_PX).all(-1)
        & (covariances[:, [0, 2]] <= MAX_VARIANCE_PX2).all(-1)
        & (colours.abs() <= MAX_COLOUR).all(-1)
        & (opacities >= ALPHA_MIN)
    )
    return Splats(means2d, z, covariances, determinants, depth_slopes, opacities, colours.clamp_min(0.0), usable)


def visible_splats(splats: Splats, camera: Camera) -> Bool[Tensor, " n"]:
    """Usable splats whose ellipse's bounding box intersects the rectangle of the image's pixel centres."""
    half = splats.half_sizes()
    last = torch.tensor([camera.width - 0.5, camera.height - 0.5], dtype=half.dtype, device=half.device)
    inside = (splats.means + half >= 0.5) & (splats.means - half <= last)
    return splats.usable & inside.all(-1)


def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    options: RenderOptions,
    means2d_probe: Float[Tensor, "n 2"] | None = None,
) -> Render:
    """Render by the definition; arguments as for ``render``."""
    with torch.no_grad():
        everything = project(gaussians, camera, options)
        visible = visible_splats(everything, camera)
        radii = torch.where(visible, everything.radii(), 0.0)
        index = torch.nonzero(visible)[:, 0]
        index = index[torch.argsort(everything.depths[index], stable=True)]
    splats = project(gaussians.select(index), camera, options)  # NaNs of the others must not reach the gradient
    probe = torch.zeros_like(splats.means) if means2d_probe is None else means2d_probe[index]

    rows = max(1, _PAIRS_AT_ONCE // (max(1, len(index)) * camera.width))
    background = torch.tensor(options.background, dtype=probe.dtype, device=probe.device)
    bands = []
    for top in range(0, camera.height, rows):
        size = (top, min(top + rows, camera.height), camera.width, options.magnitudes, options.depth_origin)
        values = (
            splats.means,
            probe,
            splats.depths,
            splats.covariances,
            splats.determinants,
            splats.depth_slopes,
            splats.opacities,
            splats.colours,
        )
        bands.append(checkpoint(_blend_rows, size, background, *values, use_reentrant=False, preserve_rng_state=False))
    colour, alpha, depth_sum, depth_square_sum, median_depth = (torch.cat(parts) for parts in zip(*bands, strict=True))
    if not options.depth:
        depth_sum = depth_square_sum = median_depth = alpha.new_zeros(()).expand(alpha.shape)
    return Render(colour, alpha, depth_sum, depth_square_sum, median_depth.detach(), visible, radii)


class _SumOfMagnitudes(torch.autograd.Function):
    """Broadcasts (n, 2) to r x w pixels; its gradient is the sum of the pixels' absolute values."""

    @staticmethod
    def forward(_ctx: Any, values: Tensor, rows: int, columns: int) -> Tensor:
        return values[:, None, None].expand(-1, rows, columns, -1)

    @staticmethod
    def backward(_ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        return upstream[0].abs().sum((1, 2)), None, None


def _blend_rows(
    size: tuple[int, int, int, bool, float],
    background: Float[Tensor, " 3"],
    means: Float[Tensor, "n 2"],
    probe: Float[Tensor, "n 2"],
    depths: Float[Tensor, " n"],
    covariances: Float[Tensor, "n 3"],
    determinants: Float[Tensor, " n"],
    depth_slopes: Float[Tensor, "n 2"],
    opacities: Float[Tensor, " n"],
    colours: Float[Tensor, "n 3"],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Rows top..bottom of the image: colour (r, w, 3), alpha, depth sum, sum of squares, median depth (r, w)."""
    top, bottom, width, magnitudes, depth_origin = size
    ys = torch.arange(top, bottom, dtype=means.dtype, device=means.device) + 0.5
    xs = torch.arange(width, dtype=means.dtype, device=means.device) + 0.5
    shift = probe[:, None, None]  # (n, r, w, 2), or broadcast
    if magnitudes:
        shift = _SumOfMagnitudes.apply(probe, bottom - top, width)  # type: ignore[no-untyped-call]
    dx = (xs[None, :] - means[:, None, 0])[:, None, :] - shift[..., 0]  # (n, r, w), or broadcast
    dy = (ys[None, :] - means[:, None, 1])[:, :, None] - shift[..., 1]
    xy, yy = covariances[:, 1, None, None], covariances[:, 2, None, None]
    # dᵀ Σ'⁻¹ d as a sum of squares, which does not cancel in long thin Gaussians.
    distance2 = (dx - xy / yy * dy) ** 2 * (yy / determinants[:, None, None]) + dy**2 / yy  # (n, r, w)
    alphas = (opacities[:, None, None] * torch.exp(-0.5 * distance2)).clamp_max(ALPHA_MAX)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, 0.0)
    # The transmittance never grows, so once below the limit it stays there for all that follow.
    alphas = torch.where(torch.cumprod(1.0 - alphas, 0) >= TRANSMITTANCE_MIN, alphas, 0.0)
    after = torch.cumprod(1.0 - alphas, 0)
    ones = torch.ones_like(after[:1]) if len(after) else after.new_ones(1, bottom - top, width)
    before = torch.cat([ones, after])[: len(after)]
    weights = alphas * before
    left = after[-1] if len(after) else ones[0]  # (r, w)
    colour = torch.einsum("nrw,nc->rwc", weights, colours) + left[..., None] * background
    # The probe moves a Gaussian's colour and opacity, not its depth.
    right, down = (xs[None, :] - means[:, None, 0])[:, None, :], (ys[None, :] - means[:, None, 1])[:, :, None]
    at_centre = depths[:, None, None]
    at_pixel = at_centre + depth_slopes[:, 0, None, None] * right + depth_slopes[:, 1, None, None] * down  # (n, r, w)
    depth_sum = (weights * at_pixel).sum(0)
    depth_square_sum = (weights * torch.square(at_pixel - depth_origin)).sum(0)
    passes = (before > MEDIAN_TRANSMITTANCE) & (after <= MEDIAN_TRANSMITTANCE)
    least, most = (1.0 - MEDIAN_SHIFT_MAX) * at_centre, (1.0 + MEDIAN_SHIFT_MAX) * at_centre
    median_depth = torch.where(passes, at_pixel.clamp(least, most), 0.0).sum(0)
    return colour, 1.0 - left, depth_sum, depth_square_sum, median_depth
