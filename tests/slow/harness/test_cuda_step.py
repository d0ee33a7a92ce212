"""The CUDA kernels' projection and optimiser, run on this CPU: identical to the CPU's own kernels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from agreement import gradient_complaints
from building import FORWARD, build_on_cpu
from exact import case_of, exact_outcome
from frames import ORDERS, PARAMETERS, DeviceFrame, Memory, RenderCase, controls, pointer, rows_of, run
from random_scene import random_camera, random_scene

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.cuda.cuda_api import SplatAdam, SplatStep
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary

STEP = 2e-6
"""Relative, of values and moments after a step from the same gradients: the same operations, but for fused ones."""
BETAS, EPSILON, STEPS_BEFORE = (0.9, 0.999), 1e-15, 6
RATES = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "sh": 2.5e-3}
SH_REST = 2.5e-3 / 20
MULTIPROCESSORS = 3  # the harness's own number
TURNS = 2200  # rows: with one multiprocessor, blocks have several turns
LIMITS = (-2.5, -0.5)  # least and largest log-scale: random ones lie on both sides


@pytest.fixture(scope="module")
def library() -> CudaLibrary:
    return CudaLibrary(build_on_cpu())


@pytest.fixture(autouse=True)
def forward_again(library: CudaLibrary) -> Iterator[None]:
    yield
    controls(library).harness_order(FORWARD, 0)
    controls(library).harness_multiprocessors(MULTIPROCESSORS)


def small_case(seed: int = 3, count: int = 300, sh_degree: int = 3, **settings: object) -> RenderCase:
    """More than a block of Gaussians, not a whole number of blocks, some of them not visible, before few pixels."""
    return case_of(random_scene(seed, count, sh_degree), random_camera(seed, 37, 30), **settings)


def rates_of(coefficients: int) -> list[torch.Tensor]:
    """Return learning rates in the form of the CPU's Adam, one for each value of a row."""
    sh = torch.full((coefficients * 3,), SH_REST)
    sh[:3] = RATES["sh"]
    widths = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1}
    return [torch.full((width,), RATES[name]) for name, width in widths.items()] + [sh]


@dataclass(frozen=True)
class StepSettings:
    """Settings of a step, and its initial moments."""

    sparse: bool = True
    gain: np.ndarray | None = None
    unaligned: bool = False
    rows: int | None = None  # number of rendered rows that the step updates; None for all

    def moments(self, case: RenderCase) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        rng = np.random.default_rng(8)
        means = {name: (1e-2 * rng.normal(size=rows.shape)).astype(np.float32) for name, rows in case.rows.items()}
        squares = {name: (1e-4 * rng.random(rows.shape)).astype(np.float32) for name, rows in case.rows.items()}
        return means, squares


@dataclass(frozen=True)
class StepResult:
    """Return values and moments by name after a step, the number of skipped rows, and dL/d(centre on screen)."""

    arrays: dict[str, np.ndarray]
    skipped: int
    means2d: np.ndarray


def put(memory: Memory, name: str, values: np.ndarray, unaligned: bool) -> np.ndarray:
    """A copy on the device; if unaligned, one float past an aligned address."""
    room = memory.empty(name, (values.size + 1,))
    copy = (room[1:] if unaligned else room[:-1]).reshape(values.shape)
    copy[...] = values
    return copy


def fused_step(library: CudaLibrary, case: RenderCase, how: StepSettings) -> StepResult:
    """A frame's step on the device."""
    frame = DeviceFrame(library, case)
    frame.forward()
    frame.blend_backward()
    means, squares = how.moments(case)
    values = {name: put(frame.at, name, case.rows[name], how.unaligned) for name in PARAMETERS}
    means = {name: put(frame.at, f"mean {name}", means[name], how.unaligned) for name in PARAMETERS}
    squares = {name: put(frame.at, f"square {name}", squares[name], how.unaligned) for name in PARAMETERS}
    skipped, means2d = np.full(1, 5, np.int64), frame.at.empty("means2d", (case.count, 2))
    step = SplatStep(rows_of(values), rows_of(means), rows_of(squares), rate_sh_rest=SH_REST)
    step.rows = case.count if how.rows is None else how.rows
    step.rates[:] = list(RATES.values())
    step.beta1, step.beta2, step.epsilon, step.step = *BETAS, EPSILON, STEPS_BEFORE + 1
    step.sparse, step.log_scale_min, step.log_scale_max = int(how.sparse), *LIMITS
    step.logit_gain, step.skipped = pointer(how.gain), pointer(skipped)
    if how.gain is not None:  # the trained rows are not the rendered ones
        rendered = frame.at.put("logits", case.rows["opacity_logits"])
        step.logits = pointer(rendered)
        values["opacity_logits"] -= 1.0
    library.call("splat_step", frame.shot, frame.frame, step, pointer(means2d), None)
    assert not frame.at.overrun()
    groups = {"value": values, "mean": means, "square": squares}
    arrays = {f"{kind} {name}": array for kind, group in groups.items() for name, array in group.items()}
    return StepResult(arrays, int(skipped[0]) - 5, means2d)


def separate_step(library: CudaLibrary, case: RenderCase, how: StepSettings) -> StepResult:
    """Take the same step with the device's gradients and the CPU's Adam."""
    made = run(library, case)
    gradients = {name: made.gradients[name].copy() for name in PARAMETERS}
    rows = {name: case.rows[name].copy() for name in PARAMETERS}
    if how.gain is not None:
        gradients["opacity_logits"] *= how.gain
        rows["opacity_logits"] -= 1.0
    groups = [rows, gradients, *how.moments(case)]
    values, back, means, squares = ([torch.from_numpy(group[name]) for name in PARAMETERS] for group in groups)
    visible = torch.from_numpy(made.pictures["visible"].copy()) if how.sparse else None
    rates = rates_of(case.rows["sh"].shape[1])
    skipped = _native.adam_step(values, back, means, squares, rates, visible, (*BETAS, EPSILON, STEPS_BEFORE + 1))
    values[1].clamp_(*LIMITS)
    named = {"value": values, "mean": means, "square": squares}
    arrays = {
        f"{kind} {name}": tensor.numpy()
        for kind, group in named.items()
        for name, tensor in zip(PARAMETERS, group, strict=True)
    }
    return StepResult(arrays, skipped, made.gradients["means2d"])


def assert_same(ours: StepResult, expected: StepResult) -> None:
    assert ours.skipped == expected.skipped
    assert ours.means2d.tobytes() == expected.means2d.tobytes()
    for name, array in expected.arrays.items():
        np.testing.assert_allclose(ours.arrays[name], array, rtol=STEP, atol=1e-30, err_msg=name)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("sh_degree", range(4))
def test_gradients_agree_with_the_cpu(library: CudaLibrary, sh_degree: int, antialias: bool) -> None:
    """With fewer SH bands active than stored, and with depths and magnitudes contributing."""
    case = small_case(sh_degree, 60, sh_degree=3, depths=antialias, magnitudes=sh_degree % 2 == 1)
    case = case.changed(sh_degree=sh_degree, antialias=antialias)
    ours, expected = run(library, case), exact_outcome(case, "native")
    assert (ours.pictures["visible"] == expected.pictures["visible"]).all()
    assert gradient_complaints(ours, expected) == []


@pytest.mark.parametrize("antialias", [False, True])
def test_tiles_are_those_of_the_cpu_for_splats_of_all_sizes(library: CudaLibrary, antialias: bool) -> None:
    count, width, height = 90, 70, 1100
    scene, camera = random_scene(7, count, 0), random_camera(7, width, height)
    scene.log_scales[30:60] += 1.5  # over many rows of tiles: their pairs are counted by whole warps
    scene.log_scales[60:] += 3.5  # over more than a warp has threads
    scene.quats[30:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    scene.log_scales[30:, 2] = -5.0  # discs that face the camera: they do not reach its plane
    case = case_of(scene, camera, sh_degree=0, antialias=antialias, depths=False).changed(upstream={})
    made = run(library, case)
    frame = _native.Frame()
    rows = tuple(torch.from_numpy(case.rows[name]) for name in PARAMETERS)
    pose = np.concatenate([case.pose, [[0.0, 0.0, 0.0, 1.0]]])
    pictures = (torch.empty(height, width, 3), torch.empty(height, width), None)
    out = (*pictures, torch.empty(count), torch.empty(count, dtype=torch.uint8))
    frame.forward(rows, (pose, case.size, case.intrinsics), (0, antialias, case.near, 0.0, case.background), out)
    assert made.facts[0] == frame.pairs
    assert made.facts[1] == int(out[4].sum())
    assert made.facts[0] > 20 * made.facts[1]


def test_gaussians_that_are_not_finite_are_neither_visible_nor_moved(library: CudaLibrary) -> None:
    case = small_case()
    for row, name in enumerate(PARAMETERS):
        case.rows[name].reshape(case.count, -1)[row, -1] = (np.nan, np.inf, -np.inf)[row % 3]
    made = run(library, case)
    assert not made.pictures["visible"][:5].any()
    assert made.pictures["visible"].any()
    for name, gradient in made.gradients.items():
        assert not gradient[:5].any(), name
        assert np.isfinite(gradient).all(), name


@pytest.mark.parametrize("sparse", [True, False])
@pytest.mark.parametrize("sh_degree", range(4))
def test_fused_step_is_that_of_the_gradients(library: CudaLibrary, sh_degree: int, sparse: bool) -> None:
    case = small_case(sh_degree + 4, sh_degree=sh_degree).changed(
        sh_degree=sh_degree, depths=sparse, antialias=not sparse, magnitudes=sh_degree == 1
    )
    how = StepSettings(sparse)
    expected, ours = separate_step(library, case, how), fused_step(library, case, how)
    assert_same(ours, expected)
    means, visible = how.moments(case)[0], run(library, case.changed(upstream={})).pictures["visible"] == 1
    assert 30 < visible.sum() < case.count
    moved = (ours.arrays["mean sh"] != means["sh"]).any(axis=(1, 2))
    assert (moved == (visible if sparse else True)).all()
    low, high = LIMITS
    log_scales = ours.arrays["value log_scales"]  # every row is clamped, moved or not
    assert log_scales.min() == np.float32(low)
    assert log_scales.max() == np.float32(high)


def test_fused_step_with_inactive_bands(library: CudaLibrary) -> None:
    case = small_case(9).changed(sh_degree=1)
    assert_same(fused_step(library, case, StepSettings()), separate_step(library, case, StepSettings()))


def test_fused_step_of_unaligned_rows(library: CudaLibrary) -> None:
    case = small_case(10)
    aligned, unaligned = (fused_step(library, case, StepSettings(unaligned=shifted)) for shifted in (False, True))
    for name, array in aligned.arrays.items():
        assert array.tobytes() == unaligned.arrays[name].tobytes(), name


def test_fused_step_with_logits_other_than_the_trained(library: CudaLibrary) -> None:
    case = small_case(11)
    gain = np.random.default_rng(2).random(case.count).astype(np.float32)
    gain[::3] = 0.0
    how = StepSettings(gain=gain)
    assert_same(fused_step(library, case, how), separate_step(library, case, how))


@pytest.mark.parametrize("sparse", [True, False])
def test_rows_with_gradients_that_are_not_finite_are_left_out_and_counted(library: CudaLibrary, sparse: bool) -> None:
    case = small_case(12)
    case.upstream["colour"][15, 18] = np.inf
    how = StepSettings(sparse)
    ours = fused_step(library, case, how)
    assert 5 < ours.skipped < case.count / 2
    assert_same(ours, separate_step(library, case, how))


@pytest.mark.parametrize("rows", [0, 1, 130, 256, 299])
def test_step_of_the_first_rows_leaves_the_others_alone(library: CudaLibrary, rows: int) -> None:
    """Those of a block's training are the first; the others are rendered around it and have no moments."""
    case = small_case(14)
    how = StepSettings(rows=rows)
    ours, whole = fused_step(library, case, how), fused_step(library, case, StepSettings())
    before = dict(zip(("mean", "square"), how.moments(case), strict=True)) | {"value": case.rows}
    for name, array in ours.arrays.items():
        kind, tensor = name.split()
        assert array[:rows].tobytes() == whole.arrays[name][:rows].tobytes(), name
        assert array[rows:].tobytes() == before[kind][tensor][rows:].tobytes(), name
    assert ours.means2d[:rows].tobytes() == whole.means2d[:rows].tobytes()
    assert np.isnan(ours.means2d[rows:]).all()  # not written


@pytest.mark.parametrize("rows", [-1, 301])
def test_step_refuses_rows_that_were_not_rendered(library: CudaLibrary, rows: int) -> None:
    with pytest.raises(ValueError, match="splat_step"):
        fused_step(library, small_case(), StepSettings(rows=rows))


def test_step_gives_the_same_bits_in_every_order_of_threads(library: CudaLibrary) -> None:
    case = case_of(random_scene(13, TURNS), random_camera(13, 20, 16), depths=False)
    expected = separate_step(library, case, StepSettings())
    controls(library).harness_multiprocessors(1)
    made = []
    for order in ORDERS:
        controls(library).harness_order(*order)
        made.append(fused_step(library, case, StepSettings()))
    assert_same(made[0], expected)
    for other in made[1:]:
        for name, array in made[0].arrays.items():
            assert array.tobytes() == other.arrays[name].tobytes(), name


@dataclass(frozen=True)
class Tensors:
    """Tensors of the same rows for ``splat_adam``, with gradients, moments and rates."""

    values: list[np.ndarray]
    gradients: list[np.ndarray]
    means: list[np.ndarray]
    squares: list[np.ndarray]
    rates: list[np.ndarray]
    visible: np.ndarray | None = None

    @staticmethod
    def random(rows: int, widths: tuple[int, ...]) -> Tensors:
        rng = np.random.default_rng(rows)

        def all_of(scale: float, rows: int = rows) -> list[np.ndarray]:
            return [(scale * rng.normal(size=(rows, width))).astype(np.float32) for width in widths]

        squares = [square * square for square in all_of(1e-2)]
        rates = [rng.random(width).astype(np.float32) for width in widths]
        return Tensors(all_of(1.0), all_of(1e-2), all_of(1e-2), squares, rates)

    def on_cpu(self) -> tuple[list[np.ndarray], int]:
        """Return values and moments after the CPU's step, and the skipped rows."""
        copies = [[torch.from_numpy(array.copy()) for array in group] for group in self._changed()]
        fixed = [[torch.from_numpy(array) for array in group] for group in (self.gradients, self.rates)]
        visible = None if self.visible is None else torch.from_numpy(self.visible)
        options = (*BETAS, EPSILON, 3)
        skipped = _native.adam_step(copies[0], fixed[0], copies[1], copies[2], fixed[1], visible, options)
        return [tensor.numpy() for group in copies for tensor in group], skipped

    def on_device(self, library: CudaLibrary, unaligned: bool = False) -> tuple[list[np.ndarray], int]:
        """Take the same step with ``splat_adam``."""
        memory, skipped = Memory(), np.zeros(1, np.int64)
        copies = [[put(memory, "changed", array, unaligned) for array in group] for group in self._changed()]
        adam = self.arguments(copies, skipped)
        library.call("splat_adam", adam, None)
        assert not memory.overrun()
        return [array for group in copies for array in group], int(skipped[0])

    def arguments(self, changed: list[list[np.ndarray]], skipped: np.ndarray) -> SplatAdam:
        adam = SplatAdam(tensors=len(self.values), rows=len(self.values[0]), step=3, skipped=pointer(skipped))
        adam.beta1, adam.beta2, adam.epsilon, adam.visible = *BETAS, EPSILON, pointer(self.visible)
        for t, value in enumerate(self.values):
            adam.widths[t] = value.shape[1]
            adam.values[t], adam.means[t], adam.squares[t] = (pointer(group[t]) for group in changed)
            adam.gradients[t], adam.rates[t] = pointer(self.gradients[t]), pointer(self.rates[t])
        return adam

    def _changed(self) -> list[list[np.ndarray]]:
        return [self.values, self.means, self.squares]


@pytest.mark.parametrize("unaligned", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_adam_is_the_cpus(library: CudaLibrary, masked: bool, unaligned: bool) -> None:
    tensors = Tensors.random(601, (3, 1, 64, 13))
    for row, tensor in ((0, 0), (255, 2), (256, 3), (600, 1)):  # first and last rows of both blocks
        tensors.gradients[tensor][row, -1] = np.nan if row % 2 else np.inf
    if masked:
        visible = (np.random.default_rng(1).random(601) < 0.5).astype(np.uint8)
        visible[[0, 255]], visible[[256, 600]] = 0, 1
        tensors = replace(tensors, visible=visible)
    (ours, skipped), (expected, left_out) = tensors.on_device(library, unaligned), tensors.on_cpu()
    assert skipped == left_out == (2 if masked else 4)
    for one, other in zip(ours, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=STEP, atol=1e-30)


def test_adam_gives_the_same_bits_in_every_order_of_threads(library: CudaLibrary) -> None:
    tensors = Tensors.random(TURNS + 100, (4, 1))
    tensors.gradients[0][::7, 2] = np.nan  # found by another thread than the row's
    controls(library).harness_multiprocessors(1)
    made = []
    for order in ORDERS:
        controls(library).harness_order(*order)
        made.append(tensors.on_device(library))
    expected, left_out = tensors.on_cpu()
    for arrays, skipped in made:
        assert skipped == left_out
        for one, other, first in zip(arrays, expected, made[0][0], strict=True):
            assert one.tobytes() == first.tobytes()
            np.testing.assert_allclose(one, other, rtol=STEP, atol=1e-30)


@pytest.mark.parametrize("wrong", [{"step": 0}, {"beta2": 1.0}, {"epsilon": 0.0}, {"tensors": 9}, {"skipped": None}])
def test_adam_refuses_invalid_arguments(library: CudaLibrary, wrong: dict[str, object]) -> None:
    tensors = Tensors.random(4, (3,))
    adam = tensors.arguments([tensors.values, tensors.means, tensors.squares], np.zeros(1, np.int64))
    for name, value in wrong.items():
        setattr(adam, name, value)
    with pytest.raises(ValueError, match="splat_adam"):
        library.call("splat_adam", adam, None)
