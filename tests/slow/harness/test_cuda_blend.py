"""The CUDA backend's blending alone, in the harness, against the float64 definition, with lists made here."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from building import FORWARD, HARNESS, REVERSE, SHUFFLED, build_on_cpu, load
from numpy.typing import NDArray
from torch import Tensor

from splatpipe.pipeline.raster.definitions import ALPHA_MAX, MEDIAN_SHIFT_MAX, MEDIAN_TRANSMITTANCE, TRANSMITTANCE_MIN

TILE = 16
HALF_LOG2_E = 0.5 / math.log(2.0)
LOG2_ALPHA_MIN = -7.994353436858858  # the kernels' float
FIELDS = ("x", "y", "a", "b", "c", "log2_opacity", "red", "green", "blue", "depth", "depth_u", "depth_v")  # a Record's
SLOT_FLOATS, DEPTH_SLOT_FLOATS = 12, 16
BACKGROUND, DEPTH_ORIGIN = (0.3, 0.1, 0.7), 4.0

# Tolerances of float32 against float64, as those of the CPU's kernels (test_raster_native.py).
COLOUR = 1e-5  # sums of hundreds of rounded terms of size 1
DEPTH = 1e-4  # sums of hundreds of rounded depths up to 10
GRADIENT = 3e-5  # L2 over all Gaussians, relative
DOUBTFUL = 10  # pixels at most, in which a rounding decides: two alphas at the cap, 0.99, leave the threshold, 1e-4
DOUBT_LOG2 = 3e-5  # how near to a threshold that is, in log2(alpha)
DOUBT_LEFT = 1e-7  # and in transmittance


class _Case(ctypes.Structure):
    """``Case`` of blend_alone.cu."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("width", "height", "count", "chunks", "magnitudes", "blocks")),
        ("depth_origin", ctypes.c_float),
        ("background", ctypes.c_float * 3),
        *((name, ctypes.c_void_p) for name in ("records", "order", "chunk_begin", "tile_begin", "slots_of", "owners")),
        *((name, ctypes.c_void_p) for name in ("offsets", "transmittance", "pixel_end", "slots", "sums")),
        *((name, ctypes.c_void_p) for name in ("colour", "alpha", "depth_sum", "depth_square_sum", "median_depth")),
        *((name, ctypes.c_void_p) for name in ("d_colour", "d_alpha", "d_depth_sum", "d_depth_square_sum")),
    )


class _Counts(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_uint) for name in ("met", "missed", "touched", "needed"))


@pytest.fixture(scope="module")
def kernels() -> ctypes.CDLL:
    return load(build_on_cpu([HARNESS / "blend_alone.cu"], "blend_alone"))


@pytest.fixture(autouse=True)
def forward_again(kernels: ctypes.CDLL) -> Iterator[None]:
    yield
    kernels.harness_order(FORWARD, 0)


@dataclass
class Scene:
    """Splats on an image, ``records`` (n, 12) float32, and their front-to-back order."""

    width: int
    height: int
    records: NDArray[np.float32]
    order: NDArray[np.int32] = field(init=False)

    def __post_init__(self) -> None:
        self.order = np.argsort(self.records[:, FIELDS.index("depth")], kind="stable").astype(np.int32)

    @property
    def tiles(self) -> tuple[int, int]:
        return -(-self.width // TILE), -(-self.height // TILE)

    def exactly(self) -> dict[str, Tensor]:
        columns = torch.from_numpy(self.records[self.order]).double()
        return dict(zip(FIELDS, columns.T[:, :, None, None], strict=True))


def random_scene(
    count: int, width: int, height: int, seed: int, opacity: tuple[float, float], log10_sigmas: tuple[float, float]
) -> Scene:
    """Gaussians of all orientations and proportions, some centred outside the image."""
    rng = np.random.default_rng(seed)
    angle, sigmas = rng.uniform(0.0, math.pi, count), 10.0 ** rng.uniform(*log10_sigmas, (2, count))
    cos, sin, long, short = np.cos(angle), np.sin(angle), sigmas[0] ** 2, sigmas[1] ** 2
    xx, yy, xy = long * cos**2 + short * sin**2 + 0.3, long * sin**2 + short * cos**2 + 0.3, (long - short) * cos * sin
    a = np.sqrt(HALF_LOG2_E * yy / (xx * yy - xy**2))
    columns = {
        "x": rng.uniform(-0.2, 1.2, count) * width,
        "y": rng.uniform(-0.2, 1.2, count) * height,
        "a": a,
        "b": -a * xy / yy,
        "c": np.sqrt(HALF_LOG2_E / yy),
        "log2_opacity": np.log2(rng.uniform(*opacity, count)),
        "depth": rng.uniform(2.0, 10.0, count),
        "depth_u": rng.normal(0.0, 0.3, count),
        "depth_v": rng.normal(0.0, 0.3, count),
    }
    columns |= {name: rng.uniform(0.0, 1.0, count) for name in ("red", "green", "blue")}
    return Scene(width, height, np.stack([columns[name] for name in FIELDS], axis=1).astype(np.float32))


@dataclass
class Answer:
    """Pictures, what is kept of every pixel (h, w), and the Gaussians' sums in the order of their ranks."""

    pictures: dict[str, Tensor]
    transmittance: Tensor
    ended_by: Tensor  # rank, or the number of Gaussians
    sums: dict[str, Tensor] = field(default_factory=dict)
    clear: Tensor = field(default_factory=lambda: torch.empty(0))  # where no rounding decides anything
    clamped: int = 0  # pairs of a pixel and a Gaussian whose alpha was capped


@cache
def blend_exactly(name: str, depth: bool) -> tuple[Answer, dict[str, Tensor]]:
    """The float64 definition over the whole image, and its derivatives by automatic differentiation.

    Returns:
        The answer, and the pictures' gradients that its sums belong to: zero where a rounding decides.
    """
    scene = SCENES[name]()
    s = scene.exactly()
    count = len(scene.records)
    y, x = torch.meshgrid(torch.arange(scene.height) + 0.5, torch.arange(scene.width) + 0.5, indexing="ij")
    dx, dy = x - s["x"], y - s["y"]
    u, v = s["a"] * dx + s["b"] * dy, s["c"] * dy
    leaves = {name: s[name].clone().requires_grad_() for name in FIELDS[6:]}
    power = (s["log2_opacity"] - u * u - v * v).requires_grad_()
    left = torch.ones(scene.height, scene.width, dtype=torch.float64)
    ended_by = torch.full(left.shape, count)
    colour, depth_sum, square_sum = torch.zeros(3, *left.shape), torch.zeros_like(left), torch.zeros_like(left)
    median, clear, clamped = torch.zeros_like(left), torch.ones_like(left, dtype=torch.bool), 0
    for i in range(count):
        alpha = torch.exp2(power[i]).clamp(max=ALPHA_MAX)
        met = (power[i].detach() >= LOG2_ALPHA_MIN) & (ended_by == count)
        after = left * (1.0 - alpha)
        on_edge = (power[i].detach() - LOG2_ALPHA_MIN).abs() < DOUBT_LOG2
        on_edge |= (power[i].detach() - math.log2(ALPHA_MAX)).abs() < DOUBT_LOG2
        on_edge |= met & ((after.detach() - TRANSMITTANCE_MIN).abs() < DOUBT_LEFT)
        on_edge |= met & ((after.detach() - MEDIAN_TRANSMITTANCE).abs() < DOUBT_LEFT)
        clear &= ~on_edge | (ended_by < count)
        clamped += int((met & (alpha.detach() == ALPHA_MAX)).sum())
        ended_by = ended_by.where(~met | (after.detach() >= TRANSMITTANCE_MIN), torch.tensor(i))
        blended = met & (ended_by == count)
        weight = torch.where(blended, alpha * left, 0.0)
        met_at = leaves["depth"][i] + leaves["depth_u"][i] * u[i] + leaves["depth_v"][i] * v[i]
        colour = colour + weight * torch.stack([leaves[name][i] for name in ("red", "green", "blue")])
        depth_sum, square_sum = depth_sum + weight * met_at, square_sum + weight * (met_at - DEPTH_ORIGIN) ** 2
        passes = blended & (left > MEDIAN_TRANSMITTANCE) & (after <= MEDIAN_TRANSMITTANCE)
        centre = leaves["depth"][i].detach()
        limited = met_at.detach().clamp((1.0 - MEDIAN_SHIFT_MAX) * centre, (1.0 + MEDIAN_SHIFT_MAX) * centre)
        median = median.where(~passes, limited)
        left = torch.where(blended, after, left)
    pictures = {
        "colour": (colour + left * torch.tensor(BACKGROUND)[:, None, None]).permute(1, 2, 0),
        "alpha": 1.0 - left,
        "depth_sum": depth_sum,
        "depth_square_sum": square_sum,
    }
    shown_pictures = {each: picture.detach() for each, picture in pictures.items()} | {"median_depth": median}
    gradients = random_gradients(scene, depth, clear)
    total = sum(((pictures[each] * gradient).sum() for each, gradient in gradients.items()), start=torch.zeros(()))
    g, *others = torch.autograd.grad(total, [power, *leaves.values()], materialize_grads=True)
    g, by = g / math.log(2.0), dict(zip(leaves, others, strict=True))
    moments = {"s": g, "su": g * u, "sv": g * v, "suu": g * u * u, "suv": g * u * v, "svv": g * v * v}
    moments |= {each: by[each] for each in FIELDS[6:10]}
    moments |= {"size_x": (g * u).abs(), "size_y": (s["b"] * g * u + s["c"] * g * v).abs()}
    moments |= {each: by[each] for each in FIELDS[10:]}
    sums = {each: moment.sum((1, 2)) for each, moment in moments.items()}
    return Answer(shown_pictures, left.detach(), ended_by, sums, clear, clamped), gradients


def random_gradients(scene: Scene, depth: bool, where: Tensor) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    size = (scene.height, scene.width)
    shapes = {"colour": (*size, 3), "alpha": size} | ({"depth_sum": size, "depth_square_sum": size} if depth else {})
    drawn = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    return {name: each * (where[..., None] if each.ndim == 3 else where) for name, each in drawn.items()}


@dataclass
class Lists:
    """The pairs of a scene in chunks, as the phases before the blending leave them."""

    ranks: list[NDArray[np.int64]]  # per tile, from near to far
    chunk_begin: NDArray[np.int32]
    tile_begin: NDArray[np.int64]
    slots_of: NDArray[np.uint32]
    owners: NDArray[np.uint32]
    offsets: NDArray[np.uint32]


def list_pairs(scene: Scene, chunk_tiles: int) -> Lists:
    """Return each tile's Gaussians, including some that do not reach it, in chunks of several tiles."""
    s = {name: values.squeeze().numpy() for name, values in scene.exactly().items()}
    columns, rows = scene.tiles
    ranks = []
    for tile in range(columns * rows):
        x, y = (np.arange(TILE) + 0.5 + at * TILE for at in (tile % columns, tile // columns))
        dx, dy = x - s["x"][:, None, None], y[:, None] - s["y"][:, None, None]
        u, v = s["a"][:, None, None] * dx + s["b"][:, None, None] * dy, s["c"][:, None, None] * dy
        power = (s["log2_opacity"][:, None, None] - u * u - v * v).max(axis=(1, 2))
        ranks.append(np.flatnonzero(power >= LOG2_ALPHA_MIN - 0.5))
    chunk_begin = np.array([*range(0, len(ranks), chunk_tiles), len(ranks)], np.int32)
    tile_begin = np.cumsum([0, *map(len, ranks)])
    slots_of, owners, offsets = [], [], []
    for begin, end in pairwise(chunk_begin):
        rank = np.concatenate(ranks[begin:end])
        place = np.argsort(rank, kind="stable")  # by rank, and of each by tile
        slots = np.empty(len(rank), np.uint32)
        slots[place] = np.arange(len(rank))
        slots_of.append(slots)
        owners.append(scene.order[rank[place]].astype(np.uint32))
        offsets.append(np.searchsorted(rank[place], np.arange(len(scene.order))).astype(np.uint32))
    return Lists(ranks, chunk_begin, tile_begin, np.concatenate(slots_of), np.concatenate(owners), np.stack(offsets))


def by_tiles(scene: Scene, kept: NDArray) -> Tensor:
    """Return the state kept per pixel, stored by tile and warp, as an image."""
    columns, rows = scene.tiles
    picture = kept.reshape(rows, columns, 4, 2, 4, 8).transpose(0, 2, 4, 1, 3, 5).reshape(rows * TILE, columns * TILE)
    return torch.from_numpy(picture[: scene.height, : scene.width].copy())


@dataclass
class Blend:
    """How the kernels run."""

    depth: bool = True
    magnitudes: bool = False
    chunk_tiles: int = 1000
    blocks: int = 3


def blend(kernels: ctypes.CDLL, scene: Scene, gradients: dict[str, Tensor], how: Blend) -> tuple[Answer, Lists]:
    """Blend with the kernels; their output memory holds NaN beforehand."""
    lists = list_pairs(scene, how.chunk_tiles)
    floats = DEPTH_SLOT_FLOATS if how.depth else SLOT_FLOATS
    size, pixels = (scene.height, scene.width), scene.tiles[0] * scene.tiles[1] * TILE * TILE
    pictures = {"colour": torch.full((*size, 3), math.nan), "alpha": torch.full(size, math.nan)}
    if how.depth:
        pictures |= {n: torch.full(size, math.nan) for n in ("depth_sum", "depth_square_sum", "median_depth")}
    kept, ends = np.full(pixels, np.nan, np.float32), np.full(pixels, -1, np.int32)
    slots = np.empty((len(lists.owners), floats), np.float32)
    sums = np.zeros((len(scene.records), floats), np.float32)
    incoming = {name: gradient.float().contiguous() for name, gradient in gradients.items()}
    case = _Case(
        *(scene.width, scene.height, len(scene.records), len(lists.chunk_begin) - 1, how.magnitudes, how.blocks),
        DEPTH_ORIGIN,
        (ctypes.c_float * 3)(*BACKGROUND),
        *(each.ctypes.data for each in (scene.records, scene.order, lists.chunk_begin, lists.tile_begin)),
        *(each.ctypes.data for each in (lists.slots_of, lists.owners, lists.offsets, kept, ends, slots, sums)),
        **{name: picture.data_ptr() for name, picture in pictures.items()},
        **{f"d_{name}": gradient.data_ptr() for name, gradient in incoming.items()},
    )
    assert kernels.run_forward(ctypes.byref(case)) == 0, kernels.harness_message()
    assert kernels.run_backward(ctypes.byref(case)) == 0, kernels.harness_message()
    answer = Answer(pictures, by_tiles(scene, kept), by_tiles(scene, ends))
    names = ("s", "su", "sv", "suu", "suv", "svv", *FIELDS[6:10], "size_x", "size_y", *FIELDS[10:])
    by_rank = torch.from_numpy(sums[scene.order])
    answer.sums = {name: by_rank[:, i] for i, name in enumerate(names) if i < floats}
    return answer, lists


def ends_of(scene: Scene, lists: Lists, ended_by: Tensor) -> Tensor:
    """Return how many of its tile's pairs each pixel processed before one of a given rank saturated it."""
    ends = torch.empty(scene.height, scene.width, dtype=torch.int32)
    for y in range(scene.height):
        for x in range(scene.width):
            ends[y, x] = int(np.searchsorted(lists.ranks[y // TILE * scene.tiles[0] + x // TILE], int(ended_by[y, x])))
    return ends


SCENES = {
    "odd size": lambda: random_scene(140, 37, 43, 1, (0.01, 0.9), (-1.0, 1.2)),
    "opaque": lambda: random_scene(60, 41, 21, 2, (0.992, 1.0), (0.8, 1.6)),
    "one tile with everything": lambda: random_scene(560, 16, 16, 3, (0.004, 0.04), (0.0, 1.5)),
    "empty tiles": lambda: random_scene(5, 100, 50, 4, (0.5, 0.9), (-1.0, 0.4)),
}


def compare(ours: Answer, exact: Answer, lists: Lists, scene: Scene) -> None:
    clear = exact.clear
    assert (~clear).sum() <= DOUBTFUL
    limits = {"colour": COLOUR, "alpha": COLOUR, "depth_sum": DEPTH, "median_depth": DEPTH, "depth_square_sum": DEPTH}
    for picture, values in ours.pictures.items():
        error = (values - exact.pictures[picture])[clear].abs().max()
        assert error < limits[picture], f"{picture}: {error:.1e}"
    torch.testing.assert_close(ours.transmittance.double()[clear], exact.transmittance[clear], rtol=1e-4, atol=1e-7)
    assert torch.equal(ours.ended_by[clear], ends_of(scene, lists, exact.ended_by)[clear])


@pytest.mark.parametrize("magnitudes", [False, True], ids=["", "magnitudes"])
@pytest.mark.parametrize("depth", [False, True], ids=["", "depth"])
@pytest.mark.parametrize("name", SCENES)
def test_blending_and_its_gradients_are_the_definitions(kernels, name, depth, magnitudes):
    scene = SCENES[name]()
    exact, gradients = blend_exactly(name, depth)
    ours, lists = blend(kernels, scene, gradients, Blend(depth, magnitudes))
    compare(ours, exact, lists, scene)
    if name == "opaque":
        assert (exact.ended_by < len(scene.records)).float().mean() > 0.5 and exact.clamped > 100
    for moment, values in ours.sums.items():
        if (moment.startswith("size") and not magnitudes) or (moment == "depth" and not depth):
            assert not values.any()
            continue
        error = (values - exact.sums[moment]).norm() / exact.sums[moment].norm()
        assert error < GRADIENT, f"{moment}: {error:.1e}"


@pytest.mark.parametrize("how", [Blend(True, True, 1, 2), Blend(True, True, 2, 1), Blend(True, True, 1000, 7)])
def test_chunks_and_blocks_give_the_same_bits(kernels, how):
    scene = SCENES["odd size"]()
    _, gradients = blend_exactly("odd size", True)
    expected, _ = blend(kernels, scene, gradients, Blend(True, True))
    ours, lists = blend(kernels, scene, gradients, how)
    assert len(lists.chunk_begin) - 1 == -(-9 // how.chunk_tiles)
    assert_same_bits(ours, expected)


def test_gradients_that_are_not_given_are_zero(kernels):
    scene = SCENES["odd size"]()
    _, gradients = blend_exactly("odd size", True)
    for given in ("colour", "alpha", "depth_sum", "depth_square_sum"):
        zeros = {name: each * (1.0 if name == given else 0.0) for name, each in gradients.items()}
        expected, _ = blend(kernels, scene, zeros, Blend(True, True))
        # One of depth must be given: without it, the kernels without depth gradients are used.
        kept = {name: each for name, each in zeros.items() if name in (given, "depth_sum")}
        ours, _ = blend(kernels, scene, kept, Blend(True, True))
        assert_same_bits(ours, expected)
        assert any(values.any() for values in ours.sums.values())


@pytest.mark.parametrize(("order", "seed"), [(REVERSE, 0), (SHUFFLED, 1)])
def test_order_of_threads_does_not_matter(kernels, order, seed):
    scene = SCENES["one tile with everything"]()  # in several batches
    _, gradients = blend_exactly("one tile with everything", False)
    expected, _ = blend(kernels, scene, gradients, Blend(False))
    kernels.harness_order(order, seed)
    ours, _ = blend(kernels, scene, gradients, Blend(False))
    assert_same_bits(ours, expected)


def assert_same_bits(ours: Answer, expected: Answer) -> None:
    assert torch.equal(ours.transmittance, expected.transmittance) and torch.equal(ours.ended_by, expected.ended_by)
    for name in expected.pictures:
        assert torch.equal(ours.pictures[name], expected.pictures[name])
    for name in expected.sums:
        assert torch.equal(ours.sums[name], expected.sums[name])


@pytest.mark.parametrize(
    ("seed", "count", "log10_sigmas"), [(5, 1500, (-1.0, 1.0)), (6, 700, (-1.0, 3.5)), (7, 300, (3.0, 5.0))]
)
def test_no_pixel_in_reach_is_in_a_skipped_sub_block(kernels, seed, count, log10_sigmas):
    scene = random_scene(count, 48, 48, seed, (0.004, 1.0), log10_sigmas)
    counts = _Counts()
    lists = list_pairs(scene, 1000)
    case = _Case(width=scene.width, height=scene.height, count=count, chunks=1, blocks=3)
    for name, values in (("records", scene.records), ("order", scene.order), ("offsets", lists.offsets)):
        setattr(case, name, values.ctypes.data)
    for name in ("chunk_begin", "tile_begin", "slots_of", "owners"):
        setattr(case, name, getattr(lists, name).ctypes.data)
    assert kernels.run_count(ctypes.byref(case), ctypes.byref(counts)) == 0, kernels.harness_message()
    assert counts.met > 10_000
    assert counts.missed == 0
    assert counts.touched < 1.2 * counts.needed  # and few are visited for nothing
