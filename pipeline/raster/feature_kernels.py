"""The native kernels of projection, spherical harmonics and blending of features, for float32 on the CPU.

Bit-identical for any number of threads. ``feature_reference`` defines what they do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from splatpipe.pipeline.raster.autograd import refuse
from splatpipe.pipeline.raster.feature_autograd import FeatureFrame, FeatureSplats, Optionals, steps_of
from splatpipe.pipeline.raster.feature_definitions import BlendOptions, ProjectionOptions, View
from splatpipe.pipeline.raster.isa import _native

NativeView = tuple[np.ndarray, tuple[float, ...], tuple[int, int], tuple[float, float, float, float]]


def native_view(view: View) -> NativeView:
    """Pose, centre, size, and focal lengths and principal point in pixels."""
    camera = view.camera
    pose = np.ascontiguousarray(camera.cam_from_world, np.float64)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return pose, tuple(map(float, view.centre)), (camera.width, camera.height), intrinsics


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


class NativeFeatures:
    """``FeatureKernels`` of the CPU."""

    def project(self, gaussians: Sequence[Tensor], view: View, options: ProjectionOptions, fields: Optionals) -> None:
        _native.project_activated(tuple(gaussians), native_view(view), _numbers(options), tuple(fields))

    def project_backward(
        self,
        gaussians: Sequence[Tensor],
        view: View,
        options: ProjectionOptions,
        radii: Tensor,
        gradients: Optionals,
        outputs: Sequence[Tensor],
    ) -> None:
        _native.project_activated_backward(
            tuple(gaussians), native_view(view), _numbers(options), radii, tuple(gradients), tuple(outputs)
        )

    def sh_colours(self, rows: Sequence[Tensor], view: View, degree: int, colours: Tensor) -> None:
        means, sh, radii = rows
        _native.sh_colours(means, sh, radii, native_view(view), degree, colours)

    def sh_colours_backward(
        self, rows: Sequence[Tensor], view: View, degree: int, gradient: Tensor, outputs: Sequence[Tensor]
    ) -> None:
        (means, sh, radii), (by_means, by_sh) = rows, outputs
        _native.sh_colours_backward(means, sh, radii, native_view(view), degree, gradient, by_means, by_sh)

    def new_frame(self) -> FeatureFrame:
        return _NativeFrame()


class _NativeFrame:
    """``FeatureFrame`` of the CPU.

    Raises:
        SplatpipeError: in either pass, if the splats cover more of the image than memory or 32-bit indices allow.
    """

    def __init__(self) -> None:
        self._frame = _native.FeatureFrame()

    def forward(
        self, splats: FeatureSplats, options: BlendOptions, background: Tensor | None, pictures: tuple[Tensor, Tensor]
    ) -> None:
        size = (options.width, options.height)
        try:
            self._frame.forward(splats, size, options.alpha_max, background, pictures)
        except (_native.TooManyPairs, MemoryError) as error:
            refuse(error, len(splats.features))

    def backward(self, splats: FeatureSplats, gradients: Optionals, outputs: Optionals) -> None:
        try:
            self._frame.backward(splats, tuple(gradients), tuple(outputs))
        except MemoryError as error:
            refuse(error, len(splats.features))


NATIVE = steps_of(NativeFeatures())
