"""The native kernels of projection, spherical harmonics and blending of features under torch's autograd.

The same functions as in ``feature_reference``, for float32 on the CPU: bit-identical for any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.autograd import refuse
from splatpipe.pipeline.raster.feature_definitions import BlendOptions, Projected, ProjectionOptions, Steps, View
from splatpipe.pipeline.raster.isa import _native

NativeView = tuple[np.ndarray, tuple[float, ...], tuple[int, int], tuple[float, float, float, float]]


def native_view(view: View) -> NativeView:
    """Pose, centre, size, and focal lengths and principal point in pixels."""
    camera = view.camera
    pose = np.ascontiguousarray(camera.cam_from_world, np.float64)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return pose, tuple(map(float, view.centre)), (camera.width, camera.height), intrinsics


def project_native(
    views: Sequence[View],
    options: ProjectionOptions,
    means: Float[Tensor, "s n 3"],
    quats: Float[Tensor, "s n 4"],
    scales: Float[Tensor, "s n 3"],
    opacities: Float[Tensor, "s n"],
) -> Projected:
    """As ``project_reference``."""
    fields = _Project.apply(tuple(map(native_view, views)), options, means, quats, scales, opacities.detach())  # type: ignore[no-untyped-call]
    return Projected(*fields)


class _Project(torch.autograd.Function):
    """Forward and backward pass of the projection."""

    @staticmethod
    def forward(
        ctx: Any, views: tuple[NativeView, ...], options: ProjectionOptions, *leaves: Tensor
    ) -> tuple[Tensor | None, ...]:
        gaussians = tuple(leaf.detach().contiguous() for leaf in leaves)
        v, n = len(views), gaussians[0].shape[1]
        new = gaussians[0].new_empty  # torch's default dtype and device may be others
        means2d, depths, determinants = new(v, n, 2), new(v, n), new(v, n)
        covariances, radii = new(v, n, 3), new(v, n, 2, dtype=torch.int32)
        compensations = new(v, n) if options.compensate else None
        slants = new(v, n, 2) if options.slants else None
        fields = (means2d, depths, covariances, determinants, compensations, slants, radii)
        for index, view in enumerate(views):
            scene = tuple(each[index * len(each) // v] for each in gaussians)
            _native.project_activated(scene, view, _numbers(options), _of_view(fields, index))
        ctx.views, ctx.options = views, options
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(determinants, radii)
        ctx.save_for_backward(*gaussians, radii)
        return fields

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        *gaussians, radii = ctx.saved_tensors
        means2d, depths, covariances, _, compensations, slants, _ = upstream
        given = (means2d, depths, covariances, compensations, slants)
        gradients = tuple(None if each is None else each.contiguous() for each in given)
        outputs = tuple(torch.zeros_like(each) for each in gaussians[:3])
        for index, view in enumerate(ctx.views):
            scene = index * len(gaussians[0]) // len(ctx.views)
            _native.project_activated_backward(
                tuple(each[scene] for each in gaussians),
                view,
                _numbers(ctx.options),
                radii[index],
                _of_view(gradients, index),
                tuple(each[scene] for each in outputs),
            )
        return None, None, *outputs, None


def _numbers(options: ProjectionOptions) -> tuple[float, ...]:
    """In the order of the native call."""
    return (
        options.near,
        options.far,
        options.blur_px2,
        options.plane_sigmas,
        options.compensation_min,
        options.radius_clip,
    )


def _of_view(tensors: Sequence[Tensor | None], index: int) -> tuple[Tensor | None, ...]:
    return tuple(None if each is None else each[index] for each in tensors)


def sh_colours_native(
    views: Sequence[View],
    degree: int,
    means: Float[Tensor, "s n 3"],
    sh: Float[Tensor, "f n k 3"],
    radii: Int32[Tensor, "v n 2"],
) -> Float[Tensor, "v n 3"]:
    """As ``sh_colours_reference``."""
    colours: Tensor = _ShColours.apply(tuple(map(native_view, views)), degree, radii, means, sh)  # type: ignore[no-untyped-call]
    return colours


class _ShColours(torch.autograd.Function):
    """Forward and backward pass of spherical harmonics."""

    @staticmethod
    def forward(
        ctx: Any, views: tuple[NativeView, ...], degree: int, radii: Tensor, means: Tensor, sh: Tensor
    ) -> Tensor:
        means, sh = means.detach().contiguous(), sh.detach().contiguous()
        colours = means.new_empty(len(views), means.shape[1], 3)
        for index, view in enumerate(views):
            mine = (means[index * len(means) // len(views)], sh[index * len(sh) // len(views)], radii[index])
            _native.sh_colours(*mine, view, degree, colours[index])
        ctx.views, ctx.degree = views, degree
        ctx.save_for_backward(means, sh, radii)
        return colours

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        means, sh, radii = ctx.saved_tensors
        gradient, by_means, by_sh = upstream[0].contiguous(), torch.zeros_like(means), torch.zeros_like(sh)
        for index, view in enumerate(ctx.views):
            scene, row = index * len(means) // len(ctx.views), index * len(sh) // len(ctx.views)
            mine = (means[scene], sh[row], radii[index], view, ctx.degree, gradient[index])
            _native.sh_colours_backward(*mine, by_means[scene], by_sh[row])
        return None, None, None, by_means, by_sh


def blend_native(
    options: BlendOptions,
    splats: Projected,
    opacities: Float[Tensor, "v n"],
    features: Float[Tensor, "f n d"],
    backgrounds: Float[Tensor, "v d"] | None,
    magnitudes: Float[Tensor, "v n 2"] | None,
) -> tuple[Float[Tensor, "v h w d"], Float[Tensor, "v h w"]]:
    """As ``blend_reference``.

    Raises:
        SplatpipeError: if the splats cover more of the images than memory or 32-bit indices allow, or the images do
            not fit into memory.
    """
    placed = (splats.depths.detach(), splats.determinants, splats.radii)
    leaves = (splats.means2d, splats.covariances, opacities, features, splats.slants, backgrounds)
    shown, alpha = _Blend.apply(options, magnitudes, placed, *leaves)  # type: ignore[no-untyped-call]
    return shown, alpha


class _Blend(torch.autograd.Function):
    """Forward and backward pass of the blending."""

    @staticmethod
    def forward(
        ctx: Any,
        options: BlendOptions,
        magnitudes: Tensor | None,
        placed: tuple[Tensor, Tensor, Tensor],
        *leaves: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        values = tuple(None if leaf is None else leaf.detach().contiguous() for leaf in leaves)
        *splats, backgrounds = values
        v, n, d = len(placed[0]), placed[0].shape[1], leaves[3].shape[-1]  # type: ignore[union-attr]
        shown, alpha = _new_images(placed[0], options, d)
        frames = []
        for index in range(v):
            frame = _native.FeatureFrame()
            background = None if backgrounds is None else backgrounds[index]
            size = (options.width, options.height)
            arrays = _arrays(placed, splats, index)
            try:
                frame.forward(arrays, size, options.alpha_max, background, (shown[index], alpha[index]))
            except (_native.TooManyPairs, MemoryError) as error:
                refuse(error, n)
            frames.append(frame)
        ctx.set_materialize_grads(False)
        if any(ctx.needs_input_grad):
            ctx.frames, ctx.magnitudes = frames, magnitudes
            ctx.save_for_backward(*placed, *values, alpha)
        return shown, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        depths, determinants, radii, *splats, backgrounds, alpha = ctx.saved_tensors
        shown, by_alpha = (None if each is None else each.contiguous() for each in upstream)
        outputs = [None if each is None else torch.zeros_like(each) for each in splats]
        for index, frame in enumerate(ctx.frames):
            pictures = tuple(None if each is None else each[index] for each in (shown, by_alpha))
            mine = _of_splats(outputs, index, len(ctx.frames))
            sums = None if ctx.magnitudes is None else ctx.magnitudes[index]
            try:
                frame.backward(_arrays((depths, determinants, radii), splats, index), pictures, (*mine, sums))
            except MemoryError as error:
                refuse(error, depths.shape[1])
        by_background = None
        if backgrounds is not None and ctx.needs_input_grad[-1] and shown is not None:
            by_background = torch.einsum("vhwd,vhw->vd", shown, 1.0 - alpha)
        return None, None, None, *outputs, by_background


def _new_images(depths: Float[Tensor, "v n"], options: BlendOptions, channels: int) -> tuple[Tensor, Tensor]:
    """Features (v, h, w, d) and alpha (v, h, w), not filled."""
    size = (len(depths), options.height, options.width)
    try:
        return depths.new_empty(*size, channels), depths.new_empty(size)
    except RuntimeError as error:  # of torch's allocator
        raise MachineError(
            f"Not enough memory for {size[0]} images of {options.width} x {options.height} pixels with {channels} "
            "channels.",
            hint="Render fewer or smaller images at a time.",
        ) from error


def _of_splats(splats: Sequence[Tensor | None], index: int, views: int) -> tuple[Tensor | None, ...]:
    """Those of a view: every tensor has a row for each view, or features one for each scene."""
    return tuple(None if each is None else each[index * len(each) // views] for each in splats)


def _arrays(
    placed: tuple[Tensor, Tensor, Tensor], splats: Sequence[Tensor | None], index: int
) -> tuple[Tensor | None, ...]:
    """In the order of the native call."""
    depths, determinants, radii = (each[index] for each in placed)
    means2d, covariances, opacities, features, slants = _of_splats(splats, index, len(placed[0]))
    return means2d, depths, covariances, determinants, opacities, features, slants, radii


NATIVE = Steps(project_native, sh_colours_native, blend_native)
