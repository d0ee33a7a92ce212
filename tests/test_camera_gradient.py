"""The gradient of a render by its camera: the reference's by finite differences, the native one by the reference."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.raster import RenderOptions, _native, render, set_threads
from splatpipe.pipeline.scene.camera import Camera
from splatpipe.pipeline.scene.gaussians import Gaussians

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
from random_scene import random_camera, random_scene

STEP = 1e-6  # of finite differences in float64: rounding 1e-10, curvature 1e-12
EXACT = 1e-6  # what is left of it, relative
ROUNDED = 1e-4  # float32: a sum over all Gaussians of terms that cancel
AXES = ["turn x", "turn y", "turn z", "move x", "move y", "move z", "focal"]


@pytest.fixture(params=_native.isas(), autouse=True)
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    before = _native.isa()
    _native.set_isa(request.param)
    yield request.param
    _native.set_isa(before)
    set_threads(2)


def weighted(scene: Gaussians, camera: Camera, options: RenderOptions, backend: str, probe: Tensor | None) -> Tensor:
    """A sum of the pixels of every picture with random weights."""
    result = render(scene, camera, options, backend=backend, camera_probe=probe)  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(5)
    total = torch.zeros((), dtype=scene.means.dtype)
    for picture in (result.colour, result.alpha, result.depth_sum, result.depth_square_sum):
        total = total + (picture * torch.randn(picture.shape, generator=generator)).sum()
    return total


def small_view(seed: int) -> tuple[Gaussians, Camera]:
    return random_scene(seed, n=40), random_camera(seed + 1, width=40, height=30)


def by_camera(scene: Gaussians, camera: Camera, options: RenderOptions, backend: str = "native") -> np.ndarray:
    probe = torch.zeros(7, dtype=scene.means.dtype, requires_grad=True)
    (gradient,) = torch.autograd.grad(weighted(scene, camera, options, backend, probe), probe)
    return gradient.numpy()


@cache  # every instruction set asks for them
def differences(seed: int, options: RenderOptions) -> np.ndarray:
    """The same by central differences of the reference's renders from really moved cameras."""
    scene, camera = small_view(seed)
    scene = scene.to(dtype=torch.float64)
    found = []
    for axis in range(7):
        step = np.zeros(7)
        step[axis] = STEP
        ends = [weighted(scene, camera.moved(side * step), options, "reference", None) for side in (1.0, -1.0)]
        found.append(float(ends[0] - ends[1]) / (2.0 * STEP))
    return np.array(found)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_gradient_by_the_camera_is_the_slope_of_the_render(antialias: bool, degree: int) -> None:
    scene, camera = small_view(3)
    options = RenderOptions(degree, background=(0.2, 0.5, 0.9), antialias=antialias)
    with torch.no_grad():
        slopes = differences(3, options)
    exact = by_camera(scene.to(dtype=torch.float64), camera, options, "reference")
    ours = by_camera(scene, camera, options)
    for name, slope, reference, native in zip(AXES, slopes, exact, ours, strict=True):
        assert abs(reference - slope) < EXACT * abs(slope), name
        assert abs(native - slope) < ROUNDED * np.abs(slopes).max(), name


def test_gaussians_beside_the_picture_whose_projection_is_clamped_count() -> None:
    scene, camera = random_scene(7, size=0.5), random_camera(8, width=24, height=20)
    exact = by_camera(scene.to(dtype=torch.float64), camera, RenderOptions(1), "reference")
    assert np.abs(by_camera(scene, camera, RenderOptions(1)) - exact).max() < ROUNDED * np.abs(exact).max()


def test_gradient_by_the_camera_has_the_same_bits_for_any_number_of_threads() -> None:
    scene, camera = random_scene(9, n=5000, size=-3.0), random_camera(10)
    found = []
    for threads in (1, 2, 5):
        set_threads(threads)
        found.append(by_camera(scene, camera, RenderOptions(3)).tobytes())
    assert len(set(found)) == 1


def test_the_probe_changes_no_other_gradient_and_may_see_nothing() -> None:
    scene, camera = random_scene(11, n=500), random_camera(12)
    leaves = scene.clone().requires_grad_()
    plain = torch.autograd.grad(weighted(leaves, camera, RenderOptions(3), "native", None), leaves.means)[0]
    probe = torch.zeros(7, requires_grad=True)
    probed = torch.autograd.grad(weighted(leaves, camera, RenderOptions(3), "native", probe), leaves.means)[0]
    assert torch.allclose(plain, probed, rtol=1e-5, atol=1e-7)
    assert not by_camera(scene.select(torch.zeros(0, dtype=torch.int64)), camera, RenderOptions(3)).any()
    behind = scene.clone()
    behind.means[:, 2] -= 100.0
    assert not by_camera(behind, camera, RenderOptions(3)).any()
    with pytest.raises(ValueError, match="camera_probe"):
        render(scene, camera, RenderOptions(3), camera_probe=torch.zeros(6))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, math.pi])
def test_a_moved_camera_turns_shifts_and_zooms(angle: float) -> None:
    camera = random_camera(1)
    axis = np.array([0.6, 0.0, 0.8]) * angle
    moved = camera.moved(np.array([*axis, 0.1, -0.2, 0.3, math.log(1.5)]))
    points = np.random.default_rng(1).normal(size=(5, 4))
    points[:, 3] = 1.0
    before = (points @ camera.cam_from_world.T)[:, :3]
    after = (points @ moved.cam_from_world.T)[:, :3]
    turned = before @ cv2.Rodrigues(axis)[0].T
    assert np.abs(after - turned - [0.1, -0.2, 0.3]).max() < 1e-12
    assert (moved.fx, moved.fy) == pytest.approx((1.5 * camera.fx, 1.5 * camera.fy))
    assert (moved.cx, moved.cy, moved.name) == (camera.cx, camera.cy, camera.name)
