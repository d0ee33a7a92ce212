"""The arguments of ``rasterization``: checked, and without the batch's dimensions.

Shapes are not annotated here, because what checks them must take any.
"""

from __future__ import annotations

import math
import numbers
import operator
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.feature_definitions import View
from splatpipe.pipeline.splat.model.sh import MAX_DEGREE, coefficient_count

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]
DepthMode = Literal["centre", "ray"]

MAX_SIDE_PX = 65_536
MAX_CHANNELS = 65_536
_CHOICES = {
    "render_mode": get_args(RenderMode),
    "rasterize_mode": get_args(RasterizeMode),
    "depth": get_args(DepthMode),
}
_RANGES = {"alpha_max": (0.01, 0.9999), "compensation_min": (0.0, 1.0)}
_SH_NOT_THERE = "spherical harmonics above degree 3"


@dataclass(frozen=True, eq=False)
class Scene:
    """What is rendered, the batch's dimensions flattened to s scenes with c views each.

    Attributes:
        lead: The batch's dimensions.
        cameras: c.
        means: Centres (s, n, 3), world units.
        quats: Orientations (s, n, 4), (w, x, y, z).
        scales: Standard deviations along the axes (s, n, 3), world units.
        opacities: (s, n), 0..1.
        colors: Features (f, n, d), or spherical harmonics (f, n, k, 3); f is s, or s · c if each view has its own.
        sh_degree: Degree that is used; None for features.
        views: All of them, scene by scene.
    """

    lead: tuple[int, ...]
    cameras: int
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    sh_degree: int | None
    views: tuple[View, ...] = ()


def refuse_what_is_not_there(asked: Mapping[str, object]) -> None:
    """Refuse arguments of gsplat's that have no implementation here.

    Raises:
        NotImplementedError: if any value is true; its name is in the sentence.
    """
    for name, wanted in asked.items():
        if wanted:
            raise NotImplementedError(f"splatpipe's rasterization does not support {name}.")


def check_numbers(choices: Mapping[str, str], sides: Mapping[str, object], reals: Mapping[str, float]) -> None:
    """Check arguments that are no tensors, by their names.

    Raises:
        ValueError: if a choice is unknown, a side is not a whole number in range, or a number is not in its range.
    """
    for name, choice in choices.items():
        if choice not in _CHOICES[name]:
            raise ValueError(f"{name} is {choice!r}; choose from {', '.join(_CHOICES[name])}.")
    for name, side in sides.items():
        if not 1 <= _whole(side) <= MAX_SIDE_PX:
            raise ValueError(f"{name} is {side!r}, not a whole number from 1 to {MAX_SIDE_PX}.")
    for name, number in reals.items():
        least, most = _RANGES.get(name, (0.0, math.inf))
        if not (isinstance(number, numbers.Real) and least <= number <= most):
            raise ValueError(f"{name} is {number!r}, not a number from {least} to {most}.")


def _whole(value: object) -> int:
    """A whole number of any type, NumPy's as well; -1 for what is none."""
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return -1


def find_scene(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    intrinsics: Tensor,
    sh_degree: int | None,
) -> Scene:
    """Check the Gaussians' tensors; arguments as for ``rasterization``, of which ``Ks`` are the intrinsics.

    Raises:
        ValueError: if shapes, dtypes or devices do not fit each other, or a value is not finite.
        NotImplementedError: for spherical harmonics above degree 3.
    """
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    for name, tensor in (tensors | {"viewmats": viewmats, "Ks": intrinsics}).items():
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{name} is no tensor but a {type(tensor).__name__}.")
    if means.ndim < 2 or viewmats.ndim < 3:
        raise ValueError("means is not (..., N, 3), or viewmats is not (..., C, 4, 4).")
    lead, n, c = tuple(means.shape[:-2]), means.shape[-2], viewmats.shape[-3]
    if c == 0 or 0 in lead:
        raise ValueError("there is no view to render: a dimension of viewmats or of the batch is 0.")
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    for name, shape in shapes.items():
        _check_shape(name, tensors[name], (*lead, *shape))
    for name, tensor in tensors.items():
        if tensor.dtype not in (torch.float32, torch.float64) or tensor.dtype != means.dtype:
            raise ValueError(f"{name} is {tensor.dtype}: all tensors must be float32, or all float64.")
        if tensor.device != means.device:
            raise ValueError(f"{name} is on {tensor.device}, means on {means.device}.")
        check_finite(name, tensor)
    _check_colors(colors, lead, c, n, sh_degree)
    per_view = colors.ndim == len(lead) + (3 if sh_degree is None else 4)
    trailing = colors.shape[len(lead) + per_view :]
    if sh_degree is not None and trailing[1] > coefficient_count(MAX_DEGREE):
        colors = colors[..., : coefficient_count(MAX_DEGREE), :]
        trailing = colors.shape[len(lead) + per_view :]
    s = math.prod(lead)
    return Scene(
        lead,
        c,
        means.reshape(s, n, 3),
        quats.reshape(s, n, 4),
        scales.reshape(s, n, 3),
        opacities.reshape(s, n),
        colors.reshape(s * c if per_view else s, *trailing),
        None if sh_degree is None else _whole(sh_degree),
    )


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} is {tuple(tensor.shape)}, not {shape}.")


def check_finite(name: str, tensor: Tensor) -> None:
    """Refuse NaN and infinity.

    Raises:
        ValueError: if there is one.
    """
    if tensor.numel() and not all(math.isfinite(end) for end in torch.aminmax(tensor.detach())):  # which keep a NaN
        raise ValueError(f"{name} has values that are not finite.")


def _check_colors(colors: Tensor, lead: tuple[int, ...], c: int, n: int, sh_degree: int | None) -> None:
    if sh_degree is None:
        d = colors.shape[-1] if colors.ndim else 0
        if tuple(colors.shape) not in ((*lead, n, d), (*lead, c, n, d)):
            raise ValueError(f"colors is {tuple(colors.shape)}, neither (..., N, D) nor (..., C, N, D).")
        if not 1 <= d <= MAX_CHANNELS:
            raise ValueError(f"colors has {d} channels, not 1 to {MAX_CHANNELS}.")
        return
    k = colors.shape[-2] if colors.ndim > 1 else 0
    if tuple(colors.shape) not in ((*lead, n, k, 3), (*lead, c, n, k, 3)):
        raise ValueError(f"colors is {tuple(colors.shape)}, neither (..., N, K, 3) nor (..., C, N, K, 3).")
    degree = _whole(sh_degree)
    if degree < 0:
        raise ValueError(f"sh_degree is {sh_degree!r}, not a whole number from 0.")
    refuse_what_is_not_there({_SH_NOT_THERE: degree > MAX_DEGREE})
    if coefficient_count(degree) > k:
        raise ValueError(f"colors has {k} coefficients: degree {degree} needs {coefficient_count(degree)}.")


def find_views(scene: Scene, viewmats: Tensor, intrinsics: Tensor, width: int, height: int) -> tuple[View, ...]:
    """The views of a scene by all poses (..., C, 4, 4) and intrinsics (..., C, 3, 3).

    Raises:
        ValueError: if shapes do not fit the scene, a value is not finite, a pose cannot be inverted, or a focal length
            is not > 0.
        NotImplementedError: if a gradient by them is wanted, or a camera is skewed.
    """
    wanted = torch.is_grad_enabled()
    refuse_what_is_not_there(
        {
            "a gradient to viewmats": wanted and viewmats.requires_grad,
            "a gradient to Ks": wanted and intrinsics.requires_grad,
        }
    )
    _check_shape("viewmats", viewmats, (*scene.lead, scene.cameras, 4, 4))
    _check_shape("Ks", intrinsics, (*scene.lead, scene.cameras, 3, 3))
    poses = viewmats.detach().to("cpu", torch.float64).reshape(-1, 4, 4)
    ks = intrinsics.detach().to("cpu", torch.float64).reshape(-1, 3, 3)
    check_finite("viewmats", poses)
    check_finite("Ks", ks)
    if not bool((poses[:, 3] == poses.new_tensor([0.0, 0.0, 0.0, 1.0])).all()):
        raise ValueError("the last row of a matrix of viewmats is not 0, 0, 0, 1.")
    if not bool((ks[:, 2] == ks.new_tensor([0.0, 0.0, 1.0])).all()):
        raise ValueError("the last row of a matrix of Ks is not 0, 0, 1.")
    refuse_what_is_not_there({"a skewed camera (Ks)": bool((ks[:, [0, 1], [1, 0]] != 0.0).any())})
    if not bool((ks[:, [0, 1], [0, 1]] > 0.0).all()):
        raise ValueError("a focal length of Ks is not above 0.")
    if not bool((torch.linalg.det(poses[:, :3, :3]) != 0.0).all()):
        raise ValueError("a matrix of viewmats cannot be inverted.")
    views = []
    for index, (pose, k) in enumerate(zip(poses.numpy(), ks.tolist(), strict=True)):
        camera = Camera(f"view {index}", width, height, k[0][0], k[1][1], k[0][2], k[1][2], pose)
        views.append(View(camera, np.linalg.inv(pose)[:3, 3]))
    return tuple(views)


def find_backgrounds(scene: Scene, backgrounds: Tensor | None) -> Tensor | None:
    """The backgrounds of all views (v, d).

    Raises:
        ValueError: if they do not fit the scene, or a value is not finite.
    """
    if backgrounds is None:
        return None
    channels = scene.colors.shape[-1]
    _check_shape("backgrounds", backgrounds, (*scene.lead, scene.cameras, channels))
    if backgrounds.dtype != scene.means.dtype or backgrounds.device != scene.means.device:
        raise ValueError("backgrounds has another dtype or device than means.")
    check_finite("backgrounds", backgrounds)
    return backgrounds.reshape(-1, channels)
