"""The C interface of the CUDA kernels, `native/cuda/api.h`, for ctypes. The fields are documented there."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_char, c_double, c_float, c_int32, c_int64, c_uint64, c_void_p
from typing import Any

ABI = 5
"""Version of the interface mirrored here, SPLAT_CUDA_ABI."""
NO_KERNEL = -3
"""SPLAT_NO_KERNEL: this binary has no kernel for the device."""
ADAM_TENSORS = 8
"""Maximum number of tensors in one call of ``splat_adam``."""
INLINE_CHANNELS = 4
"""SPLAT_INLINE_CHANNELS: features of more channels are in rows of whole groups of four."""


class SplatStream(ctypes.Structure):
    _fields_ = (("stream", c_void_p), ("device", c_int32), ("reserved", c_int32))


class SplatDevice(ctypes.Structure):
    _fields_ = (
        ("architecture", c_int32),
        ("driver", c_int32),
        ("runtime", c_int32),
        ("multiprocessors", c_int32),
        ("memory_bytes", c_int64),
        ("name", c_char * 256),
    )


class SplatShot(ctypes.Structure):
    _fields_ = (
        ("cam_from_world", c_double * 12),
        ("fx", c_double),
        ("fy", c_double),
        ("cx", c_double),
        ("cy", c_double),
        ("near_z", c_double),
        ("depth_origin", c_double),
        ("background", c_double * 3),
        ("width", c_int32),
        ("height", c_int32),
        ("left", c_int32),
        ("top", c_int32),
        ("whole_width", c_int32),
        ("whole_height", c_int32),
        ("sh_degree", c_int32),
        ("sh_count", c_int32),
        ("antialias", c_int32),
        ("depths", c_int32),
        ("magnitudes", c_int32),
        ("reserved", c_int32),
    )


class SplatRows(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in ("means", "log_scales", "quats", "opacity_logits", "sh"))


class SplatPictures(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in ("colour", "alpha", "depth_sum", "depth_square_sum", "median_depth"))


class SplatPictureGradients(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in ("colour", "alpha", "depth_sum", "depth_square_sum"))


class SplatRectangle(ctypes.Structure):
    _fields_ = (("left", c_int32), ("top", c_int32), ("right", c_int32), ("bottom", c_int32))


class SplatFrame(ctypes.Structure):
    _fields_ = (
        ("memory", c_void_p),
        ("bytes", c_int64),
        ("back", c_void_p),
        ("back_bytes", c_int64),
        ("count", c_int64),
        ("capacity", c_int64),
        ("passes", c_int32),
        ("reserved", c_int32),
    )


class SplatFrameFacts(ctypes.Structure):
    _fields_ = (("pairs", c_int64), ("visible", c_int64), ("chunks", c_int64))


class SplatStep(ctypes.Structure):
    _fields_ = (
        ("values", SplatRows),
        ("means", SplatRows),
        ("squares", SplatRows),
        ("rows", c_int64),
        ("rates", c_float * 5),
        ("rate_sh_rest", c_float),
        ("beta1", c_double),
        ("beta2", c_double),
        ("epsilon", c_double),
        ("step", c_int64),
        ("sparse", c_int32),
        ("reserved", c_int32),
        ("log_scale_min", c_float),
        ("log_scale_max", c_float),
        ("logit_gain", c_void_p),
        ("logits", c_void_p),
        ("skipped", c_void_p),
    )


class SplatAdam(ctypes.Structure):
    _fields_ = (
        ("tensors", c_int32),
        ("widths", c_int32 * ADAM_TENSORS),
        ("values", c_void_p * ADAM_TENSORS),
        ("gradients", c_void_p * ADAM_TENSORS),
        ("means", c_void_p * ADAM_TENSORS),
        ("squares", c_void_p * ADAM_TENSORS),
        ("rates", c_void_p * ADAM_TENSORS),
        ("rows", c_int64),
        ("visible", c_void_p),
        ("beta1", c_double),
        ("beta2", c_double),
        ("epsilon", c_double),
        ("step", c_int64),
        ("skipped", c_void_p),
    )


class SplatSky(ctypes.Structure):
    _fields_ = (
        ("width", c_int32),
        ("height", c_int32),
        ("rows", c_int32),
        ("columns", c_int32),
        ("step", c_int32),
        ("background", c_float * 3),
        ("colour", c_void_p),
        ("alpha", c_void_p),
        ("nodes", c_void_p),
        ("elsewhere", c_void_p),
        ("around", c_void_p),
        ("mask", c_void_p),
    )


class SplatActivated(ctypes.Structure):
    _fields_ = (("count", c_int64), *((name, c_void_p) for name in ("means", "quats", "scales", "opacities")))


class SplatActivatedGradients(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in ("means", "quats", "scales"))


class SplatProjectOptions(ctypes.Structure):
    _fields_ = (
        ("far_z", c_float),
        ("blur_px2", c_float),
        ("plane_sigmas", c_float),
        ("compensation_min", c_float),
        ("radius_clip", c_float),
        ("reserved", c_int32),
    )


class SplatProjected(ctypes.Structure):
    _fields_ = tuple(
        (name, c_void_p)
        for name in ("means2d", "depths", "covariances", "determinants", "compensations", "slants", "radii")
    )


class SplatProjectedGradients(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in ("means2d", "depths", "covariances", "compensations", "slants"))


class SplatShRows(ctypes.Structure):
    _fields_ = (
        ("count", c_int64),
        ("means", c_void_p),
        ("sh", c_void_p),
        ("radii", c_void_p),
        ("centre", c_double * 3),
    )


class SplatFeatures(ctypes.Structure):
    _fields_ = (
        ("means2d", c_void_p),
        ("depths", c_void_p),
        ("covariances", c_void_p),
        ("determinants", c_void_p),
        ("opacities", c_void_p),
        ("slants", c_void_p),
        ("radii", c_void_p),
        ("features", c_void_p),
        ("background", c_void_p),
        ("channels", c_int32),
        ("stride", c_int32),
        ("alpha_max", c_float),
        ("reserved", c_int32),
    )


class SplatFeaturePictures(ctypes.Structure):
    _fields_ = (("features", c_void_p), ("alpha", c_void_p))


class SplatFeaturePictureGradients(ctypes.Structure):
    _fields_ = (("features", c_void_p), ("alpha", c_void_p))


class SplatFeatureGradients(ctypes.Structure):
    _fields_ = tuple(
        (name, c_void_p) for name in ("means2d", "covariances", "opacities", "features", "slants", "magnitudes")
    )


STRUCTURES = (
    SplatStream,
    SplatDevice,
    SplatShot,
    SplatRows,
    SplatPictures,
    SplatPictureGradients,
    SplatRectangle,
    SplatFrame,
    SplatFrameFacts,
    SplatStep,
    SplatAdam,
    SplatSky,
    SplatActivated,
    SplatActivatedGradients,
    SplatProjectOptions,
    SplatProjected,
    SplatProjectedGradients,
    SplatShRows,
    SplatFeatures,
    SplatFeaturePictures,
    SplatFeaturePictureGradients,
    SplatFeatureGradients,
)

_SHOT, _ROWS, _FRAME, _ON = POINTER(SplatShot), POINTER(SplatRows), POINTER(SplatFrame), POINTER(SplatStream)
_RENDER = (_SHOT, _ROWS, _FRAME)
_PROJECT = (_SHOT, POINTER(SplatProjectOptions), POINTER(SplatActivated))
_BLEND = (_SHOT, POINTER(SplatFeatures), _FRAME)
_DRAW = (c_uint64, c_uint64, c_uint64)

SIZES: dict[str, tuple[Any, ...]] = {
    "splat_frame_bytes": (_SHOT, c_int64, c_int64),
    "splat_back_bytes": (_SHOT, c_int64, c_int64),
    "splat_feature_back_bytes": (_SHOT, c_int64, c_int64, c_int32),
    "splat_loss_bytes": (c_int32, c_int32),
    "splat_affine_bytes": (c_int64,),
}
"""Arguments of the functions that return a number of bytes."""
CALLS: dict[str, tuple[Any, ...]] = {
    "splat_device": (c_int32, POINTER(SplatDevice)),
    "splat_forward": (*_RENDER, POINTER(SplatPictures), c_void_p, c_void_p, _ON),
    "splat_blend_backward": (*_RENDER, POINTER(SplatPictureGradients), _ON),
    "splat_project_backward": (*_RENDER, _ROWS, c_void_p, _ON),
    "splat_step": (_SHOT, _FRAME, POINTER(SplatStep), c_void_p, _ON),
    "splat_project_activated": (*_PROJECT, POINTER(SplatProjected), _ON),
    "splat_project_activated_backward": (
        *(*_PROJECT, c_void_p, POINTER(SplatProjectedGradients)),
        *(POINTER(SplatActivatedGradients), _ON),
    ),
    "splat_sh_colours": (_SHOT, POINTER(SplatShRows), c_void_p, _ON),
    "splat_sh_colours_backward": (_SHOT, POINTER(SplatShRows), c_void_p, c_void_p, c_void_p, _ON),
    "splat_blend_features": (*_BLEND, POINTER(SplatFeaturePictures), _ON),
    "splat_blend_features_backward": (
        *(*_BLEND, POINTER(SplatFeaturePictureGradients)),
        *(POINTER(SplatFeatureGradients), _ON),
    ),
    "splat_photo_loss": (
        *(c_void_p, c_void_p, c_void_p, c_int32, c_int32, POINTER(SplatRectangle), c_double),
        *(c_void_p, c_void_p, c_void_p, c_int64, _ON),
    ),
    "splat_affine_colour": (c_void_p, c_void_p, c_int64, c_void_p, _ON),
    "splat_affine_colour_backward": (
        *(c_void_p, c_void_p, c_void_p, c_int64),
        *(c_void_p, c_void_p, c_void_p, c_int64, _ON),
    ),
    "splat_sky": (POINTER(SplatSky), c_void_p, _ON),
    "splat_sky_backward": (POINTER(SplatSky), c_void_p, c_void_p, c_void_p, _ON),
    "splat_adam": (POINTER(SplatAdam), _ON),
    "splat_uniform": (*_DRAW, c_int64, c_void_p, _ON),
    "splat_split_offsets": (*_DRAW, c_void_p, c_int64, c_void_p, c_void_p, c_void_p, _ON),
    "splat_morton": (c_void_p, c_int64, POINTER(c_float), POINTER(c_float), c_void_p, _ON),
}
"""Arguments of the functions that return a code: 0, or an error."""
