"""Blocks: cells of similar work, the photos that see them, what is drawn around them, and a seamless merge."""

import json
import math
import weakref
from collections.abc import Mapping
from pathlib import Path

import building_site
import numpy as np
import pytest
import torch
from block_borders import PlanLine, borders
from jaxtyping import Float64

from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.raster.rasterizer import render
from splatpipe.pipeline.splat.containers.ply import write_splat, write_splat_parts
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.assembly import count_and_degree, own_pieces, owned
from splatpipe.pipeline.train.blocks.cells.cutting import BINS, cut, shares, site, work_map
from splatpipe.pipeline.train.blocks.cells.needs import (
    BlockNeed,
    block_need,
    fewest_blocks,
    need_of_blocks,
    round_pixels,
    shared_cap,
    with_margin,
)
from splatpipe.pipeline.train.blocks.cells.partition import NO_OWNER, Cell, Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage, photo_coverages
from splatpipe.pipeline.train.blocks.cells.surroundings import visible_around
from splatpipe.pipeline.train.blocks.cells.thinning import thinned
from splatpipe.pipeline.train.blocks.cells.visibility import block_views, windows
from splatpipe.pipeline.train.plan.limits import FIXED_BYTES

UP = np.array([0.0, 0.0, 1.0])


PLAN = GroundPlan.across(UP)


EVERY = 7  # stride: every seventh point of the surface is a sparse one


@pytest.fixture(scope="module")
def surface() -> Float64[np.ndarray, "n 3"]:
    return building_site.surface()


@pytest.fixture(scope="module")
def coarse(surface: Float64[np.ndarray, "n 3"]) -> Gaussians:
    return building_site.model(surface)


@pytest.fixture(scope="module")
def sparse(surface: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "p 3"]:
    return surface[::EVERY].copy()


@pytest.fixture(scope="module")
def seen(coarse: Gaussians, sparse: Float64[np.ndarray, "p 3"]) -> list[PhotoCoverage]:
    return building_site.site_coverages(coarse, sparse)


def divided(seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"], cells: int) -> Partition:
    return cut(work_map(PLAN, site(PLAN, seen, sparse), seen, sparse), cells)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -2, 0), (0.3, -0.5, 0.8), (-1, 0, 0)])
def test_plan_for_any_up_direction_is_a_rotation(up: tuple[float, float, float]) -> None:
    plan = GroundPlan.across(np.array(up, np.float64))
    turn = np.vstack([plan.axes, plan.up])
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-15) and np.linalg.det(turn) > 0.0
    assert np.allclose(plan.up, np.array(up) / np.linalg.norm(up), atol=1e-15)
    points = np.random.default_rng(1).normal(size=(50, 3))
    assert np.allclose(plan.points(plan.places(points), plan.heights(points)), points, atol=1e-14)
    assert plan.places(points)[7].tobytes() == plan.places(points[7:8])[0].tobytes()  # wherever a point is


def test_line_of_a_plan_knows_its_sides() -> None:
    line = PlanLine((1.0, 1.0), (4.0, 5.0))
    assert line.length == 5.0
    places = np.array([line.place(2.0, 0.5), line.place(-1.0, -3.0)])
    assert np.allclose(line.along(places), [2.0, -1.0]) and np.allclose(line.beside(places), [0.5, -3.0])


@pytest.mark.parametrize("cells", [1, 2, 3, 4, 7, 16])
def test_cells_share_points_and_pixels(
    seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"], cells: int
) -> None:
    work = work_map(PLAN, site(PLAN, seen, sparse), seen, sparse)
    partition = cut(work, cells)
    assert len(partition.cells) == cells
    found = shares(work, partition)
    assert np.allclose(found.sum(axis=1), 1.0)
    # Two measures, one cut: neither is divided exactly. Points and pixels of this site differ by a third in places.
    assert found.max() <= 1.35 / cells and found.min() >= 0.65 / cells
    assert math.isclose(partition.margin, 0.1 * math.sqrt(sum(cell.area for cell in partition.cells) / cells))


def test_every_place_of_the_site_has_one_owner(seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]) -> None:
    partition = divided(seen, sparse, 7)
    places = np.random.default_rng(2).uniform([-5.0, -5.0, -3.0], [53.0, 29.0, 9.0], (4000, 3))
    corners = np.array([corner for cell in partition.cells for corner in (cell.low, cell.high)])
    places = np.vstack([places, np.column_stack([corners, np.zeros(len(corners))])])
    inside = np.array([cell.contains(places[:, :2]) for cell in partition.cells])
    assert inside.sum(axis=0).max() == 1
    owners = partition.owners(places)
    within = inside.any(axis=0)
    assert np.array_equal(owners[within], inside.argmax(axis=0)[within])
    bounds = np.array([[*cell.low, *cell.high] for cell in partition.cells])
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    assert np.array_equal(within, ((places[:, :2] >= low) & (places[:, :2] < high)).all(axis=1))


def test_places_beyond_the_site_belong_to_the_nearest_cell(
    seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]
) -> None:
    partition = divided(seen, sparse, 7)
    bounds = np.array([[*cell.low, *cell.high] for cell in partition.cells])
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    places = np.random.default_rng(3).uniform([-1e4, -1e4, -30.0], [1e4, 1e4, 900.0], (4000, 3))
    beyond = places[((places[:, :2] < low) | (places[:, :2] >= high)).any(axis=1)]
    assert len(beyond) > 3900
    distances = np.array([cell.distance(beyond[:, :2]) for cell in partition.cells])
    owners = partition.owners(beyond)
    owned_at = distances[owners, np.arange(len(beyond))]
    assert np.allclose(owned_at, distances.min(axis=0), rtol=1e-12)
    for block in range(len(partition.cells)):
        assert partition.trained_by(block, beyond)[owners == block].all()
    broken = np.array([[math.nan] * 3, [math.inf, 0.0, 0.0], [0.0, -math.inf, 0.0]])
    assert partition.owners(broken).tolist() == 3 * [NO_OWNER]
    assert not partition.trained_by(0, broken).any()


def test_borders_are_where_owners_change(seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]) -> None:
    partition = divided(seen, sparse, 7)
    found = borders(partition)
    for border in found:
        for along in (0.1, 0.5, 0.9):
            sides = np.array([border.line.place(along * border.line.length, beside) for beside in (-1e-6, 1e-6)])
            assert set(partition.owners(np.column_stack([sides, [0.0, 0.0]]))) == set(border.blocks)
    ends = np.array([[*cell.low, *cell.high] for cell in partition.cells])
    around = 2.0 * float((ends[:, 2:].max(axis=0) - ends[:, :2].min(axis=0)).sum())
    every = sum(2.0 * (x1 - x0 + y1 - y0) for x0, y0, x1, y1 in ends.tolist())
    assert math.isclose(2.0 * sum(border.line.length for border in found) + around, every)


def test_neighbours_along_one_edge_have_a_border_each() -> None:
    cells = (Cell((0.0, 0.0), (1.0, 3.0)), Cell((1.0, 0.0), (2.0, 2.0)), Cell((1.0, 2.0), (2.0, 3.0)))
    lines = {(border.blocks, border.line.start, border.line.end) for border in borders(Partition(PLAN, cells, 0.1))}
    along = {((0, 1), (1.0, 0.0), (1.0, 2.0)), ((0, 2), (1.0, 2.0), (1.0, 3.0))}
    assert lines == along | {((1, 2), (1.0, 2.0), (2.0, 2.0))}


def test_partition_is_the_same_again_and_reads_back(
    seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]
) -> None:
    facts = json.dumps(divided(seen, sparse, 5).facts())
    assert json.dumps(divided(seen, sparse, 5).facts()) == facts
    assert json.dumps(divided(list(reversed(seen)), sparse, 5).facts()) == facts  # whatever the photos' order
    back = Partition.of_facts(json.loads(facts))
    assert json.dumps(back.facts()) == facts and back.cells == divided(seen, sparse, 5).cells
    with pytest.raises((KeyError, ValueError, TypeError)):
        Partition.of_facts({**json.loads(facts), "cells": []})


def test_background_and_wrong_depths_do_not_widen_the_site(
    seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]
) -> None:
    extent = site(PLAN, seen, sparse)
    for low, high, size in zip(extent.low, extent.high, (building_site.LENGTH, building_site.WIDTH), strict=True):
        assert -0.5 < low < 1.0 and size - 1.0 < high < size + 0.5
    changed = []
    for coverage in seen:
        depth = coverage.depth.copy()
        depth[:12] *= 40.0  # a seventh of each photo shows hills
        depth[40, ::29] *= 0.4  # and a few pixels something that is not there
        changed.append(PhotoCoverage(coverage.camera, coverage.grid, depth, None, coverage.observed))
    assert np.allclose(site(PLAN, changed, sparse).low, extent.low, atol=1.5)
    assert np.allclose(site(PLAN, changed, sparse).high, extent.high, atol=1.5)
    ring = np.array([[10.0, 0.0], [20.0, 0.0], [20.0, 24.0], [10.0, 24.0]])
    drawn = site(PLAN, seen, sparse, PlanArea.seen_from_above([(ring,)]))
    assert drawn.low[0] >= 10.0 and drawn.high[0] <= 20.0


def test_a_flat_cloud_of_points_without_a_model_is_divided(seen: list[PhotoCoverage]) -> None:
    line = np.column_stack([np.linspace(0.0, 10.0, 400), np.full(400, 3.0), np.zeros(400)])
    rows = np.arange(400)
    flat = [PhotoCoverage(coverage.camera, coverage.grid, None, None, rows) for coverage in seen]
    partition = divided(flat, line, 4)
    assert np.bincount(partition.owners(line) + 1, minlength=5)[1:].min() >= 60
    with pytest.raises(ValueError, match="sees"):
        site(PLAN, [PhotoCoverage(s.camera, s.grid, None, None, rows[:0]) for s in seen], line)
    with pytest.raises(ValueError, match="bins"):
        cut(work_map(PLAN, site(PLAN, flat, line), flat, line), 2 * BINS)


def test_a_blocks_photos_show_all_of_its_cell(seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]) -> None:
    partition = divided(seen, sparse, 4)
    views = block_views(partition, seen, sparse, building_site.quarters)
    whole = sum(coverage.camera.width * coverage.camera.height for coverage in seen)
    for block, view in enumerate(views):
        assert view.covered >= 0.98
        assert 0 < view.pixels < 0.75 * whole
        for photo in view.photos:
            assert photo.windows.any() and photo.pixels == int(photo.windows.sum()) * 80 * 60
        names = {seen[photo.photo].camera.name for photo in view.photos}
        others = [k for k in range(len(seen)) if seen[k].camera.name not in names]
        for number in others:  # no part of the cell that a photo shows is lost
            samples = seen[number].samples(sparse)
            visible = samples.weights[partition.owners(samples.places) == block].sum()
            assert visible <= 0.08 * seen[number].pixels


def test_work_of_a_block_is_forecast_before_anything_is_divided(
    seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]
) -> None:
    pixels = sum(coverage.pixels for coverage in seen)
    window = math.sqrt(80 * 60) * building_site.HEIGHT / building_site.FOCAL
    area = building_site.LENGTH * building_site.WIDTH
    for blocks in (2, 4, 7):
        views = block_views(divided(seen, sparse, blocks), seen, sparse, building_site.quarters)
        real = sum(view.pixels for view in views) / blocks
        assert 1 / 1.5 < round_pixels(pixels, blocks, window, area) / real < 1.5
    assert round_pixels(pixels, 1, window, area) == pixels
    assert round_pixels(pixels, 2, 100.0 * window, area) == pixels  # each block sees all, and no more than all


def test_windows_are_those_of_training(seen: list[PhotoCoverage]) -> None:
    camera = seen[0].camera
    assert windows(camera, 0).tolist() == [[0, 0, camera.width, camera.height]]
    parts = windows(camera, 5000)
    visible = np.zeros((camera.height, camera.width), np.int64)
    for left, top, right, bottom in parts.tolist():
        visible[top:bottom, left:right] += 1
        assert (right - left) * (bottom - top) <= 5000
    assert len(parts) > 1 and (visible == 1).all()


def test_a_building_hides_the_ground_behind_it(coarse: Gaussians, sparse: Float64[np.ndarray, "p 3"]) -> None:
    """A photo that looks at a wall from nearby does not train the block behind it, however near that is."""
    x0, y0, x1, y1, _ = building_site.BUILDINGS[0]
    before = building_site.camera("low", np.array([10.0, y0 - 5.0, 1.5]), np.array([0.0, 1.0, 0.0]))
    rows = building_site.observed(sparse, [before], coarse)
    coverage = photo_coverages([before], rows, lambda grid: building_site.depth_of(coarse, grid))
    behind = Cell((x0 + 2.0, y1 + 0.5), (x1 - 2.0, y1 + 6.0))
    partition = Partition(PLAN, (Cell((x0, y0 - 1.0), (x1, y1)), behind), 0.5)
    views = block_views(partition, coverage, sparse, building_site.quarters)
    assert [photo.photo for photo in views[0].photos] == [0] and views[1].photos == ()
    _, pixels, _ = before.in_view(np.array([[10.0, y1 + 3.0, 0.0]]))
    assert len(pixels) == 1  # although it is inside its image


def test_without_a_coarse_model_points_determine_visibility(
    coarse: Gaussians, seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]
) -> None:
    by_points = building_site.site_coverages(coarse, sparse, by_depth=False)
    assert math.isclose(sum(by_points[0].samples(sparse).weights), by_points[0].pixels)
    partition = divided(seen, sparse, 4)
    both = [block_views(partition, kind, sparse, building_site.quarters) for kind in (seen, by_points)]
    for one, other in zip(*both, strict=True):
        a, b = ({photo.photo for photo in view.photos} for view in (one, other))
        assert len(a & b) >= 0.9 * len(a | b)


def test_masked_pixels_do_not_count_as_work(coarse: Gaussians, sparse: Float64[np.ndarray, "p 3"]) -> None:
    view = building_site.flight()[0]
    rows = building_site.observed(sparse, [view], coarse)
    half = np.zeros((86, 115), np.bool_)

    def left_half(grid: object) -> np.ndarray:
        half[:, : half.shape[1] // 2] = True
        return half

    (coverage,) = photo_coverages([view], rows, lambda grid: np.full((86, 115), 20.0, np.float32), left_half)
    samples = coverage.samples(sparse)
    assert abs(samples.weights.sum() / (view.width * view.height) - 57 / 115) < 0.01
    assert samples.pixels[:, 0].max() <= view.width / 2 and math.isclose(
        coverage.pixels, samples.weights.sum(), rel_tol=0.02
    )


def test_surroundings_leave_a_blocks_photos_unchanged(
    coarse: Gaussians, seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]
) -> None:
    """A block's Gaussians, trained and frozen, look like the whole in its photos; thinned, nearly so."""
    partition = divided(seen, sparse, 4)
    views = block_views(partition, seen, sparse, building_site.quarters)
    cuts = [building_site.quarters(coverage.camera) for coverage in seen]
    for block in (0, 3):
        view, worst = (views[block], seen, cuts), []
        found = visible_around(partition, block, coarse, view)
        trained = partition.trained_by(block, coarse.means.double().numpy())
        whole = found.within(coarse, len(coarse))
        assert len(found.rows) == len(whole) < len(coarse) - trained.sum()
        fewer = found.within(coarse, len(whole) // 2)
        assert len(fewer) <= len(whole) // 2
        evenly = torch.arange(len(fewer)) * len(whole) // len(fewer)
        own = coarse.select(torch.from_numpy(trained))
        for around in (whole, fewer, whole.select(evenly)):
            drawn = Gaussians.concat([own, around])
            psnr = [_likeness(coarse, drawn, seen[p.photo], cuts[p.photo][p.windows]) for p in view[0].photos]
            worst.append(min(psnr))
        assert worst[0] > 45.0 and worst[1] > 24.0 and worst[1] > worst[2] + 3.0


def _likeness(whole: Gaussians, drawn: Gaussians, coverage: PhotoCoverage, parts: np.ndarray) -> float:
    pictures = [render(model, coverage.camera, building_site.OPTIONS).colour for model in (whole, drawn)]
    square = np.square((pictures[0] - pictures[1]).numpy())
    visible = [square[top:bottom, left:right].ravel() for left, top, right, bottom in parts.tolist()]
    return -10.0 * math.log10(max(float(np.concatenate(visible).mean()), 1e-12))


def test_thinning_keeps_moments_and_isolated_gaussians() -> None:
    generator = torch.Generator().manual_seed(3)
    pair = Gaussians.empty(3, 1)
    pair.means = torch.tensor([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [9.0, 9.0, 9.0]])
    pair.log_scales = torch.log(torch.tensor([[0.1, 0.2, 0.05]] * 3))
    pair.quats = torch.randn(3, 4, generator=generator)
    pair.quats[1] = pair.quats[0]
    pair.sh = torch.randn(3, 4, 3, generator=generator)
    found = thinned(pair, np.full(3, 1.5))  # rounded down to 1
    assert len(found) == 2
    for before, after in zip(pair.tensors().values(), found.tensors().values(), strict=True):
        assert torch.equal(before[2], after[0])  # alone, as it was
    assert torch.allclose(found.means[1], torch.tensor([0.2, 0.1, 0.1]), atol=1e-6)
    assert torch.allclose(found.sh[1], pair.sh[:2].mean(0), atol=1e-6)
    spread = [_covariance(pair, 0) + torch.diag(torch.tensor([0.01, 0.0, 0.0])), _covariance(found, 1)]
    assert torch.allclose(*spread, atol=1e-6)
    light = torch.sigmoid(found.opacity_logits[1]) * torch.exp(found.log_scales[1]).prod() ** (2 / 3)
    assert math.isclose(float(light), 2 * 0.5 * 0.001 ** (2 / 3), rel_tol=1e-5)
    same = thinned(pair, np.full(3, 0.01))
    assert all(torch.equal(a, b) for a, b in zip(pair.tensors().values(), same.tensors().values(), strict=True))


def _covariance(gaussians: Gaussians, row: int) -> torch.Tensor:
    w, x, y, z = (gaussians.quats[row] / gaussians.quats[row].norm()).tolist()
    turn = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    axes = turn * torch.exp(gaussians.log_scales[row])
    return axes @ axes.T


def merged(partition: Partition, trained: Mapping[int, Gaussians]) -> Gaussians:
    count, degree = count_and_degree(partition, trained.__getitem__)
    whole = Gaussians.concat(list(own_pieces(partition, trained.__getitem__)))
    assert (len(whole), whole.sh_degree) == (count, degree)
    return whole


class ModelSource:
    """Creates models on demand, and records whether an earlier one is still alive."""

    def __init__(self, models: Mapping[int, Gaussians]) -> None:
        self.models, self.order, self.alive = models, list[int](), 0
        self._made: list[weakref.ref[np.ndarray]] = []

    def __call__(self, block: int) -> Gaussians:
        self.alive += sum(array() is not None for array in self._made)
        self.order.append(block)
        made = {name: tensor.numpy().copy() for name, tensor in self.models[block].tensors().items()}
        self._made = [weakref.ref(array) for array in made.values()]  # which tensors and all views of them keep
        return Gaussians.from_tensors({name: torch.from_numpy(array) for name, array in made.items()})


def test_merge_takes_each_gaussian_once_in_any_order(
    coarse: Gaussians, seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"]
) -> None:
    partition = divided(seen, sparse, 4)
    means = coarse.means.double().numpy()
    trained = {}
    for block in range(4):
        part = coarse.select(torch.from_numpy(partition.trained_by(block, means)))
        part.sh = part.sh + 0.01 * (block + 1)  # each block has learned different values, also in its margin
        trained[block] = part
    whole = merged(partition, trained)
    assert len(whole) == len(coarse)
    assert torch.equal(torch.unique(whole.means, dim=0), torch.unique(coarse.means, dim=0))  # none lost, none twice
    for order in ((3, 2, 1, 0), (1, 3, 0, 2)):
        again = merged(partition, {block: trained[block] for block in order})
        for a, b in zip(whole.tensors().values(), again.tensors().values(), strict=True):
            assert a.numpy().tobytes() == b.numpy().tobytes()
    learnt = whole.sh[:, 0, 0] - merged(partition, dict.fromkeys(range(4), coarse)).sh[:, 0, 0]
    owners = partition.owners(whole.means.double().numpy())
    assert np.allclose(learnt.numpy(), 0.01 * (owners + 1), atol=1e-6)
    with pytest.raises(KeyError):
        merged(partition, {0: coarse})


def test_blocks_merged_one_at_a_time_give_the_same_bytes_as_all_at_once(
    coarse: Gaussians, seen: list[PhotoCoverage], sparse: Float64[np.ndarray, "p 3"], tmp_path: Path
) -> None:
    partition = divided(seen, sparse, 4)
    means = coarse.means.double().numpy()
    trained = {n: coarse.select(torch.from_numpy(partition.trained_by(n, means))) for n in range(4)}
    read = ModelSource(trained)
    count, degree = count_and_degree(partition, read)
    write_splat_parts(tmp_path / "merged.ply", own_pieces(partition, read), count, degree, ["a comment"])
    assert read.order == 2 * [0, 1, 2, 3] and read.alive == 0
    whole = Gaussians.concat([owned(partition, block, read.models[block]) for block in range(4)])
    write_splat(tmp_path / "whole.ply", whole, ["a comment"])
    assert (tmp_path / "merged.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    held = read(0)
    assert read(1) is not held and read.alive == len(held.tensors())  # it would have been noticed
    with pytest.raises(ValueError, match="degrees"):
        count_and_degree(partition, {**trained, 3: Gaussians.empty(3, 0 if degree else 1)}.__getitem__)


def test_gaussians_that_move_into_a_neighbours_cell_are_dropped(coarse: Gaussians) -> None:
    partition = Partition(PLAN, (Cell((0.0, 0.0), (10.0, 24.0)), Cell((10.0, 0.0), (20.0, 24.0))), 1.0)
    wandered = coarse.clone()
    wandered.means[0] = torch.tensor([15.0, 3.0, 0.0])
    assert not bool((owned(partition, 0, wandered).means == wandered.means[0]).all(1).any())
    assert float(owned(partition, 1, wandered).means[:, 0].min()) >= 10.0


def test_caps_add_up_and_follow_the_work() -> None:
    assert shared_cap(100, [1.0, 1.0, 1.0]) == [34, 33, 33]
    assert shared_cap(10, [0.0, 0.0]) == [5, 5]
    assert shared_cap(1000, [3.0, 1.0], least=100) == [700, 300]
    generator = np.random.default_rng(4)
    for _ in range(200):
        weights = generator.uniform(0.0, 3.0, generator.integers(1, 30)).tolist()
        cap = int(generator.integers(0, 100_000))
        found = shared_cap(cap, weights)
        assert sum(found) == cap
        wanted = np.array(weights) / sum(weights) * cap
        assert np.abs(np.array(found) - wanted).max() <= 1.0 + 1e-6
    with pytest.raises(ValueError, match="shared"):
        shared_cap(10, [1.0] * 3, least=4)
    assert with_margin(1000, 200, 300) == 1500 and with_margin(1000, 0, 0) == 1000


def test_blocks_are_as_few_as_memory_allows() -> None:
    whole = need_of_blocks(1, 1_000_000, 500_000, 3)
    assert fewest_blocks(1_000_000, whole.memory_bytes, 500_000, 3) == 1
    count = fewest_blocks(1_000_000, whole.memory_bytes - 1, 500_000, 3)
    assert count is not None and count > 1
    for blocks in range(2, 40):
        need, smaller = (need_of_blocks(n, 1_000_000, 500_000, 3) for n in (blocks, blocks + 1))
        assert smaller.memory_bytes < need.memory_bytes
        assert fewest_blocks(1_000_000, need.memory_bytes, 500_000, 3) <= blocks
        assert need.trained * blocks >= 1_000_000
    assert fewest_blocks(1_000_000, FIXED_BYTES, 500_000, 3) is None
    assert isinstance(block_need(10, 5, 1, 0), BlockNeed)
    assert block_need(10, 6, 1, 3).memory_bytes > block_need(10, 5, 1, 3).memory_bytes
