"""The flattened copy: its terms pull surfaces together, and kills and thread counts leave the same bits."""

import json
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.depth_maps import list_depth_maps
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.definitions import Render
from splatpipe.pipeline.render.rendering import Rendering
from splatpipe.pipeline.splat.containers.ply import read_splat, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.panorama import write_panorama
from splatpipe.pipeline.train import flattening, loop
from splatpipe.pipeline.train.appearance.exposure import Exposure, exposures_json, read_exposures
from splatpipe.pipeline.train.flattening import MIN_ITERATIONS, TrainedParts, flatten, flattening_plan, options_of
from splatpipe.pipeline.train.options import SplatDepthsConfig
from splatpipe.pipeline.train.plan.lengths import WINDOW_PIXELS
from splatpipe.pipeline.train.sizing import shortage
from splatpipe.pipeline.train.techniques.distortion_loss import FREE_PX, HALF_PX, depth_origin, spread_loss
from splatpipe.pipeline.train.techniques.smoothness_loss import unevenness
from splatpipe.stages import splat_depths

FRONT = Camera("front", 24, 16, 30.0, 30.0, 12.0, 8.0, np.eye(4))
FEW = 30  # iterations: enough to see it work


def picture(depth: torch.Tensor, alpha: float = 0.9) -> Render:
    """Return the render of one surface at given depths."""
    full, none = torch.full_like(depth, alpha), torch.zeros(0)
    return Render(torch.zeros(*depth.shape, 3), full, alpha * depth, alpha * depth**2, depth, none.bool(), none)


def plane(across: float, down: float) -> torch.Tensor:
    """Depths of a plane about 10 in front of the camera, by the change of its inverse depth per pixel."""
    x, y = torch.meshgrid(torch.arange(24.0), torch.arange(16.0), indexing="xy")
    return (1.0 / (0.1 + across * x + down * y)).double()


def test_planes_are_even_whatever_their_slant_and_deviations_cost_their_share() -> None:
    for slant in ((0.0, 0.0), (2e-3, 0.0), (-1e-3, 3e-3)):
        assert float(unevenness(picture(plane(*slant)), FRONT)) == pytest.approx(0.0, abs=1e-9)
    bent, off = 1.0 / plane(0.0, 0.0), 0.5 * 0.1 / FRONT.fx  # half a pixel on the ground
    bent[:, 12] += off
    ratio = [(2.0 * off * FRONT.fx / (0.1 + off)) ** 2, (off * FRONT.fx / 0.1) ** 2]
    shares = [value / (value + 1.0) for value in ratio]
    expected = (shares[0] + 2.0 * shares[1]) / 22.0
    assert float(unevenness(picture(1.0 / bent), FRONT, reaches=(1,))) == pytest.approx(expected, rel=1e-6)
    step = plane(0.0, 0.0)
    step[:, 12:] = 1000.0
    assert float(unevenness(picture(step), FRONT, reaches=(1,))) <= 2.0 / 22.0


def test_missing_surfaces_neighbours_and_masked_pixels_cost_nothing() -> None:
    rough = plane(0.0, 0.0) * (1.0 + 0.1 * torch.rand(16, 24, generator=torch.Generator().manual_seed(1)))
    assert float(unevenness(picture(rough), FRONT)) > 0.1
    assert float(unevenness(picture(rough, alpha=0.4), FRONT)) == 0.0
    assert float(unevenness(picture(rough[:8, :2]), FRONT, reaches=(4,))) == 0.0
    half = torch.cat([plane(0.0, 0.0)[:, :12], rough[:, 12:]], dim=1)
    assert float(unevenness(picture(half), FRONT, (slice(None), slice(0, 12)))) == pytest.approx(0.0, abs=1e-9)


def test_gradient_of_unevenness_agrees_with_finite_differences() -> None:
    rough = plane(1e-3, 0.0)[:6, :7] * (1.0 + 2e-3 * torch.rand(6, 7, generator=torch.Generator().manual_seed(2)))

    def value(depth_sum: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """Computed by hand; a pixel's size on the ground is not differentiated."""
        inverse, ground = alpha / depth_sum, FRONT.fx * rough
        across = (inverse[:, :-2] + inverse[:, 2:] - 2.0 * inverse[:, 1:-1]) * ground[:, 1:-1]
        down = (inverse[:-2] + inverse[2:] - 2.0 * inverse[1:-1]) * ground[1:-1]
        return sum((each.square() / (each.square() + 1.0)).mean() for each in (across, down))  # type: ignore[return-value]

    leaves = ((0.8 * rough).requires_grad_(), torch.full_like(rough, 0.8).requires_grad_())
    assert torch.autograd.gradcheck(value, leaves, eps=1e-6, atol=1e-6)
    found = unevenness(replace(picture(rough), alpha=leaves[1], depth_sum=leaves[0]), FRONT, reaches=(1,))
    assert torch.allclose(found, value(*leaves), rtol=1e-9)
    pairs = zip(torch.autograd.grad(found, leaves), torch.autograd.grad(value(*leaves), leaves), strict=True)
    assert all(torch.allclose(own, by_hand, rtol=1e-6, atol=1e-12) for own, by_hand in pairs)


def test_spread_about_the_median_does_not_move_the_front_surface() -> None:
    gaussians = Gaussians.empty(2, 0)
    gaussians.means = torch.tensor([[0.0, 0.0, 8.0], [0.0, 0.0, 12.0]])
    gaussians.log_scales = torch.log(torch.tensor([[240.0, 240.0, 1e-6], [360.0, 360.0, 1e-6]]))
    gaussians.opacity_logits = torch.logit(torch.tensor([0.6, 0.6]))
    gaussians.means.requires_grad_()
    rendered = rasterizer.render(gaussians, FRONT, rasterizer.RenderOptions(0, depth_origin=10.0))
    found = spread_loss(rendered, 10.0, FRONT, about_median=True)
    first, second = 0.6, 0.24
    mean = (8.0 * first + 12.0 * second) / (first + second)
    excess = 16.0 * second / (first + second) / (mean / FRONT.fx) ** 2 - FREE_PX**2
    assert float(found.detach()) == pytest.approx(excess / (excess + HALF_PX**2), rel=1e-3)
    found.backward()  # type: ignore[no-untyped-call]
    assert gaussians.means.grad is not None
    front, back = gaussians.means.grad[:, 2].tolist()
    assert back > 0.0 and abs(front) < 0.02 * back


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(flattening, "MIN_ITERATIONS", FEW)
    monkeypatch.setattr(flattening, "VISITS", 1)
    yield


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the stage's inputs for a model with true colours and perturbed surfaces."""
    folder = tmp_path_factory.mktemp("trained")
    dataset = tiny_scene.write_dataset(folder / "dataset")
    model = tiny_scene.true_model()
    model.means += 0.05 * torch.randn(model.means.shape, generator=torch.Generator().manual_seed(4))
    write_splat(folder / "model.ply", model)
    rendering = Rendering(False, (0.0, 0.0, 0.0), 0.05, None)
    (folder / "rendering.json").write_text(rendering.to_json())
    write_panorama(folder / "sky.npz", None)
    names = [view.camera.name for view in load_views(dataset)]
    (folder / "exposures.json").write_text(exposures_json(Exposure(names)))
    (folder / "blocks.json").write_text('{"shards": 0}')
    found = {"undistort.dataset": dataset, "blocks.plan": folder / "blocks.json"}
    found["clean.model"] = folder / "model.ply"
    files = {"rendering": "rendering.json", "sky": "sky.npz", "exposures": "exposures.json"}
    found |= {f"train.{name}": folder / file for name, file in files.items()}
    return found | tiny_scene.split_part(dataset, 4)


def trained(parts: dict[str, Path]) -> TrainedParts:
    names = ("clean.model", "train.rendering", "train.sky", "train.exposures", "undistort.dataset", "split.views")
    return TrainedParts(*(parts[name] for name in names))


def spread_of(model: Gaussians, dataset: Path) -> float:
    total = 0.0
    for view in load_views(dataset):
        origin = depth_origin(model.means, view.camera)
        with torch.no_grad():
            rendered = rasterizer.render(model, view.camera, rasterizer.RenderOptions(0, depth_origin=origin))
        total += float(
            spread_loss(rendered, origin, view.camera, about_median=True) + unevenness(rendered, view.camera)
        )
    return total


@pytest.mark.usefixtures("few")
def test_copy_is_flatter_and_the_same_for_any_threads_and_after_a_kill(
    parts: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    once.mkdir()
    twice.mkdir()
    model = flatten(trained(parts), Machine("cpu", 1), once, tiny_scene.Recorder())
    before = read_splat(parts["clean.model"])
    assert len(model) == len(before)
    # A tenth of the shipped length reduces it by a tenth.
    assert spread_of(model, parts["undistort.dataset"]) < 0.95 * spread_of(before, parts["undistort.dataset"])
    real = shortage.iterate

    def killed(state, *arguments) -> None:  # type: ignore[no-untyped-def]
        real(state, *arguments)
        if state.iteration == FEW // 2:
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shortage, "iterate", killed)
        flatten(trained(parts), Machine("cpu", 2), twice, tiny_scene.Recorder())
    assert (twice / loop.CHECKPOINT).is_file()
    again = flatten(trained(parts), Machine("cpu", 2), twice, tiny_scene.Recorder())
    for name, tensor in model.tensors().items():
        assert torch.equal(tensor, again.tensors()[name]), name
    assert [path.name for path in twice.iterdir()] == [flattening.FLATTENED]


def inputs_of(parts: dict[str, Path], folder: Path, threads: int = 1) -> Inputs:
    return Inputs(parts, folder, {"depths.max_megapixels": 1.2}, Machine("cpu", threads))


@pytest.mark.usefixtures("few")
def test_stage_writes_a_map_for_every_photo_and_resumes_after_a_kill(
    parts: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    once.mkdir()
    twice.mkdir()
    summary = splat_depths.run(SplatDepthsConfig(enabled=True), inputs_of(parts, tmp_path), once, tiny_scene.Recorder())
    views = load_views(parts["undistort.dataset"])
    assert summary["maps"] == len(views) and 0.2 < summary["found"] <= 1.0
    assert [path.name for path in once.iterdir()] == ["maps"]
    done, real = [0], splat_depths.render_mean_depth

    def killed(*arguments, **options) -> np.ndarray:  # type: ignore[no-untyped-def]
        done[0] += 1
        if done[0] == 4:
            raise KeyboardInterrupt
        return real(*arguments, **options)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(splat_depths, "render_mean_depth", killed)
        splat_depths.run(SplatDepthsConfig(enabled=True), inputs_of(parts, tmp_path, 2), twice, tiny_scene.Recorder())
    assert len(list((twice / "rendered").iterdir())) == 3
    splat_depths.run(SplatDepthsConfig(enabled=True), inputs_of(parts, tmp_path, 2), twice, tiny_scene.Recorder())
    for first, second in zip(
        list_depth_maps(once / "maps", views), list_depth_maps(twice / "maps", views), strict=True
    ):
        assert first.path.read_bytes() == second.path.read_bytes()
        found = first.load()
        assert ((found.depth > 0.0) == (found.confidence > 0)).all()


def test_disabled_it_writes_no_maps_and_with_blocks_the_splat_is_used_unchanged(
    parts: dict[str, Path], tmp_path: Path
) -> None:
    off = SplatDepthsConfig(enabled=False)
    assert splat_depths.run(off, inputs_of(parts, tmp_path), tmp_path, tiny_scene.Recorder())["maps"] == 0
    blocks = tmp_path / "blocks.json"
    blocks.write_text('{"shards": 2}')
    report = tiny_scene.Recorder()
    given = inputs_of(parts | {"blocks.plan": blocks}, tmp_path)
    assert splat_depths.run(SplatDepthsConfig(enabled=True), given, tmp_path, report)["maps"] == tiny_scene.CAMERAS
    assert any("blocks" in note for note in report.notes)
    for text in ("[]", "{}", '{"shards": "many"}', "no JSON"):
        blocks.write_text(text)
        with pytest.raises(StageError, match=r"blocks\.json cannot be read"):
            splat_depths.run(SplatDepthsConfig(enabled=True), given, tmp_path, report)


def test_broken_exposures_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "exposures.json"
    for fields in ("[]", "{}", '{"views": 3}', '{"views": {"a": 1}}', '{"views": {"a": [["x"]]}}', "no JSON"):
        path.write_text(fields)
        with pytest.raises(StageError) as raised:
            read_exposures(path, "train")
        assert "--rerun-from train" in raised.value.hint
    path.write_text(json.dumps({"views": {"a": [[1, 0, 0, 0]] * 3}}))
    assert read_exposures(path, "train") == {"a": [[1.0, 0.0, 0.0, 0.0]] * 3}


def test_whole_photos_are_used_and_often_enough(parts: dict[str, Path]) -> None:
    views, split = load_views(parts["undistort.dataset"]), tiny_scene.split_of(load_views(parts["undistort.dataset"]))
    options = options_of(Gaussians.empty(5, 2), Rendering(True, (0.0, 0.0, 0.0), 0.1, None), has_exposures=False)
    assert options.sh_degree == 2 and options.antialias and options.exposure == "off" and not options.densify
    plan = flattening_plan(options, views, split, 5, WINDOW_PIXELS["cpu"])
    assert plan.schedule.iterations == plan.last_iteration == MIN_ITERATIONS
    assert [each.level for each in plan.schedule.stretches] == [0]
    smaller = flattening_plan(options, views, split, 5, tiny_scene.WIDTH * tiny_scene.HEIGHT // 4)
    assert [(each.level, each.window_pixels) for each in smaller.schedule.stretches] == [(1, 0)]
    assert not any(smaller.schedule.density.is_step(each) for each in range(1, MIN_ITERATIONS))
