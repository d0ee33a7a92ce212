"""The CUDA kernels of projection, spherical harmonics and blending of features.

Nothing waits for the device, and everything runs in order on torch's current stream there. ``feature_reference``
defines what they do; the same card, driver and version give the same bits.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels
from splatpipe.pipeline.raster.cuda.cuda_api import (
    INLINE_CHANNELS,
    SplatActivated,
    SplatActivatedGradients,
    SplatFeatureGradients,
    SplatFeaturePictureGradients,
    SplatFeaturePictures,
    SplatFeatures,
    SplatFrame,
    SplatProjected,
    SplatProjectedGradients,
    SplatProjectOptions,
    SplatShot,
    SplatShRows,
)
from splatpipe.pipeline.raster.cuda.cuda_forecast import FrameAllocation, FrameSize
from splatpipe.pipeline.raster.cuda_frame import TILE_PX
from splatpipe.pipeline.raster.feature_autograd import FeatureFrame, FeatureSplats, Optionals
from splatpipe.pipeline.raster.feature_definitions import BlendOptions, ProjectionOptions, View

ROW_BYTES = 16  # features of more than INLINE_CHANNELS are read in fours, aligned to this


def shot_of(view: View, near: float = 0.0, degree: int = 0, coefficients: int = 1) -> SplatShot:
    """A view in the form that the library takes; the degree of spherical harmonics, and how many there are."""
    camera = view.camera
    shot = SplatShot(near_z=near, sh_degree=degree, sh_count=coefficients)
    shot.cam_from_world[:] = np.asarray(camera.cam_from_world, np.float64)[:3].ravel().tolist()
    shot.fx, shot.fy, shot.cx, shot.cy = camera.fx, camera.fy, camera.cx, camera.cy
    return _sized(shot, camera.width, camera.height)


def _sized(shot: SplatShot, width: int, height: int) -> SplatShot:
    shot.width = shot.whole_width = width
    shot.height = shot.whole_height = height
    return shot


class CudaFeatures:
    """``FeatureKernels`` of a CUDA device.

    Args:
        kernels: The kernels to use.
    """

    def __init__(self, kernels: CudaKernels) -> None:
        self._kernels = kernels

    def _gaussians(self, gaussians: Sequence[Tensor]) -> SplatActivated:
        return SplatActivated(len(gaussians[0]), *map(self._kernels.at, gaussians))

    def project(self, gaussians: Sequence[Tensor], view: View, options: ProjectionOptions, fields: Optionals) -> None:
        self._kernels.call(
            "splat_project_activated",
            ctypes.byref(shot_of(view, options.near)),
            ctypes.byref(_numbers(options)),
            ctypes.byref(self._gaussians(gaussians)),
            ctypes.byref(SplatProjected(*map(self._kernels.at, fields))),
        )

    def project_backward(
        self,
        gaussians: Sequence[Tensor],
        view: View,
        options: ProjectionOptions,
        radii: Tensor,
        gradients: Optionals,
        outputs: Sequence[Tensor],
    ) -> None:
        self._kernels.call(
            "splat_project_activated_backward",
            ctypes.byref(shot_of(view, options.near)),
            ctypes.byref(_numbers(options)),
            ctypes.byref(self._gaussians(gaussians)),
            self._kernels.at(radii),
            ctypes.byref(SplatProjectedGradients(*map(self._kernels.at, gradients))),
            ctypes.byref(SplatActivatedGradients(*map(self._kernels.at, outputs))),
        )

    def _sh_rows(self, rows: Sequence[Tensor], view: View) -> SplatShRows:
        given = SplatShRows(len(rows[0]), *map(self._kernels.at, rows))
        given.centre[:] = view.centre.tolist()
        return given

    def sh_colours(self, rows: Sequence[Tensor], view: View, degree: int, colours: Tensor) -> None:
        shot, given = shot_of(view, 0.0, degree, rows[1].shape[1]), self._sh_rows(rows, view)
        self._kernels.call("splat_sh_colours", ctypes.byref(shot), ctypes.byref(given), self._kernels.at(colours))

    def sh_colours_backward(
        self, rows: Sequence[Tensor], view: View, degree: int, gradient: Tensor, outputs: Sequence[Tensor]
    ) -> None:
        shot, given = shot_of(view, 0.0, degree, rows[1].shape[1]), self._sh_rows(rows, view)
        written = map(self._kernels.at, (gradient, *outputs))
        self._kernels.call("splat_sh_colours_backward", ctypes.byref(shot), ctypes.byref(given), *written)

    def new_frame(self) -> FeatureFrame:
        return CudaFeatureFrame(self._kernels)


def _numbers(options: ProjectionOptions) -> SplatProjectOptions:
    return SplatProjectOptions(
        options.far, options.blur_px2, options.plane_sigmas, options.compensation_min, options.radius_clip
    )


class CudaFeatureFrame:
    """``FeatureFrame`` of a CUDA device.

    Args:
        kernels: The kernels to use.

    Raises:
        MachineError: in either pass, if there is too little memory on the device.
    """

    def __init__(self, kernels: CudaKernels) -> None:
        self._kernels = kernels
        self._memory = torch.empty(0, dtype=torch.uint8)
        self._room = FrameAllocation(0, 0)
        self._options = BlendOptions(0, 0, 0.0)
        self._background: Tensor | None = None

    def forward(
        self, splats: FeatureSplats, options: BlendOptions, background: Tensor | None, pictures: tuple[Tensor, Tensor]
    ) -> None:
        """Blend. If memory is short, chunks are made smaller."""
        self._options, self._background = options, background
        kernels, shot = self._kernels, self._shot()
        tiles = -(-options.width // TILE_PX) * -(-options.height // TILE_PX)
        size, forecast = FrameSize(len(splats.features), tiles), kernels.feature_forecast
        try:
            features = _rows(splats.features)
            self._room = forecast.room(size)
            while True:
                try:
                    self._memory = kernels.empty(kernels.frame_bytes(shot, size.count, self._room.capacity))
                    break
                except torch.OutOfMemoryError:
                    if not forecast.shrink():
                        raise
                    self._room = forecast.room(size)
        except torch.OutOfMemoryError as error:
            raise _short_of_memory(splats) from error
        kernels.call(
            "splat_blend_features",
            ctypes.byref(shot),
            ctypes.byref(self._given(splats, features)),
            ctypes.byref(self._frame(size.count, None)),
            ctypes.byref(SplatFeaturePictures(*map(kernels.at, pictures))),
        )
        forecast.read_later(self._memory, size, self._room.capacity)

    def backward(self, splats: FeatureSplats, gradients: Optionals, outputs: Optionals) -> None:
        kernels, shot, (by_pictures, by_alpha) = self._kernels, self._shot(), gradients
        count, channels = splats.features.shape
        try:
            features = _rows(splats.features)
            back = kernels.empty(kernels.feature_back_bytes(shot, count, self._room.capacity, channels))
            planes = None if by_pictures is None else by_pictures.permute(2, 0, 1).contiguous()
        except torch.OutOfMemoryError as error:
            raise _short_of_memory(splats) from error
        kernels.call(
            "splat_blend_features_backward",
            ctypes.byref(shot),
            ctypes.byref(self._given(splats, features)),
            ctypes.byref(self._frame(count, back)),
            ctypes.byref(SplatFeaturePictureGradients(kernels.at(planes), kernels.at(by_alpha))),
            ctypes.byref(SplatFeatureGradients(*map(kernels.at, outputs))),
        )

    def _shot(self) -> SplatShot:
        """One that has only a size: splats are on the screen already."""
        return _sized(SplatShot(fx=1.0, fy=1.0, sh_count=1), self._options.width, self._options.height)

    def _frame(self, count: int, back: Tensor | None) -> SplatFrame:
        return SplatFrame(
            memory=self._kernels.at(self._memory),
            bytes=self._memory.numel(),
            back=self._kernels.at(back),
            back_bytes=0 if back is None else back.numel(),
            count=count,
            capacity=self._room.capacity,
            passes=self._room.passes,
        )

    def _given(self, splats: FeatureSplats, features: Tensor) -> SplatFeatures:
        placed = (splats.means2d, splats.depths, splats.covariances, splats.determinants, splats.opacities)
        blended = (splats.slants, splats.radii, features, self._background)
        return SplatFeatures(
            *map(self._kernels.at, (*placed, *blended)),
            channels=splats.features.shape[1],
            stride=features.shape[1],
            alpha_max=self._options.alpha_max,
        )


def _rows(features: Float[Tensor, "n d"]) -> Float[Tensor, "n stride"]:
    """Features in rows as kernels read them: of more than a few channels, in whole fours."""
    channels = features.shape[1]
    if channels <= INLINE_CHANNELS:
        return features
    if channels % 4:
        return torch.nn.functional.pad(features, (0, -channels % 4))
    return features.clone() if features.data_ptr() % ROW_BYTES else features


def _short_of_memory(splats: FeatureSplats) -> MachineError:
    count, channels = splats.features.shape
    return MachineError(
        f"Not enough memory on the graphics card to rasterize {count} Gaussians with {channels} channels.",
        hint="Render fewer or smaller images at a time.",
    )
