"""The CUDA backend's order of depth, lists of tiles and chunks, on the CPU through the harness."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from building import FORWARD, HARNESS, build_on_cpu, kernel_sources
from frames import ORDERS, DeviceFrame, Memory, RenderCase, controls, pointer, run

from splatpipe.pipeline.raster.cuda.cuda_api import SplatPictures
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary

BAD, TOO_LITTLE = -1, -2
CULLED = 0xFFFFFFFF
SORT_BLOCK = 2048
CHUNK_TILES = 1 << 16
TILE = 16
LOG2_ALPHA_MIN = -np.log2(255.0)
SORTED_COUNTS = [0, 1, 31, 33, SORT_BLOCK - 1, SORT_BLOCK, SORT_BLOCK + 1, 2 * SORT_BLOCK + 77]
"""None, a warp's borders, a block's, and several blocks."""


@pytest.fixture(scope="module")
def library() -> CudaLibrary:
    return CudaLibrary(build_on_cpu([*kernel_sources(), HARNESS / "binning.cu"], "binning"))


@pytest.fixture(autouse=True)
def as_ever(library: CudaLibrary) -> Iterator[None]:
    yield
    controls(library).harness_order(FORWARD, 0)


@pytest.fixture(params=ORDERS, ids=["forward", "reverse", "shuffled"])
def any_order(library: CudaLibrary, request: pytest.FixtureRequest) -> None:
    """Threads and blocks run in several orders."""
    controls(library).harness_order(*request.param)


def internal(library: CudaLibrary, name: str) -> ctypes.CDLL._FuncPtr:
    """A function of binning.cu."""
    return getattr(controls(library), name)


def sorted_by(library: CudaLibrary, keys: np.ndarray, blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """The keys that are kept in order, and their places before it."""
    at, count, blocks_of_keys = Memory(), len(keys), -(-len(keys) // SORT_BLOCK)
    both = at.empty("keys", (2 * count,), keys.dtype.type)
    both[:count] = keys
    values = at.empty("values", (2 * count,), np.int32)
    table = at.empty("table", (256 * max(blocks_of_keys, 1),), np.uint32)
    sums, kept = at.empty("sums", (256,), np.uint32), at.put("kept", np.zeros(1, np.int32))
    name = "sort_depths" if keys.dtype == np.uint32 else "sort_tiles"
    memory = [ctypes.c_void_p(pointer(array)) for array in (both, values, table, sums, kept)]
    arguments = (*memory[:2], ctypes.c_int64(count), blocks, *memory[2:])
    assert internal(library, name)(*arguments) == 0, controls(library).harness_message()
    assert not at.overrun()
    return both[: kept[0]], values[: kept[0]]


@pytest.mark.parametrize("count", SORTED_COUNTS)
def test_depths_are_sorted_stably_without_the_culled(library, any_order, count):
    rng = np.random.default_rng(count)
    keys = rng.uniform(0.2, 50.0, max(count // 3, 1)).astype(np.float32).view(np.uint32)
    keys = np.where(rng.random(count) < 0.2, np.uint32(CULLED), rng.choice(keys, count))
    expected = [i for i in np.argsort(keys, kind="stable") if keys[i] != CULLED]
    for blocks in (1, 2):
        ours, places = sorted_by(library, keys, blocks)
        assert places.tolist() == expected
        assert np.array_equal(ours, keys[places])


@pytest.mark.parametrize("count", SORTED_COUNTS)
@pytest.mark.parametrize("tiles", [1, 256, 1 << 16])
def test_tiles_are_sorted_stably(library, any_order, count, tiles):
    keys = np.random.default_rng(count).integers(tiles - min(tiles, 300), tiles, count).astype(np.uint16)
    ours, places = sorted_by(library, keys, 2)
    assert np.array_equal(places, np.argsort(keys, kind="stable"))
    assert np.array_equal(ours, keys[places])


def test_all_culled_leave_nothing(library):
    assert len(sorted_by(library, np.full(SORT_BLOCK + 5, CULLED, np.uint32), 2)[0]) == 0


@dataclass(frozen=True)
class Plan:
    counts: np.ndarray
    tile_begin: np.ndarray
    chunk_begin: np.ndarray
    facts: list[int]


def planned(library: CudaLibrary, counts: np.ndarray, capacity: int) -> Plan:
    """Return the plan for tiles with given numbers of pairs."""
    at, tiles = Memory(), len(counts)
    differences = at.put("counts", np.diff(counts, prepend=0, append=0).astype(np.int32))
    begin, chunks = at.empty("begin", (tiles + 1,), np.int64), at.empty("chunks", (tiles + 1,), np.int32)
    facts = at.empty("facts", (3,), np.int64)
    arrays = [ctypes.c_void_p(pointer(array)) for array in (differences, begin, chunks, facts)]
    code = internal(library, "plan")(arrays[0], tiles, ctypes.c_int64(capacity), *arrays[1:])
    assert code == 0, controls(library).harness_message()
    assert not at.overrun()
    return Plan(differences[:tiles], begin, chunks[: facts[2] + 1], facts.tolist())


def chunks_of(counts: np.ndarray, capacity: int) -> list[int]:
    """Return the chunks, each with as many tiles as fit."""
    begins, pairs = [0], 0
    for tile, count in enumerate(counts.tolist()):
        if tile - begins[-1] == CHUNK_TILES or pairs + count > capacity:
            begins.append(tile)
            pairs = 0
        pairs += count
    return [*begins, len(counts)]


@pytest.mark.parametrize(
    ("tiles", "most", "capacity"),
    [
        (1, 0, 0),
        (1, 5, 5),
        (12, 9, 9),
        (12, 9, 1000),
        (2047, 20, 300),
        (2049, 20, 1 << 20),
        (CHUNK_TILES, 3, 1 << 20),
        (CHUNK_TILES + 1, 3, 1 << 20),
        (5000, 2_600_000, 1 << 30),
        (140_000, 100_000, (1 << 31) - SORT_BLOCK),
    ],
)
def test_plan_puts_whole_tiles_into_chunks(library, any_order, tiles, most, capacity):
    counts = np.random.default_rng(tiles).integers(0, most + 1, tiles)
    plan = planned(library, counts, capacity)
    assert np.array_equal(plan.counts, counts)
    assert np.array_equal(plan.tile_begin, np.concatenate([[0], np.cumsum(counts)]))
    assert plan.chunk_begin.tolist() == chunks_of(counts, capacity)
    assert plan.facts[0] == counts.sum()


def test_plan_of_more_pairs_than_32_bits_can_count(library):
    counts = np.full(32_400, 2_600_000)  # an image of 3840 x 2160, each of 2.6 million Gaussians covering all of it
    plan = planned(library, counts, 1 << 28)
    assert plan.facts[0] == 32_400 * 2_600_000 > 1 << 36
    assert plan.tile_begin[-1] == plan.facts[0]
    assert (np.diff(plan.tile_begin[plan.chunk_begin]) <= 1 << 28).all()
    assert plan.chunk_begin.tolist() == chunks_of(counts, 1 << 28)


def scene(count: int, size: tuple[int, int], scales: tuple[float, float], seed: int = 0) -> RenderCase:
    """Gaussians in front of a camera at the origin, with scales drawn between two, some of them behind it."""
    rng = np.random.default_rng(seed)
    width, height = size
    focal = 0.9 * max(size)
    depth = rng.choice(rng.uniform(1.0, 6.0, max(count // 2, 1)), count)  # some at the same depth
    depth[rng.random(count) < 0.1] *= -1
    place = rng.uniform(-0.7, 0.7, (count, 2)) * np.array(size) / focal * np.abs(depth)[:, None]
    rows = {
        "means": np.concatenate([place, depth[:, None]], axis=1),
        "log_scales": np.log(rng.uniform(*scales, (count, 3))),
        "quats": rng.normal(size=(count, 4)),
        "opacity_logits": rng.uniform(-5.0, 4.0, count),
        "sh": rng.normal(size=(count, 1, 3)) * 0.5,
    }
    upstream = {"colour": rng.normal(size=(height, width, 3)), "alpha": rng.normal(size=(height, width))}
    return RenderCase(
        {name: values.astype(np.float32) for name, values in rows.items()},
        np.eye(3, 4),
        (focal, focal, width / 2 + 0.3, height / 2 - 0.2),
        size,
        {name: values.astype(np.float32) for name, values in upstream.items()},
        sh_degree=0,
        depths=False,
    )


@dataclass(frozen=True)
class Lists:
    """Memory contents of a frame of one chunk."""

    records: np.ndarray  # (n, 12)
    order: np.ndarray  # (visible)
    offsets: np.ndarray  # (visible + 1)
    tiles: list[list[int]]
    owners: np.ndarray  # (pairs)


def lists_of(library: CudaLibrary, case: RenderCase, capacity: int = 1 << 14) -> Lists:
    frame = DeviceFrame(library, case, capacity)
    frame.forward()
    assert not frame.at.overrun()
    pairs, visible, chunks = frame.facts()
    assert chunks == 1
    width, height = case.size
    tiles = -(-width // TILE) * -(-height // TILE)
    places = np.zeros(7, np.int64)
    capacity = max(capacity, case.count)
    internal(library, "places")(
        ctypes.c_int64(case.count), ctypes.c_int64(tiles), ctypes.c_int64(capacity), ctypes.c_void_p(pointer(places))
    )

    def read(piece: int, count: int, dtype: type) -> np.ndarray:
        begin = int(places[piece])
        return frame._memory[begin : begin + count * np.dtype(dtype).itemsize].view(dtype)

    begin, values, owners = read(3, tiles + 1, np.int64), read(5, pairs, np.uint32), read(6, pairs, np.uint32)
    return Lists(
        read(0, 12 * case.count, np.float32).reshape(-1, 12),
        read(1, visible, np.int32),
        np.append(read(2, visible, np.uint32).astype(np.int64), pairs),
        [owners[values[begin[tile] : begin[tile + 1]]].tolist() for tile in range(tiles)],
        owners,
    )


def furthest(record: np.ndarray, dy_first: float, dy_last: float, sign: int) -> float:
    """Return an ellipse's reach right (or left) of its centre between two rows, by search on a concave function."""
    a, b, c, reach = (*record[2:5], record[5] - LOG2_ALPHA_MIN)

    def offset(dy: float) -> float:
        return float((sign * np.sqrt(max(reach - (c * dy) ** 2, 0.0)) - b * dy) / a)

    low, high = dy_first, dy_last
    for _ in range(200):
        first, second = low + (high - low) / 3, high - (high - low) / 3
        if sign * offset(first) < sign * offset(second):
            low = first
        else:
            high = second
    return offset((low + high) / 2)


def tiles_touched(record: np.ndarray, size: tuple[int, int]) -> list[int]:
    """Tiles with a column of pixel centres that the ellipse reaches in the tile's rows of pixels, row by row."""
    width, height = size
    record = record.astype(np.float64)
    half = np.sqrt(record[5] - LOG2_ALPHA_MIN) / record[4]
    found = []
    for row in range(-(-height // TILE)):
        first = max(row * TILE + 0.5 - record[1], -half)
        last = min(min(row * TILE + TILE, height) - 0.5 - record[1], half)
        if first > last:
            continue
        left = max(np.ceil(record[0] + furthest(record, first, last, -1) - 0.5), 0)
        right = min(np.floor(record[0] + furthest(record, first, last, 1) - 0.5), width - 1)
        if left <= right:
            tiles_x = -(-width // TILE)
            found += range(row * tiles_x + int(left) // TILE, row * tiles_x + int(right) // TILE + 1)
    return found


SCENES = {
    "small ones": scene(300, (100, 37), (0.005, 0.1)),
    "odd and tall": scene(60, (17, 650), (0.02, 3.0), 1),
    "wide": scene(60, (600, 20), (0.02, 3.0), 2),
    "all in one tile": scene(400, (16, 16), (0.01, 0.1), 3),
    "large ones": scene(40, (120, 90), (0.5, 5.0), 4),
    "more than a block": scene(700, (50, 40), (0.005, 0.05), 5),
    "one": scene(1, (33, 31), (0.5, 0.6), 7),
}


@pytest.mark.parametrize("case", SCENES.values(), ids=SCENES)
def test_lists_are_the_definition_s(library, case):
    lists = lists_of(library, case)
    visible = sorted(lists.order.tolist())
    depths = lists.records[:, 9]
    assert lists.order.tolist() == sorted(visible, key=lambda i: (depths[i], i))
    touched = {i: tiles_touched(lists.records[i], case.size) for i in visible}
    expected: list[list[int]] = [[] for _ in lists.tiles]
    for i in lists.order.tolist():
        for tile in touched[i]:
            expected[tile].append(i)
    assert lists.tiles == expected
    counts = [len(touched[i]) for i in lists.order.tolist()]
    assert np.array_equal(lists.offsets, np.concatenate([[0], np.cumsum(counts)]))
    assert np.array_equal(lists.owners, np.repeat(lists.order, counts))


@pytest.mark.parametrize("name", ["small ones", "odd and tall"])
def test_lists_do_not_depend_on_the_order_of_threads(library, any_order, name):
    lists = lists_of(library, SCENES[name])
    controls(library).harness_order(FORWARD, 0)
    expected = lists_of(library, SCENES[name])
    assert lists.tiles == expected.tiles
    assert np.array_equal(lists.offsets, expected.offsets)


@pytest.mark.parametrize("name", ["small ones", "wide", "large ones"])
def test_chunks_and_passes_change_no_bit(library, name):
    case = SCENES[name]
    whole = run(library, case)
    assert whole.facts[2] == 1
    pairs, most = whole.facts[0], case.count
    chunks = set()
    for capacity, passes in [(pairs, 1), (pairs - 1, 1), (pairs - 1, 2), (pairs // 4, 2), (most, 5)]:
        outcome = run(library, case, max(capacity, most), passes)
        assert not outcome.differs(whole)
        chunks.add(outcome.facts[2])
    assert len(chunks) >= 2, "each capacity gave the same chunks"


@pytest.mark.parametrize("passes", [1, 3])
def test_an_empty_view_is_the_background(library, passes):
    case = scene(20, (40, 30), (0.1, 0.2))
    behind = {**case.rows, "means": case.rows["means"] * np.float32([1, 1, 0]) - np.float32([0, 0, 1])}
    none = {name: rows[:0] for name, rows in case.rows.items()}
    for rows in (behind, none):
        outcome = run(library, case.changed(rows=rows, background=(0.25, 0.5, 0.75)), len(rows["means"]), passes)
        assert (outcome.pictures["colour"] == np.float32([0.25, 0.5, 0.75])).all()
        assert (outcome.pictures["alpha"] == 0).all()
        assert not outcome.pictures["visible"].any()
        assert outcome.facts == (0, 0, 1)
        assert all((gradient == 0).all() for gradient in outcome.gradients.values())


def test_invalid_arguments_are_refused(library):
    case = SCENES["one"]

    def code(**changes: int) -> int:
        frame = DeviceFrame(library, case)
        for name, value in changes.items():
            setattr(frame.frame if hasattr(frame.frame, name) else frame.shot, name, value)
        pictures = frame.at.empty("pictures", (4 * 33 * 31,))
        to = SplatPictures(colour=pointer(pictures), alpha=pointer(pictures) + 12 * 33 * 31)
        radii, visible = frame.at.empty("radii", (1,)), frame.at.empty("visible", (1,), np.uint8)
        return internal(library, "splat_forward")(
            *(ctypes.byref(given) for given in (frame.shot, frame.model, frame.frame, to)),
            *(ctypes.c_void_p(pointer(given)) for given in (radii, visible)),
            None,
        )

    assert code() == 0
    assert code(capacity=0) == BAD
    assert code(capacity=1 << 31) == BAD
    assert code(count=-1) == BAD
    assert code(passes=0) == BAD
    assert code(width=0) == BAD
    assert code(sh_degree=4) == BAD
    assert code(depths=1) == BAD
    assert code(memory=DeviceFrame(library, case).frame.memory + 16) == BAD
    assert code(bytes=1000) == TOO_LITTLE
