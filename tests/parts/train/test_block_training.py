"""Training one block: only its Gaussians change, on the windows that show it, bit-identical however it is run."""

import hashlib
import json
import math
import os
import signal
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_scene
import torch
from block_sites import CELLS, CONFIG, PARTITION, TASK, WINDOW, Kill, coverages_of, step_with, surveyed, trained

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks, load_split, load_views
from splatpipe.pipeline.raster.device import cpu
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS
from splatpipe.pipeline.splat.quality.free_space import free_space
from splatpipe.pipeline.splat.sky.backdrop import backdrop_limit
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.blocks.block_windows import block_windows
from splatpipe.pipeline.train.blocks.cells.needs import block_need
from splatpipe.pipeline.train.blocks.cells.partition import Cell, Partition
from splatpipe.pipeline.train.blocks.cells.sample_mask import MARGINS, counted_samples
from splatpipe.pipeline.train.blocks.coarse import TrainingLimits, train_coarse
from splatpipe.pipeline.train.blocks.schedules import block_schedule, share_at
from splatpipe.pipeline.train.blocks.scope import BlockScope, read_free_space, rows_of
from splatpipe.pipeline.train.blocks.training import Block, SiteParts, train_block
from splatpipe.pipeline.train.densify import room_at
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.lengths import PART_VISITS, PhotoSizes
from splatpipe.pipeline.train.plan.limits import FIXED_BYTES, PIXEL_BYTES
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.plan.windows import windows_of
from splatpipe.pipeline.train.state import memory
from splatpipe.pipeline.train.state.checkpoint import load_checkpoint
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.stages import initialize


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> SiteParts:
    """A scene with its coarse pass."""
    folder = tmp_path_factory.mktemp("site")
    tiny_scene.write_dataset(folder / "dataset", masked="flight 1/photo_5.png")
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    parts |= {"initialize.splat": folder / "init.ply", **tiny_scene.split_part(folder / "dataset", 4)}
    (folder / "coarse").mkdir()
    inputs = Inputs(parts, folder, machine=Machine("cpu", 1))
    train_coarse(CONFIG, inputs, TrainingLimits(150, WINDOW), folder / "coarse", tiny_scene.Recorder())
    return surveyed(
        SiteParts(folder / "dataset", parts["split.views"], folder / "coarse", folder / "prospects", PARTITION)
    )


@pytest.fixture(scope="module")
def undisturbed(site: SiteParts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(site, tmp_path_factory.mktemp("undisturbed"))


def digest(out: Path) -> str:
    return hashlib.sha256(b"".join((out / name).read_bytes() for name in ("model.ply", "history.json"))).hexdigest()


def test_coarse_pass_trains_whole_photos_at_the_first_size(site: SiteParts) -> None:
    plan = TrainingPlan.from_json((site.coarse / "plan.json").read_text())
    assert [(stretch.level, stretch.window_pixels) for stretch in plan.schedule.stretches] == [(1, 0)]
    assert len(read_splat(site.coarse / "model.ply")) <= 150 == plan.options.max_gaussians
    assert {path.name for path in site.coarse.iterdir()} - {loop.CHECKPOINT} == {
        *("model.ply", "sky.npz", "skies.npz", "exposures.json", "rendering.json", "plan.json", "history.json")
    }


def test_result_is_of_cell_and_margin_only_and_keeps_to_its_shares(site: SiteParts, undisturbed: Path) -> None:
    model = read_splat(undisturbed / "model.ply")
    points = model.means.double().numpy()
    assert PARTITION.trained_by(0, points).all()
    own = int((PARTITION.owners(points) == 0).sum())
    assert 100 < own <= TASK.share and own < len(model) <= TASK.trained
    start = read_splat(site.coarse / "model.ply")
    inside = PARTITION.trained_by(0, start.means.double().numpy())
    assert len(model) > inside.sum()  # it has grown


def test_outside_a_boundary_a_block_stays_coarse(site: SiteParts, undisturbed: Path, tmp_path: Path) -> None:
    plan = PARTITION.plan
    inside = np.array([[-4.0, -2.0], [-1.0, -2.0], [-1.0, 4.0], [-4.0, 4.0]])
    area = PlanArea(plan.axes, ((inside,),))
    most = backdrop_limit(0, TASK.trained)
    outside = [
        int((~area.contains(read_splat(folder / "model.ply").means.double().numpy())).sum())
        for folder in (undisturbed, trained(replace(site, area=area), tmp_path))
    ]
    assert outside[0] > 1.25 * most >= outside[1] > 0  # a few wander out after the last step of density control


def test_frozen_gaussians_stay_bit_identical_and_have_no_moments(
    site: SiteParts, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    around, held = [], []
    frozen = read_splat(undisturbed / "frozen.ply")
    assert 0 < len(frozen) <= TASK.frozen

    def observe(state: TrainState, photo: TrainingPhoto) -> None:
        assert len(state.drawn) == len(state.gaussians) + len(frozen)
        around.append(state.drawn.detach().after(len(state.gaussians)))
        moments = (*state.adam.mean.values(), *state.adam.square.values(), *state.density.to_arrays().values())
        assert all(len(tensor) == len(state.gaussians) for tensor in moments)
        tensors = (*state.drawn.tensors().values(), *moments)
        held.append(sum(tensor.numel() * tensor.element_size() for tensor in tensors))

    step_with(monkeypatch, observe)
    trained(site, tmp_path, threads=2)
    for name in PARAMETERS:
        assert all(torch.equal(getattr(drawn, name), getattr(frozen, name)) for drawn in (around[0], around[-1]))
    need = block_need(TASK.trained, TASK.frozen, WINDOW, CONFIG.sh_degree)
    assert max(held) <= need.memory_bytes - FIXED_BYTES - PIXEL_BYTES * WINDOW
    curve = json.loads((tmp_path / "history.json").read_text())["curve"]
    assert curve[-1]["loss"] < curve[0]["loss"]
    assert digest(tmp_path) == digest(undisturbed)


def test_windows_that_show_the_cell_are_each_used_as_often_as_without_blocks(site: SiteParts, tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"iterations": "auto", "least_iterations": 1})
    other = surveyed(replace(site, prospects=tmp_path / "prospects"), config, 400)
    looked = []
    for number in range(2):
        block = Block.of(config, other, replace(TASK, number=number, window_pixels=400), cpu())
        scope = block.scope_reader.scope()
        plan = block.plan(scope.windows)
        order = block.setup(plan, scope, tmp_path).order_of(plan.schedule.training_sizes_until(plan.last_iteration))
        each = [order.at(iteration) for iteration in range(1, len(order) + 1)]
        times = Counter((visit.view, visit.level, visit.window) for visit in each)
        assert {level for _, level, _ in times} == {0, 1} and set(times.values()) == {PART_VISITS}  # coarse had level 2
        assert {view for view, *_ in times} == set(range(len(plan.train_views)))
        looked.append({(plan.train_views[view], level, window) for view, level, window in times})
    # Cameras look along the line between the cells: the left cell is roughly in the left of the image.
    first, second = looked
    assert max(window.left for _, level, window in first if level == 0) < 0.75 * tiny_scene.WIDTH
    assert min(window.right for _, level, window in second if level == 0) > 0.25 * tiny_scene.WIDTH
    every = {name for name, *_ in first | second}
    whole = len(windows_of(tiny_scene.WIDTH, tiny_scene.HEIGHT, 400))
    assert len({part for part in first | second if part[1] == 0}) > 0.9 * whole * len(every)


def test_killed_block_resumes_with_other_threads_and_ends_with_the_same_bits(
    site: SiteParts, undisturbed: Path, tmp_path: Path
) -> None:
    def observe(state: TrainState, photo: TrainingPhoto) -> None:
        if state.iteration == 31:
            raise Kill

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        step_with(patch, observe)
        trained(site, tmp_path)
    assert (tmp_path / loop.CHECKPOINT).exists()
    assert digest(trained(site, tmp_path, threads=2)) == digest(undisturbed)


def test_memory_of_the_process_does_not_end_a_blocks_growth(
    site: SiteParts, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if the process had trained other blocks before."""
    monkeypatch.setattr(memory, "resident_bytes", lambda: 10**15)
    recorder = tiny_scene.Recorder()
    limited = CONFIG.model_copy(update={"max_memory_bytes": 2_000_000_000})
    train_block(limited, site, TASK, Machine("cpu", 1), tmp_path, recorder)
    assert digest(tmp_path) == digest(undisturbed) and not recorder.warnings


def test_a_blocks_views_read_back_and_a_missing_file_is_reported(site: SiteParts, tmp_path: Path) -> None:
    views = [view for view in load_views(site.dataset) if view.camera.name in set(load_split(site.split).train)]
    points, tracks = load_points_and_tracks(site.dataset)
    cameras = [view.camera for view in views]
    made = free_space(cameras, points.xyz, [tracks[camera.name] for camera in cameras])
    read = read_free_space(site.prospects, cameras)
    assert np.array_equal(read.support, made.support) and len(read.photos) == len(cameras)
    for ours, theirs in zip(read.photos, made.photos, strict=True):
        assert ours.camera is theirs.camera and ours.near == theirs.near
        assert np.array_equal(ours.depth, theirs.depth) and np.array_equal(ours.box, theirs.box)
    read_back = BlockScope.read(site.prospects, 0)
    read_back.write(tmp_path, 0)
    assert (tmp_path / "block_1.npz").read_bytes() == (site.prospects / "block_1.npz").read_bytes()
    assert sorted(read_back.sample_masks) == rows_of(read_back.windows) and len(read_back.around.rows) > 0
    for read_missing in (lambda: BlockScope.read(tmp_path, 1), lambda: read_free_space(tmp_path, cameras)):
        with pytest.raises(StageError, match="cannot be read") as raised:
            read_missing()
        assert "blocks" in raised.value.hint


def test_interrupt_leaves_a_checkpoint(site: SiteParts, tmp_path: Path) -> None:
    def observe(state: TrainState, photo: TrainingPhoto) -> None:
        if state.iteration == 9:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        step_with(patch, observe)
        trained(site, tmp_path)
    plan = TrainingPlan.from_json((tmp_path / "plan.json").read_text())
    assert load_checkpoint(tmp_path / loop.CHECKPOINT, plan.digest()).facts["iteration"] == 10


def test_pixels_that_count_are_near_the_cell_or_have_no_depth(site: SiteParts) -> None:
    points, _ = load_points_and_tracks(site.dataset)
    beside = np.ones((3, 3), np.uint8)
    (x0, y0), (x1, y1) = CELLS[0].low, CELLS[0].high
    end = 999.0
    around = ((-end, -end, x0, end), (x1, -end, end, end), (x0, -end, x1, y0), (x0, y1, x1, end))
    cells = (CELLS[0], *(Cell((left, low), (right, high)) for left, low, right, high in around))
    enclosed = replace(PARTITION, cells=cells)  # whose first cell is not an outer one
    for coverage in coverages_of(site):
        assert coverage.depth is not None
        rows, columns = np.indices(coverage.depth.shape).reshape(2, -1)
        depth = np.where(coverage.depth > 0.0, coverage.depth, 9.0)
        places = coverage.grid.unproject(np.stack([columns, rows], axis=1) + 0.5, depth.ravel().astype(np.float64))
        distances = CELLS[0].distance(PARTITION.places(places)).reshape(depth.shape)
        depth[:4, :4] = 0.0
        distances[:4, :4] = 0.0
        blind = replace(coverage, depth=depth, observed=np.zeros(0, np.int64))
        found = counted_samples(PARTITION, 0, blind, points.xyz)
        near = distances <= (MARGINS - 0.01) * PARTITION.margin
        far = distances > MARGINS * PARTITION.margin * 2**0.5
        assert found[near].all() and not found[cv2.erode(far.astype(np.uint8), beside) > 0].any()
        assert 0.1 < found.mean() < 1.0
        # Thin objects missing from the depth: only pixels near a point count.
        lost = counted_samples(enclosed, 0, replace(coverage, depth=np.full_like(depth, 500.0)), points.xyz)
        observed = coverage.of_points(points.xyz)
        inside = CELLS[0].contains(PARTITION.plan.places(observed.places))
        across, down = observed.pixels[inside].astype(int).T
        assert len(down) and lost[down, across].all() and lost.sum() <= 9 * len(observed.pixels)


def test_photos_come_with_their_counting_pixels_and_share_of_the_whole(
    site: SiteParts, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos: list[TrainingPhoto] = []

    def observe(state: TrainState, photo: TrainingPhoto) -> None:
        photos.append(photo)
        if len(photos) == 60:
            raise Kill

    step_with(monkeypatch, observe)
    for name in ("plan.json", "frozen.ply"):
        (tmp_path / name).write_bytes((undisturbed / name).read_bytes())
    with pytest.raises(Kill):
        trained(site, tmp_path)
    half = "flight 1/photo_5.png"  # its mask leaves windows without a pixel
    assert {photo.camera.name for photo in photos if photo.is_empty} <= {half}
    for photo in photos:
        here = photo.colour[photo.inside] if photo.mask is None else photo.mask[photo.inside]
        number = here.shape[0] * here.shape[1] if photo.mask is None else int(here.sum())
        counting = tiny_scene.WIDTH * tiny_scene.HEIGHT // (2 if photo.camera.name == half else 1)
        assert photo.share == number / counting
    cut = [photo for photo in photos if photo.mask is not None and not photo.mask.all()]
    assert 0.2 * len(photos) < len(cut) < len(photos)


def test_a_blocks_windows_are_those_of_its_training(site: SiteParts, undisturbed: Path) -> None:
    kept = set(load_split(site.split).train)
    views = [view for view in load_views(site.dataset) if view.camera.name in kept]
    points, _ = load_points_and_tracks(site.dataset)
    block, _ = block_windows(CONFIG, views, coverages_of(site), points.xyz, PARTITION, WINDOW)
    plan = TrainingPlan.from_json((undisturbed / "plan.json").read_text())
    assert (block.photos, block.iterations) == (len(plan.train_views), plan.schedule.iterations)
    assert np.array_equal(block.windows[0], BlockScope.read(site.prospects, 0).windows[0])
    density = plan.schedule.density
    assert block.steps == sum(map(density.is_step, range(1, plan.schedule.iterations + 1))) > 0


def test_positions_move_as_fast_as_in_the_whole_with_as_many_gaussians() -> None:
    config = TrainConfig(iterations=1600, max_gaussians=60_000)
    footage = PhotoSizes(((640, 420, 40),))
    whole = resolve_schedule(config, footage)
    # 800 of the iterations are the coarse pass's, and the whole has all of its Gaussians by then.
    assert share_at(config, footage, 1.0) == whole.density.last / 1600 == 0.5
    assert share_at(config, footage, 0.0) == whole.density.first / 1600
    for part in (0.1, 0.36, 0.9):
        at = 1600 * share_at(config, footage, part)
        room = room_at(replace(whole.density, every=0), 0, round(at))
        assert abs(room / 60_000 - part) < 0.01
        begun = block_schedule(config, footage, footage, {0: 40}, part)
        assert math.isclose(begun.at(0).means_rate, whole.rates.means_at(at / 1600), rel_tol=1e-12)
        assert math.isclose(begun.at(800).means_rate, whole.at(1600).means_rate, rel_tol=1e-12)


def test_a_cell_that_no_photo_sees_keeps_the_coarse_passs_gaussians(site: SiteParts, tmp_path: Path) -> None:
    far = Partition(PARTITION.plan, (*CELLS, Cell((90.0, 90.0), (99.0, 99.0))), PARTITION.margin)
    summary = train_block(
        CONFIG,
        surveyed(replace(site, partition=far, prospects=tmp_path / "prospects")),
        replace(TASK, number=2),
        Machine("cpu", 1),
        tmp_path,
        tiny_scene.Recorder(),
    )
    assert summary["gaussians"] == summary["photos"] == 0 == len(read_splat(tmp_path / "model.ply"))
    assert TrainingPlan.from_json((tmp_path / "plan.json").read_text()).schedule.iterations == 0
