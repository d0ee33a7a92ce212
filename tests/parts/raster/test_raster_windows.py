"""A window of an image has the same pixels and gradients as that part of the whole image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from building import build_on_cpu
from random_scene import random_camera, random_scene
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions, render
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS, Gaussians

PICTURES = ("colour", "alpha", "depth_sum", "depth_square_sum", "median_depth")
SIZE = (70, 53)
PARTS = {
    "corner": (0, 0, 24, 20),
    "middle": (21, 17, 33, 18),
    "other corner": (50, 30, 20, 23),
    "a row": (0, 26, 70, 1),
    "a pixel": (43, 12, 1, 1),
    "half": (35, 0, 35, 53),
}
"""Left, top, width and height."""
RTOL = {torch.float64: 1e-11, torch.float32: 1e-4}
"""Relative, in L2: centres on the screen are rounded as pixels of the part, and in float32 it is 4e-5 for the gradients
of the longest Gaussians."""
OPTIONS = RenderOptions(3, background=(0.3, 0.6, 0.2), near=0.2, depth_origin=3.0)


def edgy_scene() -> Gaussians:
    """With Gaussians beyond the image, past the clamp of their Jacobian, that are large enough to reach into it."""
    scene = random_scene(21, 80)
    scene.means[:30, :2] *= 3.0
    scene.log_scales[:30] += 1.3
    return scene


def upstream_of(part: tuple[int, int, int, int]) -> dict[str, Tensor]:
    """Return dL/d(each image) of the whole, nonzero only inside the window."""
    left, top, width, height = part
    generator = torch.Generator().manual_seed(9)
    weights = {}
    for name in PICTURES[:-1]:
        shape = (SIZE[1], SIZE[0], 3) if name == "colour" else (SIZE[1], SIZE[0])
        of_part = torch.zeros(shape, dtype=torch.float64)
        here = (slice(top, top + height), slice(left, left + width))
        of_part[here] = torch.randn(shape, generator=generator, dtype=torch.float64)[here]
        weights[name] = of_part
    return weights


def rendered(
    camera: Camera, weights: dict[str, Tensor], dtype: torch.dtype, options: RenderOptions = OPTIONS
) -> tuple[Render, dict[str, Tensor]]:
    """The render, and the gradients of all parameters and of the centres on the screen."""
    scene = edgy_scene()
    leaves = {name: getattr(scene, name).to(dtype).requires_grad_() for name in PARAMETERS}
    probe = torch.zeros(len(scene), 2, dtype=dtype, requires_grad=True)
    made = render(Gaussians(**leaves), camera, options, means2d_probe=probe)
    total = sum((getattr(made, name) * weight.to(dtype)).sum() for name, weight in weights.items())
    asked = leaves | {"means2d": probe}
    return made, dict(zip(asked, torch.autograd.grad(total, list(asked.values())), strict=True))


def relative(found: Tensor, exact: Tensor) -> float:
    error, size = (float(torch.linalg.vector_norm(each.double())) for each in (found - exact, exact))
    return error / size if size else error


def check_part(part: tuple[int, int, int, int], dtype: torch.dtype, options: RenderOptions = OPTIONS) -> None:
    left, top, width, height = part
    here = (slice(top, top + height), slice(left, left + width))
    camera, weights = random_camera(4, *SIZE), upstream_of(part)
    whole, gradients = rendered(camera, weights, dtype, options)
    cut = {name: weight[here] for name, weight in weights.items()}
    made, found = rendered(camera.crop(*part), cut, dtype, options)
    for name in PICTURES:
        assert relative(getattr(made, name).detach(), getattr(whole, name).detach()[here]) < RTOL[dtype], name
    for name, gradient in gradients.items():
        assert relative(found[name], gradient) < RTOL[dtype], name
    assert bool(whole.visible[made.visible].all()), "what the part sees, the whole sees"
    assert not any(bool(gradient[~made.visible].any()) for gradient in gradients.values()), "and what has a gradient"
    torch.testing.assert_close(made.radii, torch.where(made.visible, whole.radii, 0.0), rtol=RTOL[dtype], atol=0.0)


@pytest.fixture(scope="module")
def cuda() -> CudaKernels:
    return CudaKernels(CudaLibrary(build_on_cpu()), torch.device("cpu"))


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS.keys())
def test_reference_of_a_window_matches_the_whole(part):
    check_part(part, torch.float64)


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS.keys())
def test_native_of_a_window_matches_the_whole(isa, part):
    check_part(part, torch.float32)


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS.keys())
def test_cuda_of_a_window_matches_the_whole(cuda, part):
    with use_kernels(cuda):
        check_part(part, torch.float32)


@pytest.mark.parametrize("change", [{"antialias": True}, {"magnitudes": True}, {"depth": True, "sh_degree": 0}])
def test_variants_of_a_window_match_the_whole(change):
    options = RenderOptions(**(vars(OPTIONS) | change))
    check_part(PARTS["middle"], torch.float64, options)
    check_part(PARTS["middle"], torch.float32, options)


def test_windows_of_a_window_match_the_whole():
    """A window of a window refers to the whole, not to the window that it was cut from."""
    camera = random_camera(4, *SIZE)
    at_once, in_two = camera.crop(21, 17, 33, 18), camera.crop(10, 10, 50, 40).crop(11, 7, 33, 18)
    weights = {name: weight[17:35, 21:54] for name, weight in upstream_of(PARTS["middle"]).items()}
    (ours, gradients), (theirs, others) = (rendered(each, weights, torch.float32) for each in (at_once, in_two))
    assert torch.equal(ours.colour, theirs.colour)
    assert all(torch.equal(gradients[name], others[name]) for name in gradients)


@pytest.mark.parametrize("backend", ["reference", "native", "cuda"])
def test_the_scene_would_reveal_limits_of_the_window_itself(cuda, backend):
    """The scene suits these tests: with the window's own frustum, as of a small photo, the image would differ."""
    part = random_camera(4, *SIZE).crop(*PARTS["middle"])
    alone = Camera(part.name, part.width, part.height, part.fx, part.fy, part.cx, part.cy, part.cam_from_world)
    dtype = torch.float64 if backend == "reference" else torch.float32
    weights = {"colour": torch.ones(part.height, part.width, 3, dtype=torch.float64)}
    with use_kernels(cuda if backend == "cuda" else None):
        (ours, gradients), (theirs, others) = (rendered(each, weights, dtype) for each in (part, alone))
    assert relative(theirs.colour.detach(), ours.colour.detach()) > 20 * RTOL[torch.float32]
    assert relative(others["means"], gradients["means"]) > 20 * RTOL[torch.float32]


def test_each_gaussian_that_reaches_a_pixel_is_visible_in_a_window():
    """All windows of an image together see the Gaussians that the whole sees."""
    camera, weights = random_camera(4, *SIZE), upstream_of((0, 0, *SIZE))
    whole, gradients = rendered(camera, weights, torch.float32)
    seen = torch.zeros_like(whole.visible)
    summed = {name: torch.zeros_like(gradient) for name, gradient in gradients.items()}
    for top, height in ((0, 26), (26, 27)):
        for left, width in ((0, 17), (17, 31), (48, 22)):
            here = {name: weight[top : top + height, left : left + width] for name, weight in weights.items()}
            made, found = rendered(camera.crop(left, top, width, height), here, torch.float32)
            seen |= made.visible
            for name, gradient in found.items():
                summed[name] += gradient
    assert torch.equal(seen, whole.visible)
    assert all(relative(summed[name], gradient) < RTOL[torch.float32] for name, gradient in gradients.items())


def test_an_invalid_window_is_refused():
    scene = random_scene(1, 5)
    parameters = tuple(getattr(scene, name) for name in PARAMETERS)
    outputs = (torch.empty(9, 8, 3), torch.empty(9, 8), None, torch.empty(5), torch.empty(5, dtype=torch.uint8))
    camera = (np.eye(4), (8, 9), (60.0, 60.0, 4.0, 4.0))
    options = (0, False, 0.2, 0.0, (0.0, 0.0, 0.0))
    for window in ((-1, 0, 20, 20), (0, -1, 20, 20), (13, 0, 20, 20), (0, 12, 20, 20), (0, 0, 7, 9)):
        with pytest.raises(ValueError, match="window"):
            _native.Frame().forward(parameters, camera, options, outputs, window)
