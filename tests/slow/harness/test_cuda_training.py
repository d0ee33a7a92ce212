"""Training on CUDA, verified with the kernels' sources on the CPU: always the same bits, in little memory."""

import json
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch
from building import FORWARD, SHUFFLED, build_on_cpu, load
from on_cpu import ShortOfMemory, kernels_on_cpu, library_on_cpu
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_forecast import most_pairs_of
from splatpipe.pipeline.raster.cuda_frame import shot_of
from splatpipe.pipeline.raster.device import Device, cpu
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.sizing import shortage
from splatpipe.pipeline.train.sizing.measure import MeasuringBudget, TimedScene, measure
from splatpipe.pipeline.train.sizing.planning import PlanningInput
from splatpipe.pipeline.train.state import state
from splatpipe.pipeline.train.state.checkpoint import load_checkpoint, save_checkpoint
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import Techniques, make_techniques
from splatpipe.stages import evaluate, initialize, train

ON_CUDA = Device("cuda", torch.device("cpu"))  # as long as kernels of the harness are used
QUICK = tiny_scene.plain(iterations=30, max_gaussians=400, exposure="affine", antialias=True)
ALL = QUICK.model_copy(update={"iterations": 20, "max_gaussians": 250, "dropout": 0.2, "background": "random"})
EARLY, LATE = 5, 17  # iterations before the first and after the last step of density control


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset` and `init.ply`."""
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "dataset", masked="flight 1/photo_5.png")
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder


def make_inputs(scene: Path) -> Inputs:
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    return Inputs(parts | tiny_scene.split_part(scene / "dataset", 4), scene, machine=Machine("auto", 1))


@contextmanager
def on(device: Device, kernels: CudaKernels | None = None) -> Iterator[None]:
    """Let stages choose a device; CUDA is the harness."""
    with pytest.MonkeyPatch.context() as patch, use_kernels(kernels or kernels_on_cpu() if device is ON_CUDA else None):
        for stage in (loop, evaluate):
            patch.setattr(stage, "choose_device", lambda wanted, unfit="", note=None: device)
        yield


def trained(
    scene: Path, out: Path, config: TrainConfig, device: Device = ON_CUDA, kernels: CudaKernels | None = None
) -> tuple[dict[str, object], tiny_scene.Recorder]:
    """A training's summary and its messages."""
    out.mkdir(exist_ok=True)
    recorder = tiny_scene.Recorder()
    with on(device, kernels):
        summary = train.run(config, make_inputs(scene), out, recorder)
    return dict(summary), recorder


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training with every technique, uninterrupted."""
    out = tmp_path_factory.mktemp("whole")
    _, recorder = trained(scene, out, ALL)
    assert not recorder.warnings and len(read_splat(out / "model.ply")) > 200
    return out


def history(out: Path) -> dict[str, list[dict[str, float]]]:
    found: dict[str, list[dict[str, float]]] = json.loads((out / "history.json").read_text())
    return found


def parts_of(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in ("model.ply", "history.json", "exposures.json")}


def losses(summaries: tiny_scene.Recorder) -> list[float]:
    return [value for name, value, _ in summaries.metrics if name == "loss"]


def test_a_training_is_the_cpus(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "CUDA_REPORT_EVERY", loop.REPORT_EVERY)
    monkeypatch.setattr(state, "along_curve", lambda growth: growth)  # in another order other children are drawn
    summaries, recorders = {}, {}
    for name, device in (("cpu", cpu()), ("cuda", ON_CUDA)):
        summaries[name], recorders[name] = trained(scene, tmp_path / name, QUICK, device)
        assert summaries[name]["device"] == name and summaries[name]["mode"] == "the same bits for one seed"
    ours, theirs = history(tmp_path / "cuda"), history(tmp_path / "cpu")
    # Where a score is at the threshold, the last bit decides; so one or two of a hundred differ.
    for event, expected in zip(ours["density"], theirs["density"], strict=True):
        for count in ("cloned", "split", "pruned", "gaussians"):
            assert abs(event[count] - expected[count]) <= max(2, 0.02 * expected[count]), (event, expected)
    assert sum(event["split"] for event in ours["density"]) > 100
    assert losses(recorders["cuda"]) == pytest.approx(losses(recorders["cpu"]), rel=0.01)
    maps = [json.loads((tmp_path / name / "exposures.json").read_text())["views"] for name in ("cuda", "cpu")]
    for name, expected in maps[1].items():
        np.testing.assert_allclose(maps[0][name], expected, atol=1e-3)


def test_it_has_the_same_bits_in_any_order_of_threads(scene: Path, whole: Path, tmp_path: Path) -> None:
    library = load(build_on_cpu())
    library.harness_order(SHUFFLED, 5)
    try:
        trained(scene, tmp_path, ALL)
    finally:
        library.harness_order(FORWARD, 0)
    assert parts_of(tmp_path) == parts_of(whole)


class Kill(BaseException):
    """Stands in for a kill: nothing of the trainer catches it."""


@contextmanager
def killed_at(when: int) -> Iterator[None]:
    """Die before an iteration, with a checkpoint after each one before."""

    def dying(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        if state.iteration + 1 == when:
            raise Kill
        iterate(state, plan, photo)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        patch.setattr(shortage, "iterate", dying)
        yield


def test_a_checkpoint_moves_between_devices_and_loses_no_bit(scene: Path, whole: Path, tmp_path: Path) -> None:
    with killed_at(LATE):
        trained(scene, tmp_path, ALL)
    path, plan = tmp_path / loop.CHECKPOINT, TrainingPlan.from_json((tmp_path / "plan.json").read_text())
    read = load_checkpoint(path, plan.digest())
    moved = TrainState.restore(read, plan, make_techniques(plan)).checkpoint(read.facts["instruction_set"])
    assert moved.facts == read.facts and moved.arrays.keys() == read.arrays.keys()
    for name, array in read.arrays.items():
        np.testing.assert_array_equal(moved.arrays[name], array, strict=True)
    save_checkpoint(path, plan.digest(), moved)  # as the CPU's trainer leaves it
    _, recorder = trained(scene, tmp_path, ALL)
    assert not recorder.warnings
    assert parts_of(tmp_path) == parts_of(whole)


def test_resuming_on_another_device_is_reported(scene: Path, tmp_path: Path) -> None:
    for begun, other in ((ON_CUDA, cpu()), (cpu(), ON_CUDA)):
        with killed_at(EARLY if begun is ON_CUDA else LATE):
            trained(scene, tmp_path / begun.name, ALL, begun)
        summary, recorder = trained(scene, tmp_path / begun.name, ALL, other)
        assert len(recorder.warnings) == 1 and "not bit-identical" in recorder.warnings[0]
        assert "sm_80" in recorder.warnings[0] and summary["device"] == other.name


ASKED_OF_THE_CPU = {  # numbers on the host: learning rates, and values that arrived from the device long ago
    "cuda_frame.py:step",
    "optim.py:_is_fused",
    "cuda_forecast.py:facts",
}


def test_an_iteration_reads_nothing_from_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[str] = []

    def note(what: str) -> None:
        frame = sys._getframe(2)
        while "splatpipe" not in frame.f_code.co_filename:
            frame = frame.f_back
        place = f"{Path(frame.f_code.co_filename).name}:{frame.f_code.co_name}"
        if place not in ASKED_OF_THE_CPU:
            waits.append(f"{what} in {place}")

    class Watch(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, arguments=(), named=None):
            if function.__name__.startswith(("_local_scalar_dense", "nonzero", "masked_select", "equal", "unique")):
                note(function.__name__)
            masks = arguments[1] if function.__name__.startswith("index") else ()
            if any(isinstance(mask, Tensor) and mask.dtype == torch.bool for mask in masks):
                note(function.__name__)  # counts how many are true
            return function(*arguments, **(named or {}))

    for name in ("tolist", "numpy", "cpu"):
        usual = getattr(Tensor, name)

        def watched(self: Tensor, *rest: object, usual=usual, name=name, **named: object) -> object:
            note(name)
            return usual(self, *rest, **named)

        monkeypatch.setattr(Tensor, name, watched)
    views = tiny_scene.cameras(4)
    plan = make_small_plan(ALL)
    photo = TrainingPhoto(views[0], torch.full((tiny_scene.HEIGHT, tiny_scene.WIDTH, 3), 0.5), None)
    with use_kernels(kernels_on_cpu()):
        training = TrainState.begin(tiny_scene.true_model(), plan, make_techniques(plan))
        with Watch():
            for _ in range(2):  # density control and the history come later
                iterate(training, plan, photo)
        assert not waits
        assert training.iteration == 2 and len(training.history._unread) == 2
        with Watch():
            training.history.recent_loss()
    assert waits


def make_small_plan(config: TrainConfig) -> TrainingPlan:
    views = [View(camera, Path(), None) for camera in tiny_scene.cameras(4)]
    return make_plan(config, views, tiny_scene.split_of(views), tiny_scene.GAUSSIANS)


def test_short_memory_makes_chunks_then_the_model_smaller_and_then_is_reported(
    scene: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shortage, "MIN_GAUSSIANS", 120)
    most = read_splat(whole / "model.ply")
    shot = shot_of(tiny_scene.cameras()[0], RenderOptions(3, depth=False), 16)

    # Smaller chunks: the same number of Gaussians, the same bits.
    kernels = ShortOfMemory(library_on_cpu(), torch.device("cpu"))
    kernels.most_bytes = kernels.back_bytes(shot, len(most), 2 * len(most))
    _, recorder = trained(scene, tmp_path / "chunks", ALL, kernels=kernels)
    assert recorder.warnings and all("smaller parts" in warning for warning in recorder.warnings)
    assert parts_of(tmp_path / "chunks") == parts_of(whole)
    kernels = ShortOfMemory(library_on_cpu(), torch.device("cpu"))
    kernels.most_frame_bytes = kernels.frame_bytes(shot, len(most), 2 * len(most))
    _, recorder = trained(scene, tmp_path / "frames", ALL.model_copy(update={"iterations": 2}), kernels=kernels)
    assert 1 <= len(recorder.warnings) <= 2  # once an iteration, however often something was halved
    assert all("smaller parts" in warning for warning in recorder.warnings)

    # Then fewer Gaussians, and no further growth.
    kernels.most_bytes = kernels.back_bytes(shot, 200, 200)
    fewer, recorder = trained(scene, tmp_path / "fewer", ALL, kernels=kernels)
    assert any("most opaque" in warning for warning in recorder.warnings)
    assert 120 <= fewer["gaussians"] < len(most) and fewer["iterations"] == ALL.iterations
    assert kernels.back_bytes(shot, fewer["gaussians"], fewer["gaussians"]) <= kernels.most_bytes
    recorded = history(tmp_path / "fewer")
    assert recorded["growth_ended"] > 0 and sum(event["pruned"] for event in recorded["density"]) > 0

    # Then the end.
    kernels.most_bytes = 1000
    with pytest.raises(MachineError, match="does not hold") as failure:
        trained(scene, tmp_path / "end", ALL, kernels=kernels)
    assert "max_megapixels" in failure.value.hint


def test_a_budgets_trial_also_uses_smaller_chunks_if_memory_is_short(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, shot = tiny_scene.true_model(), shot_of(tiny_scene.cameras()[0], RenderOptions(3, depth=False), 16)
    kernels = ShortOfMemory(library_on_cpu(), torch.device("cpu"))
    kernels.most_frame_bytes = kernels.frame_bytes(shot, len(begun), 2 * len(begun))

    def tried(plan: TrainingPlan, given: PlanningInput, report: tiny_scene.Recorder) -> TrainingPlan:
        subject = TimedScene(begun, given.trained_on, given.device)
        pilot = make_small_plan(ALL.model_copy(update={"max_gaussians": len(begun)}))
        measure(pilot, subject, MeasuringBudget(0.0, 1e-3), report)
        return plan

    monkeypatch.setattr(loop, "plan_within_budgets", tried)
    _, recorder = trained(scene, tmp_path, ALL.model_copy(update={"iterations": 1}), kernels=kernels)
    assert recorder.warnings and all("smaller parts" in warning for warning in recorder.warnings)


def test_memory_that_ends_while_the_model_changes_ends_the_training_at_the_checkpoint_before(
    scene: Path, whole: Path, tmp_path: Path
) -> None:
    kernels = ShortOfMemory(library_on_cpu(), torch.device("cpu"))
    begun: list[int] = []

    def half(adam: state.Adam, rows: Tensor) -> None:
        begun.append(len(rows))
        adam.mean["means"] = adam.mean["means"][rows]
        raise torch.OutOfMemoryError("out of memory")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        patch.setattr(state.Adam, "select", half)
        with pytest.raises(MachineError, match="does not hold"):
            trained(scene, tmp_path, ALL, kernels=kernels)
        assert len(begun) == 1  # and not again
        plan = TrainingPlan.from_json((tmp_path / "plan.json").read_text())
        left = load_checkpoint(tmp_path / loop.CHECKPOINT, plan.digest())
        assert left.facts["iteration"] == plan.schedule.density.first - 1
        patch.setattr(shortage, "MIN_GAUSSIANS", 10)
        kernels.most_bytes = 1000
        with pytest.raises(MachineError, match="does not hold even"):
            trained(scene, tmp_path, ALL, kernels=kernels)
        assert len(begun) == 2
        assert load_checkpoint(tmp_path / loop.CHECKPOINT, plan.digest()).facts == left.facts
    trained(scene, tmp_path, ALL)
    assert parts_of(tmp_path) == parts_of(whole)


def test_a_memory_limit_applies_to_the_training_only(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels, seen = kernels_on_cpu(), []
    kernels.forecast.most_pairs = most_pairs_of(24 << 30)

    def watched(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        seen.append(kernels.forecast.most_pairs)
        if len(seen) == 3:
            raise MachineError("It fails.")
        iterate(state, plan, photo)

    monkeypatch.setattr(shortage, "iterate", watched)
    limited = ALL.model_copy(update={"iterations": 2, "max_memory_bytes": 8 << 30})
    trained(scene, tmp_path / "whole", limited, kernels=kernels)
    assert kernels.forecast.most_pairs == most_pairs_of(24 << 30)
    with pytest.raises(MachineError, match="It fails"):
        trained(scene, tmp_path / "failed", limited, kernels=kernels)
    assert kernels.forecast.most_pairs == most_pairs_of(24 << 30)
    assert seen == [most_pairs_of(8 << 30)] * 3


def test_held_out_photos_have_the_same_figures(scene: Path, whole: Path, tmp_path: Path) -> None:
    parts = dict(make_inputs(scene).parts)
    parts |= {"clean.model": whole / "model.ply", "train.rendering": whole / "rendering.json"}
    parts |= {"train.sky": whole / "sky.npz"}
    found = []
    for device in (cpu(), ON_CUDA):
        out = tmp_path / device.name
        out.mkdir()
        with on(device):
            summary = evaluate.run(
                EvaluateConfig(), Inputs(parts, scene, machine=Machine("auto", 1)), out, tiny_scene.Recorder()
            )
        assert summary["device"] == device.name
        found.append(json.loads((out / "metrics.json").read_text()))
    for name in ("psnr", "psnr_cc", "ssim"):
        assert found[1]["mean"][name] == pytest.approx(found[0]["mean"][name], rel=1e-3)
    theirs, ours = (one["floaters"] for one in found)
    assert ours["veil"]["mean"] == pytest.approx(theirs["veil"]["mean"], abs=1e-4)
    assert ours["free_space_rendered"] == pytest.approx(theirs["free_space_rendered"], abs=1e-4)


def test_a_checkpoint_too_large_for_the_device_is_not_called_broken(
    scene: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*_: object) -> None:
        raise torch.OutOfMemoryError("out of memory")

    plan = make_small_plan(ALL)
    begun = TrainState.begin(tiny_scene.true_model(), plan, Techniques())
    monkeypatch.setattr(state.Adam, "load_state_dict", no_room)
    with pytest.raises(torch.OutOfMemoryError):  # "broken" would restart training from the beginning
        TrainState.restore(begun.checkpoint("any"), plan, Techniques())


def test_density_control_starts_with_the_iterations_memory_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[object] = []
    select = state.Adam.select

    def watched(adam: state.Adam, rows: Tensor) -> None:
        left.append(before())
        select(adam, rows)

    plan = make_small_plan(ALL)
    photo = TrainingPhoto(tiny_scene.cameras(4)[0], torch.full((tiny_scene.HEIGHT, tiny_scene.WIDTH, 3), 0.5), None)
    with use_kernels(kernels_on_cpu()):
        training = TrainState.begin(tiny_scene.true_model(), plan, make_techniques(plan))
        training.iteration = plan.schedule.density.first - 1
        before = weakref.ref(training.gaussians)
        monkeypatch.setattr(state.Adam, "select", watched)
        shortage.iterate_within_memory(training, plan, photo, tiny_scene.Recorder())
    assert left == [None] and len(training.history.density) == 1
