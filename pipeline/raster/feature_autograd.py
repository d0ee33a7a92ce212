"""Projection, spherical harmonics and blending of features by kernels, under torch's autograd.

The functions of ``feature_reference``, over what a backend's kernels do with one view at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.feature_definitions import BlendOptions, Projected, ProjectionOptions, Steps, View

Optionals = Sequence[Tensor | None]


class FeatureSplats(NamedTuple):
    """What is blended in a view: fields of ``Projected``, opacities (n,) with their factors, and features (n, d)."""

    means2d: Tensor
    depths: Tensor
    covariances: Tensor
    determinants: Tensor
    opacities: Tensor
    features: Tensor
    slants: Tensor | None
    radii: Tensor


@runtime_checkable
class FeatureFrame(Protocol):
    """A view's blended features, with what the backward pass needs."""

    def forward(
        self, splats: FeatureSplats, options: BlendOptions, background: Tensor | None, pictures: tuple[Tensor, Tensor]
    ) -> None:
        """Blend; writes the images (h, w, d) and alpha (h, w)."""

    def backward(self, splats: FeatureSplats, gradients: Optionals, outputs: Optionals) -> None:
        """Add gradients to ``outputs``, from those of the images and alpha (None for zero).

        Args:
            splats: Those of forward().
            gradients: Of the images and of alpha.
            outputs: Of means2d, covariances, opacities, features, slants; and the sums of each pixel's absolute
                gradient by means2d. The last two may be None.
        """


@runtime_checkable
class FeatureKernels(Protocol):
    """A backend, for contiguous float32 tensors of one view."""

    def project(self, gaussians: Sequence[Tensor], view: View, options: ProjectionOptions, fields: Optionals) -> None:
        """Project means, quats, scales, opacities; writes the fields of ``Projected``."""

    def project_backward(
        self,
        gaussians: Sequence[Tensor],
        view: View,
        options: ProjectionOptions,
        radii: Tensor,
        gradients: Optionals,
        outputs: Sequence[Tensor],
    ) -> None:
        """Add gradients by means, quats, scales, from those of means2d, depths, covariances, compensations, slants."""

    def sh_colours(self, rows: Sequence[Tensor], view: View, degree: int, colours: Tensor) -> None:
        """Find colours (n, 3) of means, coefficients, radii."""

    def sh_colours_backward(
        self, rows: Sequence[Tensor], view: View, degree: int, gradient: Tensor, outputs: Sequence[Tensor]
    ) -> None:
        """Add gradients by means and coefficients, from that of the colours."""

    def new_frame(self) -> FeatureFrame:
        """Return a frame for one view."""


def steps_of(kernels: FeatureKernels) -> Steps:
    """The functions of ``feature_reference`` by a backend's kernels."""

    def project(
        views: Sequence[View],
        options: ProjectionOptions,
        means: Float[Tensor, "s n 3"],
        quats: Float[Tensor, "s n 4"],
        scales: Float[Tensor, "s n 3"],
        opacities: Float[Tensor, "s n"],
    ) -> Projected:
        fields = _Project.apply(kernels, tuple(views), options, means, quats, scales, opacities.detach())  # type: ignore[no-untyped-call]
        return Projected(*fields)

    def sh_colours(
        views: Sequence[View],
        degree: int,
        means: Float[Tensor, "s n 3"],
        sh: Float[Tensor, "f n k 3"],
        radii: Int32[Tensor, "v n 2"],
    ) -> Float[Tensor, "v n 3"]:
        colours: Tensor = _ShColours.apply(kernels, tuple(views), degree, radii, means, sh)  # type: ignore[no-untyped-call]
        return colours

    def blend(
        options: BlendOptions,
        splats: Projected,
        opacities: Float[Tensor, "v n"],
        features: Float[Tensor, "f n d"],
        backgrounds: Float[Tensor, "v d"] | None,
        magnitudes: Float[Tensor, "v n 2"] | None,
    ) -> tuple[Float[Tensor, "v h w d"], Float[Tensor, "v h w"]]:
        placed = (splats.depths.detach(), splats.determinants, splats.radii)
        leaves = (splats.means2d, splats.covariances, opacities, features, splats.slants, backgrounds)
        shown, alpha = _Blend.apply(kernels, options, magnitudes, placed, *leaves)  # type: ignore[no-untyped-call]
        return shown, alpha

    return Steps(project, sh_colours, blend)


class _Project(torch.autograd.Function):
    """Forward and backward pass of the projection."""

    @staticmethod
    def forward(
        ctx: Any, kernels: FeatureKernels, views: tuple[View, ...], options: ProjectionOptions, *leaves: Tensor
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
            kernels.project(scene, view, options, _of_view(fields, index))
        ctx.kernels, ctx.views, ctx.options = kernels, views, options
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
            ctx.kernels.project_backward(
                tuple(each[scene] for each in gaussians),
                view,
                ctx.options,
                radii[index],
                _of_view(gradients, index),
                tuple(each[scene] for each in outputs),
            )
        return None, None, None, *outputs, None


def _of_view(tensors: Optionals, index: int) -> tuple[Tensor | None, ...]:
    return tuple(None if each is None else each[index] for each in tensors)


class _ShColours(torch.autograd.Function):
    """Forward and backward pass of spherical harmonics."""

    @staticmethod
    def forward(
        ctx: Any,
        kernels: FeatureKernels,
        views: tuple[View, ...],
        degree: int,
        radii: Tensor,
        means: Tensor,
        sh: Tensor,
    ) -> Tensor:
        means, sh = means.detach().contiguous(), sh.detach().contiguous()
        colours = means.new_empty(len(views), means.shape[1], 3)
        for index, view in enumerate(views):
            mine = (means[index * len(means) // len(views)], sh[index * len(sh) // len(views)], radii[index])
            kernels.sh_colours(mine, view, degree, colours[index])
        ctx.kernels, ctx.views, ctx.degree = kernels, views, degree
        ctx.save_for_backward(means, sh, radii)
        return colours

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        means, sh, radii = ctx.saved_tensors
        gradient, by_means, by_sh = upstream[0].contiguous(), torch.zeros_like(means), torch.zeros_like(sh)
        for index, view in enumerate(ctx.views):
            scene, row = index * len(means) // len(ctx.views), index * len(sh) // len(ctx.views)
            mine, outputs = (means[scene], sh[row], radii[index]), (by_means[scene], by_sh[row])
            ctx.kernels.sh_colours_backward(mine, view, ctx.degree, gradient[index], outputs)
        return None, None, None, None, by_means, by_sh


class _Blend(torch.autograd.Function):
    """Forward and backward pass of the blending."""

    @staticmethod
    def forward(
        ctx: Any,
        kernels: FeatureKernels,
        options: BlendOptions,
        magnitudes: Tensor | None,
        placed: tuple[Tensor, Tensor, Tensor],
        *leaves: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        values = tuple(None if leaf is None else leaf.detach().contiguous() for leaf in leaves)
        *splats, backgrounds = values
        shown, alpha = _new_images(placed[0], options, leaves[3].shape[-1])  # type: ignore[union-attr]
        differentiable, frames = any(ctx.needs_input_grad), []
        for index in range(len(placed[0])):
            frame = kernels.new_frame()
            background = None if backgrounds is None else backgrounds[index]
            frame.forward(_arrays(placed, splats, index), options, background, (shown[index], alpha[index]))
            if differentiable:
                frames.append(frame)
        ctx.set_materialize_grads(False)
        if differentiable:
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
            frame.backward(_arrays((depths, determinants, radii), splats, index), pictures, (*mine, sums))
        by_background = None
        if backgrounds is not None and ctx.needs_input_grad[-1] and shown is not None:
            by_background = torch.einsum("vhwd,vhw->vd", shown, 1.0 - alpha)
        return None, None, None, None, *outputs, by_background


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


def _of_splats(splats: Optionals, index: int, views: int) -> tuple[Tensor | None, ...]:
    """Those of a view: every tensor has a row for each view, or features one for each scene."""
    return tuple(None if each is None else each[index * len(each) // views] for each in splats)


def _arrays(placed: tuple[Tensor, Tensor, Tensor], splats: Optionals, index: int) -> FeatureSplats:
    depths, determinants, radii = (each[index] for each in placed)
    means2d, covariances, opacities, features, slants = _of_splats(splats, index, len(placed[0]))
    return FeatureSplats(means2d, depths, covariances, determinants, opacities, features, slants, radii)  # type: ignore[arg-type]
