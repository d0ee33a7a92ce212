"""The scores of density control against brute force."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.state.density import Density
from splatpipe.pipeline.train.techniques.techniques import Techniques

WIDTH, HEIGHT = 40, 30
CAMERA = Camera("photo.png", WIDTH, HEIGHT, 35.0, 36.0, 20.5, 14.5, np.eye(4))
SCHEDULE = resolve_schedule(TrainConfig()).density


def scene(count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Overlapping Gaussians in front of the camera, of degree 0."""
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians.empty(count, 0, dtype)
    spread = torch.tensor([1.0, 0.8, 1.0], dtype=dtype)
    gaussians.means = torch.randn(count, 3, generator=generator, dtype=dtype) * spread + torch.tensor([0.0, 0.0, 5.0])
    gaussians.log_scales = -1.5 + 0.4 * torch.randn(count, 3, generator=generator, dtype=dtype)
    gaussians.quats = torch.randn(count, 4, generator=generator, dtype=dtype)
    gaussians.opacity_logits = torch.randn(count, generator=generator, dtype=dtype)
    gaussians.sh[:, 0] = rgb_to_dc(torch.rand(count, 3, generator=generator, dtype=dtype))
    return gaussians


def picture(seed: int = 1) -> Tensor:
    return torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(seed))


def observed(magnitudes: bool, gaussians: Gaussians, weights: Tensor) -> Tensor:
    """The score after one photo whose loss is Σ weights · colour."""
    density = Density(len(gaussians))
    probe = torch.zeros(len(gaussians), 2, requires_grad=True)
    options = rasterizer.RenderOptions(0, near=0.2, depth=False, magnitudes=magnitudes)
    render = rasterizer.render(gaussians.requires_grad_(), CAMERA, options, means2d_probe=probe)
    (render.colour * weights).sum().backward()
    assert probe.grad is not None
    with torch.no_grad():
        density.observe(render, probe.grad, SCHEDULE, TrainingPhoto(CAMERA, weights, None))
    return density.score()


def test_published_score_is_the_norm_of_the_gradient_by_screen_position() -> None:
    gaussians, weights = scene(1, dtype=torch.float64), picture(2)

    def loss(right: float, down: float) -> float:
        """Return the loss with the single Gaussian shifted in pixels, by shifting the principal point."""
        camera = replace(CAMERA, cx=CAMERA.cx + right, cy=CAMERA.cy + down)
        colour = rasterizer.render(gaussians, camera, rasterizer.RenderOptions(0, near=0.2), backend="reference").colour
        return float((colour * weights).sum())

    step = 1e-4
    slope_x, slope_y = loss(step, 0.0) - loss(-step, 0.0), loss(0.0, step) - loss(0.0, -step)
    expected = math.hypot(slope_x * WIDTH / 2, slope_y * HEIGHT / 2) / (2.0 * step)
    score = observed(False, gaussians.to(dtype=torch.float32), weights)
    assert float(score[0]) == pytest.approx(expected, rel=1e-3)  # float32, and pixels that cross 1/255 on the way


@pytest.mark.parametrize("magnitudes", [False, True])
def test_gradient_scores_are_those_of_the_reference(magnitudes: bool) -> None:
    gaussians, weights = scene(20), picture(2) - 0.5
    exact = gaussians.to(dtype=torch.float64).requires_grad_()
    probe = torch.zeros(20, 2, dtype=torch.float64, requires_grad=True)
    options = rasterizer.RenderOptions(0, near=0.2, magnitudes=magnitudes)
    colour = rasterizer.render(exact, CAMERA, options, backend="reference", means2d_probe=probe).colour
    (colour * weights).sum().backward()
    assert probe.grad is not None
    expected = torch.linalg.vector_norm(probe.grad * torch.tensor([WIDTH / 2, HEIGHT / 2]), dim=1)
    torch.testing.assert_close(observed(magnitudes, gaussians, weights).double(), expected, rtol=1e-3, atol=1e-3)


def test_density_control_keeps_to_the_limit_and_its_statistics_survive() -> None:
    schedule = replace(SCHEDULE, gradient=1e-9)
    gaussians, density, again = scene(50), Density(50), Density(50)
    density.score_sum += 1.0
    density.seen += 1.0
    again.load({key: tensor.clone() for key, tensor in density.to_arrays().items()})
    for limit in (50, 61):
        step = (gaussians, schedule, 5.0, limit, 600, Techniques())
        growth, counts = density.control(*step)
        assert len(growth.source) == limit
        repeated, same = again.control(*step)
        assert same == counts
        assert torch.equal(repeated.means, growth.means) and torch.equal(repeated.source, growth.source)
    density.restart(61)
    assert all(not tensor.any() and len(tensor) == 61 for tensor in density.to_arrays().values())


def test_score_is_the_ndc_gradient_averaged_over_the_photos_that_saw_it() -> None:
    density, camera = Density(3), Camera("photo.png", 200, 200, 1.0, 1.0, 100.0, 100.0, np.eye(4))
    schedule, photo = replace(SCHEDULE, prune_screen_px=1.0), TrainingPhoto(camera, torch.zeros(200, 200, 3), None)
    visible, picture = torch.tensor([True, False, True]), torch.zeros(200, 200)
    gradient = torch.tensor([[3e-3, 4e-3], [1.0, 1.0], [math.nan, 0.0]])
    for each, radii in ((gradient, [1.0, 2.0, 0.0]), (torch.zeros(3, 2), [2.0, 1.0, 0.0])):
        render = rasterizer.Render(photo.colour, *[picture] * 4, visible, torch.tensor(radii))
        density.observe(render, each, schedule, photo)
    torch.testing.assert_close(density.score(), torch.tensor([0.25, 0.0, 0.0]))
    assert density.max_radius_px.tolist() == [2.0, 2.0, 0.0]


def test_statistics_of_another_model_are_refused() -> None:
    density = Density(3)
    with pytest.raises(RuntimeError, match="not"):
        density.load(Density(4).to_arrays())
