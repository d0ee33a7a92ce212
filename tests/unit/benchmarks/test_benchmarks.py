"""benchmarks: they run on any dataset, count what they claim to count, and train as the pipeline does."""

import argparse
import math
from pathlib import Path

import measure
import numpy as np
import pytest
import tiny_scene
import torch
import window_speed

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.raster.definitions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.raster.reference import project, visible_splats
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.plan.plan import make_plan

MEGAPIXELS = 1e-6 * tiny_scene.WIDTH * tiny_scene.HEIGHT


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_scene.write_dataset(tmp_path_factory.mktemp("scene") / "tiny")


def pairs_by_definition(gaussians: Gaussians, camera: Camera, options: RenderOptions) -> int:
    """Blend one Gaussian after another, front to back, over whole images."""
    splats = project(gaussians.to(dtype=torch.float64), camera, options)
    order = torch.argsort(splats.depths, stable=True)
    splats = splats.select(order[visible_splats(splats, camera)[order]])
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    left, open_ = np.ones_like(x), np.ones(x.shape, bool)
    pairs = 0
    for mean, (xx, xy, yy), opacity in zip(
        splats.means.tolist(), splats.covariances.tolist(), splats.opacities.tolist(), strict=True
    ):
        dx, dy = x - mean[0], y - mean[1]
        distance2 = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
        alpha = np.minimum(ALPHA_MAX, opacity * np.exp(-0.5 * distance2))
        seen = open_ & (alpha >= ALPHA_MIN)
        open_ &= ~(seen & (left * (1.0 - alpha) < TRANSMITTANCE_MIN))
        seen &= open_
        left[seen] *= 1.0 - alpha[seen]
        pairs += int(seen.sum())
    return pairs


@pytest.mark.parametrize("opacity_logit", [-1.0, 2.0, 6.0])
def test_contributing_pairs_are_those_of_the_definition(dataset: Path, opacity_logit: float) -> None:
    gaussians = tiny_scene.true_model(600)
    gaussians.opacity_logits[:] = opacity_logit  # the last: pixels end early
    plan = make_plan(tiny_scene.plain(), load_views(dataset), tiny_scene.split_of(load_views(dataset)), len(gaussians))
    for camera in tiny_scene.cameras()[::4]:
        pairs = measure.contributing_pairs(gaussians, camera, plan, 1)
        expected = pairs_by_definition(gaussians, camera, RenderOptions(0, near=plan.near))
        # In float32 a few alphas are on the other side of 1/255, and a few pixels saturate a Gaussian earlier or later.
        assert expected > 5000 and abs(pairs - expected) <= 2e-3 * expected


def test_window_speed_compares_windows_with_whole_photos_of_their_size(dataset: Path, tmp_path: Path) -> None:
    given = argparse.Namespace(data=dataset, points="sparse", photos=2, repeats=8, threads=1)
    given.window, given.megapixels = MEGAPIXELS, [4 * MEGAPIXELS]
    whole, parts = window_speed.measure(given, tmp_path)
    assert (whole["seen"], parts["seen"]) == ("whole", "in windows")
    assert whole["iterations"] == parts["iterations"] == 8 and whole["gaussians"] == parts["gaussians"]
    assert whole["counted_megapixels"] == whole["rendered_megapixels"] == pytest.approx(MEGAPIXELS)
    assert 0.5 * MEGAPIXELS < parts["counted_megapixels"] <= window_speed.ROUNDING * MEGAPIXELS
    assert parts["counted_megapixels"] < parts["rendered_megapixels"]
    assert parts["pairs_per_pixel"] == pytest.approx(whole["pairs_per_pixel"], rel=0.35)  # one scene, nearer
    assert whole["ratio"] == whole["mean_ratio"] == whole["ratio_per_counted"] == 1.0
    assert math.isclose(parts["mean_ratio"], parts["cpu_mean_s"] / whole["cpu_mean_s"])
