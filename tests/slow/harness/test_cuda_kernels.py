"""The CUDA kernels' own sources, run on the CPU by the harness, against the definition and the CPU's kernels."""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from agreement import flipped, gradient_complaints, picture_complaints, without_flips
from building import FORWARD, HARNESS, REVERSE, SHUFFLED, build_on_cpu, kernel_sources
from exact import case_of, exact_outcome
from frames import DeviceFrame, RenderCase, RenderOutcome, controls, run
from random_scene import random_camera, random_scene

from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary
from splatpipe.pipeline.splat.model.gaussians import Gaussians

TILE = 16


@pytest.fixture(scope="module")
def library() -> CudaLibrary:
    return CudaLibrary(build_on_cpu([*kernel_sources(), HARNESS / "peek.cu"], "splat_cuda_peeked"))


@pytest.fixture(autouse=True)
def as_it_was(library: CudaLibrary) -> Iterator[ctypes.CDLL]:
    harness = controls(library)
    yield harness
    harness.harness_order(FORWARD, 0)
    harness.harness_multiprocessors(3)


def crowd(count: int, seed: int, size: float = -2.0, sh_degree: int = 1) -> Gaussians:
    """Thousands that overlap, so translucent that most of them count, many at one depth."""
    scene = random_scene(seed, count, sh_degree, size)
    scene.opacity_logits = 0.5 * scene.opacity_logits - 3.0
    scene.means[:, 2] = (scene.means[:, 2] * 8).round() / 8
    return scene


def in_one_tile() -> RenderCase:
    """Everything small, in the tile with pixels 32..47 x 16..31; all others are empty."""
    camera = replace(random_camera(5, 50, 37), cam_from_world=np.eye(4))  # so that equal depths stay equal
    scene = crowd(1100, 5)
    generator = torch.Generator().manual_seed(5)
    pixels = torch.rand(len(scene), 2, generator=generator, dtype=torch.float64) * 10 + torch.tensor([35.0, 19.0])
    depth = 3.0 + (torch.rand(len(scene), generator=generator, dtype=torch.float64) * 16).round() / 8
    rays = torch.stack([(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy], 1)
    points = torch.cat([rays, torch.ones(len(scene), 1, dtype=torch.float64)], 1) * depth[:, None]
    scene.means = points.float()
    scene.log_scales = 0.2 * scene.log_scales - 4.0
    return case_of(scene, camera)


def opaque() -> RenderCase:
    """Pixels saturate early, behind a few of many Gaussians."""
    scene = random_scene(3, 500, 0, size=-0.8)
    scene.opacity_logits += 3.0
    return case_of(scene, random_camera(3, 40, 33), background=(1.0, 1.0, 1.0))


def left_half_empty() -> RenderCase:
    scene = random_scene(7, 300, 3, size=-2.5)
    scene.means[:, 0] = scene.means[:, 0].abs() * 0.5 + 0.4
    return case_of(scene, random_camera(7, 200, 19), antialias=True, background=(0.1, 0.5, 0.9))


def far_too_long() -> RenderCase:
    """Gaussians across more tile rows than one thread counts, with hundreds of pairs each."""
    scene = random_scene(13, 40, 0, size=-1.0)
    scene.log_scales[:, 0] += 2.5
    return case_of(scene, random_camera(13, 50, 260))


CASES: dict[str, Callable[[], RenderCase]] = {
    "thousands": lambda: case_of(crowd(2500, 1, size=-1.3), random_camera(1, 45, 35), background=(0.2, 0.4, 0.6)),
    "one tile with everything": in_one_tile,
    "pixels that end": opaque,
    "empty tiles, antialias": left_half_empty,
    "long": far_too_long,
    "one pixel": lambda: case_of(random_scene(4, 30), random_camera(4, 1, 1)),
    "upright": lambda: case_of(random_scene(4, 60), random_camera(4, 17, 130), sh_degree=2),
    "no depth": lambda: case_of(random_scene(9, 60), random_camera(9), depths=False, antialias=True),
    "magnitudes": lambda: case_of(random_scene(9, 60), random_camera(9), magnitudes=True, sh_degree=1),
    "magnitudes, no depth": lambda: case_of(random_scene(9, 60), random_camera(9), magnitudes=True, depths=False),
}
"""Sizes are odd; (45, 35) is a grid of 3 x 3 tiles, (40, 33) of 3 x 3, (200, 19) of 13 x 2, (17, 130) of 2 x 9."""


@functools.cache
def case_and_outcomes(library: CudaLibrary, name: str) -> tuple[RenderCase, RenderOutcome, RenderOutcome]:
    """A case with the results of harness and definition; gradients are zero where a rounding decides."""
    case = CASES[name]()
    ours, exact = run(library, case), exact_outcome(case)
    flips = flipped(ours, exact)
    if flips.any():
        case = without_flips(case, flips)
        ours, exact = run(library, case), exact_outcome(case)
    return case, ours, exact


@pytest.mark.parametrize("name", CASES)
def test_frame_and_every_gradient_are_those_of_the_definition(library: CudaLibrary, name: str) -> None:
    _, ours, exact = case_and_outcomes(library, name)
    assert picture_complaints(ours, exact) + gradient_complaints(ours, exact) == []


@pytest.mark.parametrize("name", CASES)
def test_frame_and_every_gradient_are_those_of_the_cpus_kernels(library: CudaLibrary, name: str) -> None:
    case, ours, _ = case_and_outcomes(library, name)
    native = exact_outcome(case, "native")
    assert picture_complaints(ours, native) + gradient_complaints(ours, native) == []


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("order", [(REVERSE, 0), (SHUFFLED, 1)], ids=["reverse", "shuffled"])
def test_order_of_threads_and_blocks_gives_the_same_bits(
    library: CudaLibrary, as_it_was: ctypes.CDLL, name: str, order: tuple[int, int]
) -> None:
    case, ours, _ = case_and_outcomes(library, name)
    as_it_was.harness_order(*order)
    assert run(library, case).differs(ours) == []


@pytest.mark.parametrize("multiprocessors", [1, 40])
def test_size_of_the_device_gives_the_same_bits(
    library: CudaLibrary, as_it_was: ctypes.CDLL, multiprocessors: int
) -> None:
    case, ours, _ = case_and_outcomes(library, "thousands")
    as_it_was.harness_multiprocessors(multiprocessors)
    assert run(library, case).differs(ours) == []


@pytest.mark.parametrize("name", ["pixels that end", "long", "one tile with everything", "magnitudes, no depth"])
def test_chunks_and_passes_give_the_same_bits(library: CudaLibrary, name: str) -> None:
    case, ours, _ = case_and_outcomes(library, name)
    pairs, least = ours.facts[0], case.count
    chunks = set()
    for capacity, passes in ((least, 1), (least, 2), (pairs - 1, 1), (pairs, 1), (pairs * 2 // 3 + 1, 4)):
        again = run(library, case, capacity, passes)
        assert again.differs(ours) == [], (capacity, passes)
        assert (again.facts[2] == 1) == (max(capacity, least) >= pairs)
        chunks.add(again.facts[2])
    assert len(chunks) > 1 or pairs <= least


@pytest.mark.parametrize("passes", [1, 2])
def test_what_exceeds_the_forecast_is_the_work_of_all_blocks(
    library: CudaLibrary, as_it_was: ctypes.CDLL, passes: int
) -> None:
    """Only prefix sums are one block's; a whole backward pass by one would take seconds on a card."""
    case, ours, _ = case_and_outcomes(library, "thousands")
    before = as_it_was.harness_switches(), as_it_was.harness_switches_alone()
    again = run(library, case, case.count, passes)
    work, alone = as_it_was.harness_switches() - before[0], as_it_was.harness_switches_alone() - before[1]
    assert again.facts[2] > passes and again.differs(ours) == []
    assert alone < 0.25 * work


def peeked(frame: DeviceFrame, what: int, kind: type, count: int) -> np.ndarray:
    """A copy of a piece of the frame's memory."""
    harness = controls(frame.library)
    harness.peek.restype = ctypes.c_void_p
    harness.peek.argtypes = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.c_int]
    place = harness.peek(frame.frame.memory, frame.frame.count, tile_count(frame.case), frame.frame.capacity, what)
    size = count * np.dtype(kind).itemsize
    return np.frombuffer(ctypes.string_at(place, size), kind)


def tile_count(case: RenderCase) -> int:
    return math.ceil(case.size[0] / TILE) * math.ceil(case.size[1] / TILE)


def tile_lists(frame: DeviceFrame) -> list[np.ndarray]:
    """Each tile's Gaussians, of a frame in one chunk."""
    begin = peeked(frame, 1, np.int64, tile_count(frame.case) + 1)
    slots = peeked(frame, 3, np.uint32, int(begin[-1]))
    owners = peeked(frame, 4, np.uint32, int(begin[-1]))
    assert sorted(slots) == list(range(len(slots)))
    return [owners[slots[first:end]].astype(np.int64) for first, end in pairwise(begin)]


def least_distance2(record: np.ndarray, xs: tuple[float, float], ys: tuple[float, float]) -> np.ndarray:
    """The least u² + v² of splats in a rectangle: zero around a centre, else on one of the sides; (n)."""
    x, y, a, b, c = (record[:, i] for i in range(5))

    def at(dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        return (a * dx + b * dy) ** 2 + (c * dy) ** 2

    sides = [at(np.clip(-b * dy / a, xs[0] - x, xs[1] - x), dy) for dy in (ys[0] - y, ys[1] - y)]
    sides += [at(dx, np.clip(-a * b * dx / (b * b + c * c), ys[0] - y, ys[1] - y)) for dx in (xs[0] - x, xs[1] - x)]
    inside = (xs[0] <= x) & (x <= xs[1]) & (ys[0] <= y) & (y <= ys[1])
    return np.where(inside, 0.0, np.min(sides, axis=0))


@pytest.mark.parametrize("name", CASES)
def test_each_tile_lists_what_touches_it_from_near_to_far(library: CudaLibrary, name: str) -> None:
    case = CASES[name]()
    frame = DeviceFrame(library, case)
    visible = np.flatnonzero(frame.forward()["visible"])
    records = peeked(frame, 5, np.float32, 12 * case.count).reshape(-1, 12)[visible].astype(np.float64)
    order = np.argsort(records[:, 9], kind="stable")
    ranks = peeked(frame, 0, np.int32, len(visible))
    np.testing.assert_array_equal(ranks, visible[order])
    records, rank_of = records[order], np.full(case.count, -1)
    rank_of[ranks] = np.arange(len(ranks))

    reach = records[:, 5] + math.log2(255.0)
    x, y, a, b, c = (records[:, i, None, None] for i in range(5))
    for tile, listed in enumerate(tile_lists(frame)):
        listed = rank_of[listed]
        assert (np.diff(listed) > 0).all() and (listed >= 0).all()  # from near to far, each once
        xs, ys = pixel_centres(case, tile)
        u, v = a * (xs[None, None, :] - x) + b * (ys[None, :, None] - y), c * (ys[None, :, None] - y)
        must = np.flatnonzero((u**2 + v**2).min((1, 2)) < reach - 1e-4)
        assert np.isin(must, listed).all()  # all that contribute to a pixel
        least = least_distance2(records[listed], (xs[0], xs[-1]), (ys[0], ys[-1]))
        assert (least <= reach[listed] + 1e-4).all()  # none that does not reach the tile


def pixel_centres(case: RenderCase, tile: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of a tile's pixels inside the image."""
    width, height = case.size
    columns = math.ceil(width / TILE)
    left, top = tile % columns * TILE, tile // columns * TILE
    return np.arange(left, min(width, left + TILE)) + 0.5, np.arange(top, min(height, top + TILE)) + 0.5


def test_an_empty_view_is_the_background(library: CudaLibrary) -> None:
    behind = random_scene(1, 20)
    behind.means[:, 2] = -5.0
    for scene in (behind, Gaussians.empty(0, 3)):
        case = case_of(scene, random_camera(1), background=(0.2, 0.4, 0.6))
        outcome = run(library, case)
        np.testing.assert_array_equal(outcome.pictures["colour"][..., 1], np.float32(0.4))
        for name in ("alpha", "depth_sum", "depth_square_sum", "median_depth", "radii", "visible"):
            assert not outcome.pictures[name].any()
        assert not any(gradient.any() for gradient in outcome.gradients.values())
        assert outcome.facts[:2] == (0, 0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38, -3e38])
def test_hostile_numbers_are_skipped_and_do_not_affect_the_others(library: CudaLibrary, value: float) -> None:
    scene = random_scene(2, 60, 1)
    hostile = torch.zeros(len(scene), dtype=torch.bool)
    for row, tensor in enumerate(scene.tensors().values()):
        if (row, value) not in ((1, -3e38), (3, 3e38)):  # no extent, or full opacity: both are valid
            tensor.view(len(scene), -1)[5 + 7 * row, -1] = value
            hostile[5 + 7 * row] = True
    case, spared = (case_of(each, random_camera(2)) for each in (scene, scene.select(~hostile)))
    outcome, others = run(library, case), run(library, spared)
    keep = (~hostile).numpy()
    for name in ("colour", "alpha", "depth_sum", "median_depth"):
        assert outcome.pictures[name].tobytes() == others.pictures[name].tobytes()
    assert not outcome.pictures["visible"][~keep].any()
    for name, gradient in outcome.gradients.items():
        assert gradient[keep].tobytes() == others.gradients[name].tobytes()
        assert not gradient[~keep].any()


def test_more_tiles_than_a_chunk_may_have_are_two_chunks(library: CudaLibrary) -> None:
    scene = random_scene(4, 60, 0, size=-3.0)
    camera = replace(random_camera(4, 4100, 4100), fx=1500.0, fy=1500.0)
    case = case_of(scene, camera).changed(upstream={}, depths=False)
    assert tile_count(case) > 1 << 16
    ours, native = run(library, case), exact_outcome(case, "native", gradients=False)
    assert ours.facts[2] == 2
    beyond = np.abs(ours.pictures["colour"] - native.pictures["colour"]) > 1e-3  # a pixel's place is rounded to 2e-4 px
    assert beyond.any(2).sum() <= 10
    assert all((ours.pictures["alpha"][part] > 0).any() for part in (slice(1000, 2000), slice(-1, None)))


def test_invalid_arguments_are_refused(library: CudaLibrary) -> None:
    case = case_of(random_scene(1, 20), random_camera(1))
    for change in ({"size": (0, 5)}, {"sh_degree": 4}, {"sh_degree": -1}):
        with pytest.raises(ValueError, match="splat_"):
            run(library, case.changed(**change))
    for field, value in (("bytes", -1), ("count", -1), ("capacity", 19), ("passes", 0), ("memory", None)):
        frame = DeviceFrame(library, case)
        setattr(frame.frame, field, value)
        with pytest.raises(ValueError, match="splat_forward"):
            frame.forward()
    frame = DeviceFrame(library, case)
    frame.forward()
    frame.frame.back_bytes -= 256
    with pytest.raises(ValueError, match="splat_blend_backward"):
        frame.blend_backward()


@pytest.mark.parametrize("name", ["colour", "alpha", "depth_sum", "depth_square_sum"])
def test_image_without_a_gradient_has_a_zero_gradient(library: CudaLibrary, name: str) -> None:
    case = case_of(random_scene(9, 40, 1), random_camera(9, 33, 20), background=(0.3, 0.2, 0.1))
    without = {other: weights for other, weights in case.upstream.items() if other != name}
    zeros = without | {name: np.zeros_like(case.upstream[name])}
    ours, same = (run(library, case.changed(upstream=upstream)) for upstream in (without, zeros))
    assert all((ours.gradients[key] == gradient).all() for key, gradient in same.gradients.items())
    assert ours.differs(run(library, case)) != []
