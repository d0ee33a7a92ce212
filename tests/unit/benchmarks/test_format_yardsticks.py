"""Benchmarks of formats and cleaning: they measure what they claim, on scenes with known truth."""

import gzip
import math
from dataclasses import replace

import numpy as np
import pytest
import tiny_scene
import torch
from captures import CaptureRun, decibels, likely_frame
from floater_planting import KINDS, SEEN_ALPHA, plant, render_depths
from others import sog_iterations
from position_errors import SITE_M, position_row, site_of

from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.containers.spz_encoder import spz_bytes
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts

UP_FROM_DOWN = SceneFacts("y down")  # the tiny scene's −y is up


def moved(scene: Scene, by: torch.Tensor) -> Scene:
    return replace(scene, gaussians=replace(scene.gaussians, means=scene.gaussians.means + by))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(tiny_scene.true_model(), UP_FROM_DOWN)


def test_positions_are_judged_by_the_files_quantization_step(scene, tmp_path):
    path = tmp_path / "splat.spz"
    path.write_bytes(spz_bytes(scene.gaussians, antialias=False))
    step = 2.0 ** -gzip.decompress(path.read_bytes())[13]
    order = torch.randperm(len(scene.gaussians), generator=torch.Generator().manual_seed(1))
    for share, within in ((0.3, True), (0.9, False)):  # float32 has steps of a quarter of it, too
        read = moved(scene, torch.tensor([0.0, share * step, 0.0]))
        read = replace(read, gaussians=read.gaussians.select(order))
        row = position_row(scene, read, path, "spz")
        assert row["within"] is within
        assert row["largest_mm"] == pytest.approx(1e3 * share * step, rel=0.3)
        assert row["step_mm"] == 1e3 * step


def test_a_site_is_three_kilometres_across(scene):
    means = site_of(scene).gaussians.means
    span = means.max(dim=0).values - means.min(dim=0).values
    assert span[0].item() == pytest.approx(SITE_M, rel=0.05)


def test_an_unnamed_frame_is_found(scene):
    cameras = tiny_scene.cameras(3)
    turned = scene.turned("z up")
    back = np.eye(4)
    back[:3, :3] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).numpy()  # y down from z up
    cameras = [replace(camera, cam_from_world=camera.cam_from_world @ back) for camera in cameras]
    capture = CaptureRun("tiny", turned, cameras)
    originals = capture.pictures(turned)
    assert decibels(capture.pictures(scene), originals) > 90.0
    unknown = Scene(turned.turned("y up").gaussians, SceneFacts("z up"))
    frame, placed = likely_frame(capture, unknown, originals)
    assert frame == "y up"
    assert decibels(capture.pictures(placed), originals) > 90.0
    assert decibels(originals, originals) == math.inf


def test_floaters_are_planted_in_front_of_surfaces_and_visible(scene):
    model = scene.gaussians
    wall = Gaussians.empty(1200, 3)  # behind everything: every ray ends there
    wall.means = torch.rand(1200, 3, generator=torch.Generator().manual_seed(2)) * torch.tensor([8.0, 6.0, 0.05])
    wall.means += torch.tensor([-4.0, -3.0, 1.6])
    wall.log_scales = torch.full((1200, 3), math.log(0.15))
    wall.opacity_logits = torch.full((1200,), 4.0)
    model = Gaussians.concat([model, wall])
    options = RenderOptions(sh_degree=3)
    views = render_depths(model, tiny_scene.cameras(), options)
    planted = plant(model, views, options, 40, np.random.default_rng(3))
    assert np.bincount(planted.kinds).tolist() == [40, 40, 40, 20, 8]
    assert planted.building[len(scene.gaussians) :].mean() > 0.3
    floaters = planted.model.after(planted.trained)
    gaps = np.stack([view.gaps(floaters.means.double().numpy()) for view in views])
    before = (np.nan_to_num(gaps, nan=-1.0) > 0.0).any(axis=0)
    assert before.all()
    assert bool((torch.sigmoid(floaters.opacity_logits) >= SEEN_ALPHA).all())
    size = [float(floaters.log_scales[planted.kinds == kind].max(dim=1).values.mean()) for kind in range(len(KINDS))]
    assert size[KINDS.index("oversized")] > size[KINDS.index("haze")]
    again = plant(model, views, options, 40, np.random.default_rng(3))
    assert torch.equal(again.model.means, planted.model.means)


def test_another_programs_palette_takes_bounded_time_or_is_left_out():
    assert sog_iterations(800, 1.0) == 10
    assert sog_iterations(18_000, 600.0) == 10  # its default
    assert sog_iterations(130_000, 600.0) == 1
    assert sog_iterations(1_000_000, 600.0) == 0
