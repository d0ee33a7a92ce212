"""``rasterization``: Gaussians to images with gsplat's signature, names and conventions, differentiable."""

from __future__ import annotations

import functools
import warnings
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import kernels_of
from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason
from splatpipe.pipeline.raster.cuda_features import CudaFeatures
from splatpipe.pipeline.raster.feature_autograd import steps_of
from splatpipe.pipeline.raster.feature_definitions import BlendOptions, Projected, ProjectionOptions, Steps
from splatpipe.pipeline.raster.feature_kernels import NATIVE
from splatpipe.pipeline.raster.feature_reference import REFERENCE
from splatpipe.pipeline.raster.rasterization_arguments import (
    DepthMode,
    RasterizeMode,
    RenderMode,
    Scene,
    check_numbers,
    find_backgrounds,
    find_scene,
    find_views,
    refuse_what_is_not_there,
)

_ED_ALPHA_MIN = 1e-10
"""The expected depth divides by at least this alpha, as gsplat does."""


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole"] = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: object | None = None,
    rolling_shutter: object | None = None,
    viewmats_rs: Tensor | None = None,
    *,
    alpha_max: float = 0.999,
    compensation_min: float = 0.0,
    plane_sigmas: float = 0.0,
    depth: DepthMode = "centre",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render 3D Gaussians as cameras see them; differentiable in means, quats, scales, opacities and colors.

    Order, names and defaults of the arguments are those of gsplat 1.5.3 (but for ``packed``, which is True there), so
    that a script swaps one import; the last four, by name only, are what splatpipe's own renders do otherwise. Batches
    lead with any dimensions (``...``), the same for all tensors.

    In float32 native kernels render: on the CPU bit-identical for any number of threads, on a CUDA device from run to
    run. In float64, and on a device for which there are no kernels, the torch reference does: correct, but slow, and
    memory grows with pixels times Gaussians.

    Args:
        means: Centres (..., N, 3), world units.
        quats: Orientations (..., N, 4), (w, x, y, z), of any length.
        scales: Standard deviations along the axes (..., N, 3), world units, of either sign.
        opacities: (..., N), 0..1.
        colors: Features of any number D of channels, (..., N, D) or (..., C, N, D) for each view, not clamped; with
            ``sh_degree`` spherical harmonics (..., N, K, 3) or (..., C, N, K, 3), whose colours are clamped at 0.
        viewmats: World to camera (..., C, 4, 4); x right, y down, z forward. No gradient.
        Ks: Pinhole intrinsics (..., C, 3, 3), pixels; the first pixel's centre is (0.5, 0.5). No gradient.
        width: Of the images, pixels.
        height: Of the images, pixels.
        near_plane: Gaussians whose centre is nearer are skipped, world units along the view axis.
        far_plane: Gaussians whose centre is farther are skipped.
        radius_clip: Gaussians whose radii on screen are at most this are skipped, pixels.
        eps2d: Added to the variances on screen, px².
        sh_degree: Degree that is used, 0..3, at most that of ``colors``; None if ``colors`` are features.
        packed: Must be False.
        tile_size: Accepted and ignored: tiles have 16 pixels a side.
        backgrounds: Behind everything (..., C, D), without the depth's channel; None for zeros.
        render_mode: ``RGB``: the features. ``D``: accumulated depth Σ z α T. ``ED``: expected depth, the same over
            alpha. ``RGB+D``, ``RGB+ED``: features, and the depth as the last channel.
        sparse_grad: Must be False.
        absgrad: ``meta["means2d"].absgrad`` gets the sums of each pixel's |dL/d(means2d)|, of every backward pass.
        rasterize_mode: ``antialiased`` scales opacities by √(det Σ' / det(Σ' + eps2d I)) ("Mip-Splatting", Yu et al.
            2024).
        channel_chunk: Accepted and ignored: all channels are blended at once.
        distributed: Must be False.
        camera_model: Must be ``pinhole``.
        segmented: Accepted and ignored.
        covars: Must be None.
        with_ut: Must be False.
        with_eval3d: Must be False.
        radial_coeffs: Must be None, and so must all that follow up to ``viewmats_rs``.
        tangential_coeffs: See above.
        thin_prism_coeffs: See above.
        ftheta_coeffs: See above.
        rolling_shutter: See above; gsplat's global shutter is accepted.
        viewmats_rs: See above.
        alpha_max: Cap on a pixel's alpha; 0.99 in splatpipe's own renders.
        compensation_min: Floor of det Σ' / det(Σ' + eps2d I) in the anti-aliased mode; 2.5e-5 there.
        plane_sigmas: Gaussians that reach the camera plane within this many standard deviations are skipped; 0 for
            none, 2 there.
        depth: ``centre``: a Gaussian's depth is its centre's. ``ray``: it is where each pixel's ray peaks in it, as
            there.

    Returns:
        The images (..., C, height, width, X), X = D, 1 or D + 1 by ``render_mode``; alpha (..., C, height, width, 1);
        and ``meta`` with what gsplat's strategies read: ``means2d`` (..., C, N, 2) in pixels, on which
        ``retain_grad()`` works; ``radii`` (..., C, N, 2) in whole pixels, 0 where unseen; ``depths`` and ``opacities``
        (..., C, N), the latter with the factor of the anti-aliased mode; ``conics`` (..., C, N, 3), without gradient;
        ``gaussian_ids``, ``camera_ids`` and ``batch_ids``, None as in gsplat's unpacked mode; ``width``, ``height``,
        ``tile_size``, ``n_batches`` and ``n_cameras``.

    Raises:
        ValueError: if shapes, dtypes or devices do not fit each other, a value is not finite, or a number is out of
            range.
        NotImplementedError: for what is not there.
        SplatpipeError: if the Gaussians cover more pixels than memory or 32-bit indices allow, or the images do not
            fit into memory.
    """
    del channel_chunk, segmented
    refuse_what_is_not_there(
        {
            "packed=True": packed,
            "sparse_grad=True": sparse_grad,
            "distributed=True": distributed,
            f"camera_model={camera_model!r}": camera_model != "pinhole",
            "covars": covars is not None,
            "with_ut=True": with_ut,
            "with_eval3d=True": with_eval3d,
            "a distorted camera (radial_coeffs)": radial_coeffs is not None,
            "a distorted camera (tangential_coeffs)": tangential_coeffs is not None,
            "a distorted camera (thin_prism_coeffs)": thin_prism_coeffs is not None,
            "a distorted camera (ftheta_coeffs)": ftheta_coeffs is not None,
            "a rolling shutter": getattr(rolling_shutter, "name", rolling_shutter) not in (None, "GLOBAL"),
            "a second pose (viewmats_rs)": viewmats_rs is not None,
        }
    )
    scene = find_scene(means, quats, scales, opacities, colors, viewmats, Ks, sh_degree)
    check_numbers(
        {"render_mode": render_mode, "rasterize_mode": rasterize_mode, "depth": depth},
        {"width": width, "height": height},
        {
            "near_plane": near_plane,
            "far_plane": far_plane,
            "radius_clip": radius_clip,
            "eps2d": eps2d,
            "alpha_max": alpha_max,
            "compensation_min": compensation_min,
            "plane_sigmas": plane_sigmas,
        },
    )
    projection = ProjectionOptions(
        near=float(near_plane),
        far=float(far_plane),
        blur_px2=float(eps2d),
        plane_sigmas=float(plane_sigmas),
        compensate=rasterize_mode == "antialiased",
        compensation_min=float(compensation_min),
        radius_clip=float(radius_clip),
        slants=render_mode != "RGB" and depth == "ray",
    )
    scene = replace(scene, views=find_views(scene, viewmats, Ks, int(width), int(height)))
    behind = find_backgrounds(scene, backgrounds)
    blending = BlendOptions(int(width), int(height), float(alpha_max))
    shown, alpha, meta = _render(scene, projection, blending, behind, render_mode, absgrad)
    return shown, alpha, meta | {"width": width, "height": height, "tile_size": tile_size}


def _render(
    scene: Scene,
    projection: ProjectionOptions,
    blending: BlendOptions,
    backgrounds: Tensor | None,
    render_mode: RenderMode,
    absgrad: bool,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Project, find colours, blend; backgrounds are (v, d); results as of ``rasterization``."""
    steps = _steps_for(scene.means.device, scene.means.dtype)
    projected = steps.project(scene.views, projection, scene.means, scene.quats, scene.scales, scene.opacities)
    of_gaussians = (*scene.lead, scene.cameras, scene.means.shape[1])
    means2d = projected.means2d.reshape(*of_gaussians, 2)  # the caller asks this very tensor for its gradient
    projected = replace(projected, means2d=means2d.reshape(projected.means2d.shape))
    opacities = scene.opacities.repeat_interleave(scene.cameras, 0)
    if projected.compensations is not None:
        opacities = opacities * projected.compensations
    magnitudes = None
    if absgrad:
        magnitudes = torch.zeros_like(projected.means2d)
        means2d.absgrad = magnitudes.view(means2d.shape)  # type: ignore[attr-defined]

    features = scene.colors
    if scene.sh_degree is not None and render_mode not in ("D", "ED"):
        features = steps.sh_colours(scene.views, scene.sh_degree, scene.means, scene.colors, projected.radii)
    if render_mode != "RGB":
        features, backgrounds = _with_depth(render_mode, features, projected.depths, backgrounds)
    shown, alpha = steps.blend(blending, projected, opacities, features, backgrounds, magnitudes)
    if render_mode in ("ED", "RGB+ED"):
        expected = shown[..., -1:] / alpha[..., None].clamp_min(_ED_ALPHA_MIN)
        shown = torch.cat([shown[..., :-1], expected], -1)

    meta = {
        "batch_ids": None,
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": projected.radii.reshape(*of_gaussians, 2),
        "means2d": means2d,
        "depths": projected.depths.reshape(of_gaussians),
        "conics": _conics(projected).reshape(*of_gaussians, 3),
        "opacities": opacities.reshape(of_gaussians),
        "n_batches": len(scene.means),
        "n_cameras": scene.cameras,
    }
    of_pixels = (*of_gaussians[:-1], blending.height, blending.width)
    return shown.reshape(*of_pixels, shown.shape[-1]), alpha.reshape(*of_pixels, 1), meta


def _with_depth(
    render_mode: RenderMode,
    features: Tensor,
    depths: Tensor,
    backgrounds: Tensor | None,
) -> tuple[Tensor, Tensor | None]:
    """Features (f, n, d) with depths (v, n) as their last channel, or the depths alone; these are 0 behind all."""
    if render_mode in ("D", "ED"):
        return depths[..., None], None
    each = features.repeat_interleave(len(depths) // len(features), 0)  # (v, n, d)
    if backgrounds is not None:
        backgrounds = torch.cat([backgrounds, torch.zeros_like(backgrounds[:, :1])], -1)
    return torch.cat([each, depths[..., None]], -1), backgrounds


@torch.no_grad()
def _conics(projected: Projected) -> Tensor:
    """The upper triangles (v, n, 3) of the inverse covariances; zeros where not visible."""
    xx, xy, yy = projected.covariances.unbind(-1)
    determinants = torch.where(projected.determinants > 0.0, projected.determinants, 1.0)
    return torch.stack([yy, -xy, xx], -1) / determinants[..., None]


def _steps_for(device: torch.device, dtype: torch.dtype) -> Steps:
    """The fastest backend for a device's tensors."""
    if dtype != torch.float32:
        return REFERENCE
    if (kernels := kernels_of(device)) is not None:
        return steps_of(CudaFeatures(kernels))
    if device.type == "cpu":
        return NATIVE
    _warn_of_reference(device.type)
    return REFERENCE


@functools.cache
def _warn_of_reference(device: str) -> None:
    missing = unavailable_reason() if device == "cuda" else None
    why = f"There are none for {device}." if missing is None else f"{missing.reason} {missing.hint}"
    warnings.warn(
        f"The slow torch reference renders, not rasterization's kernels. {why}",
        stacklevel=5,  # the caller of rasterization
    )
