"""Differences of training on a device, one by one: device choice, rows, memory, colours, losses."""

import json
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_scene
import torch
from on_cpu import kernels_on_cpu
from torch import Tensor

from splatpipe.pipeline.app.terminal.summary import for_the_user
from splatpipe.pipeline.engine.errors import EXIT_MACHINE, MachineError, UsageError, card_fault, exit_code
from splatpipe.pipeline.engine.runs.worker import as_splatpipe_error
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.raster import device as devices
from splatpipe.pipeline.raster.cuda import cuda_driver, cuda_library
from splatpipe.pipeline.raster.cuda.cuda import use_kernels
from splatpipe.pipeline.raster.device import Device, choose_device, cpu, take_rows, taken_in_place
from splatpipe.pipeline.train.densify import DensifiedGaussians, along_curve
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.upload import QUEUED, Upload, Uploader, colours_of
from splatpipe.pipeline.train.plan import limits
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.start import InitialGaussians
from splatpipe.pipeline.train.sizing import planning
from splatpipe.pipeline.train.sizing.planning import PlanningInput, pilot
from splatpipe.pipeline.train.state import memory, state
from splatpipe.pipeline.train.state.checkpoint import (
    BrokenCheckpointError,
    HostArrays,
    load_checkpoint,
    save_checkpoint,
)
from splatpipe.pipeline.train.state.history import History
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import Techniques
from splatpipe.stages import initialize, train

ALL = tiny_scene.plain(iterations=20, max_gaussians=250)


def make_small_plan(config: TrainConfig) -> TrainingPlan:
    views = [View(camera, Path(), None) for camera in tiny_scene.cameras(4)]
    return make_plan(config, views, tiny_scene.split_of(views), tiny_scene.GAUSSIANS)


def test_losses_read_in_batches_add_up_as_one_by_one() -> None:
    values = torch.rand(100, generator=torch.Generator().manual_seed(0))
    values[7], values[31] = torch.nan, torch.inf
    found = []
    for bunch in (1, 9, 100):
        read = History()
        for number, value in enumerate(values, start=1):
            read.add_loss(value)
            if number % bunch == 0:
                read.recent_loss()
        found.append(read.state())
    assert found[0] == found[1] == found[2] and found[0]["loss_count"] == 98


def test_rows_are_selected_even_if_old_and_new_do_not_fit_together() -> None:
    class Tight(Tensor):
        def __getitem__(self, rows: object) -> Tensor:
            raise torch.OutOfMemoryError("out of memory")

        def cpu(self) -> Tensor:
            return self.as_subclass(Tensor)

    values = torch.arange(12.0).reshape(4, 3)
    tensors = {"a": values.clone(), "b": values.clone().as_subclass(Tight), "c": values.clone()}
    take_rows(tensors, torch.tensor([3, 1]))
    assert list(tensors) == ["a", "b", "c"]
    for tensor in tensors.values():
        assert type(tensor) is Tensor and torch.equal(tensor, values[[3, 1]])


def test_rows_are_moved_within_their_memory() -> None:
    generator = torch.Generator().manual_seed(2)
    for shape in ((40,), (40, 3), (40, 16, 3)):
        values = torch.randn(shape, generator=generator)
        rows = torch.randint(0, 40, (37,), generator=generator)
        moved = taken_in_place(tensor := values.clone(), rows)
        assert torch.equal(moved, values[rows]) and moved.is_contiguous() and moved.data_ptr() == tensor.data_ptr()


def test_a_checkpoint_fetches_one_array_at_a_time_with_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = TrainState.begin(tiny_scene.true_model(), make_small_plan(ALL), Techniques())
    checkpoint = training.checkpoint("any")
    header = {"format": 1, "plan": "digest", "facts": checkpoint.facts}
    arrays = {"facts": np.frombuffer(json.dumps(header).encode(), np.uint8), **checkpoint.arrays}
    np.savez(tmp_path / "whole.npz", allow_pickle=False, **arrays)
    fetched: list[weakref.ref[np.ndarray]] = []
    usual = HostArrays.__getitem__

    def fetch(arrays: HostArrays, name: str) -> np.ndarray:
        assert not any(reference() is not None for reference in fetched)
        copy = usual(arrays, name).copy()  # as of a device
        fetched.append(weakref.ref(copy))
        return copy

    monkeypatch.setattr(HostArrays, "__getitem__", fetch)
    save_checkpoint(tmp_path / "single.npz", "digest", training.checkpoint("any"))
    assert len(fetched) > 15
    assert (tmp_path / "single.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()
    again = load_checkpoint(tmp_path / "single.npz", "digest").arrays
    assert list(again) == list(checkpoint.arrays)


def test_memory_that_runs_out_while_rows_are_moved_is_not_handled_as_a_shortage() -> None:
    class Tight(Tensor):
        calls, is_cuda = 0, True

        def __getitem__(self, rows: object) -> Tensor:
            if isinstance(rows, Tensor):
                Tight.calls += 1
                if Tight.calls == 3:
                    raise torch.OutOfMemoryError("out of memory")
            return super().__getitem__(rows)

    values, rows = torch.randn(40, 48, generator=torch.Generator().manual_seed(3)), torch.arange(40).flip(0)
    tensor = values.clone().as_subclass(Tight)
    with pytest.raises(MachineError, match="40 Gaussians") as failure:  # which no part of training handles
        taken_in_place(tensor, rows)
    assert not isinstance(failure.value, torch.OutOfMemoryError)
    assert torch.equal(tensor.as_subclass(Tensor)[:, :16], values[rows, :16])  # two of six times
    Tight.calls = 2
    tensor = values.clone().as_subclass(Tight)
    with pytest.raises(torch.OutOfMemoryError):  # before anything was moved
        taken_in_place(tensor, rows)
    assert torch.equal(tensor.as_subclass(Tensor), values)
    Tight.calls = 2
    take_rows(tensors := {"sh": tensor}, rows)  # so the host's memory helps
    assert Tight.calls > 3 and torch.equal(tensors["sh"].as_subclass(Tensor), values[rows])
    Tight.calls = 0
    with pytest.raises(MachineError, match="40 Gaussians"):
        take_rows({"sh": values.clone().as_subclass(Tight)}, rows)


def test_the_cpus_rows_are_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(devices, "taken_in_place")
    values, rows = torch.arange(120.0).reshape(40, 3), torch.arange(40).flip(0)
    take_rows(tensors := {"a": values.clone()}, rows)
    assert torch.equal(tensors["a"], values[rows])


def test_memory_for_growth_counts_the_gaussians_around_a_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """Density control copies their parameters; free memory is what all of them leave between two iterations."""
    model = tiny_scene.true_model(100)
    each, around = limits.device_bytes_per_gaussian(3), limits.device_frozen_passing_bytes(3)
    assert around == 236 and limits.device_frozen_passing_bytes(0) == limits.FRAME_BYTES == 201
    free = 100 * limits.DEVICE_PASSING_BYTES + 40 * around + 50 * each
    monkeypatch.setattr(memory, "free_bytes", lambda device: free)
    assert [memory.within_room(500, model, frozen) for frozen in (40, 41)] == [150, 149]
    asked: list[int] = []
    monkeypatch.setattr(state, "within_room", lambda wanted, gaussians, frozen: asked.append(frozen) or wanted)
    plan = make_small_plan(ALL)
    training = TrainState.begin(tiny_scene.true_model(), plan, Techniques(), tiny_scene.true_model(70))
    training.control_density(plan, plan.schedule.density.first)
    assert asked == [70] and training.whole is not None


FAULTS = [
    "CUDA error: an illegal memory access was encountered\nCUDA kernel errors might be asynchronously reported at ...",
    "CUDA driver error: unspecified launch failure",
]


@pytest.mark.parametrize("text", FAULTS)
@pytest.mark.parametrize("kind", [RuntimeError, getattr(torch, "AcceleratorError", RuntimeError)])
def test_a_fault_of_the_card_says_what_to_do(kind: type[RuntimeError], text: str) -> None:
    """Torch raises it where it waits next; the error of our own calls reads the same."""
    for raised in (as_splatpipe_error("train", kind(text)), for_the_user(kind(text))):
        assert type(raised) is MachineError and exit_code(raised) == EXIT_MACHINE
        assert raised.message in (
            "The graphics card failed: an illegal memory access was encountered.",
            "The graphics card failed: unspecified launch failure.",
        )
        assert "resumes from its last checkpoint" in raised.hint and "--device cpu" in raised.hint


def test_other_errors_are_not_faults_of_the_card() -> None:
    for error in (RuntimeError("The size of tensor a"), ValueError("CUDA error: no"), torch.OutOfMemoryError("CUDA")):
        assert card_fault(error) is None
    for text in ("CUDA out of memory. Tried to allocate", "CUDA error: out of memory"):
        assert as_splatpipe_error("train", RuntimeError(text)).message == "The stage train ran out of memory."


def test_a_fault_of_the_card_does_not_discard_the_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = make_small_plan(ALL)
    saved = TrainState.begin(tiny_scene.true_model(), plan, Techniques()).checkpoint("")

    def failing(said: str) -> TrainState:
        raise RuntimeError(said)

    for text, expected in ((FAULTS[0], RuntimeError), ("another shape", BrokenCheckpointError)):
        monkeypatch.setattr(TrainState, "of", staticmethod(lambda *given, text=text: failing(text)))
        with pytest.raises(expected):
            TrainState.restore(saved, plan, Techniques())


def test_growth_ends_when_the_device_has_no_memory_left(monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_scene.true_model(100)
    each = limits.device_bytes_per_gaussian(3)
    for free, room in ((None, 500), (10**9, 500), (100 * limits.DEVICE_PASSING_BYTES + 50 * each, 150), (0, 100)):
        monkeypatch.setattr(memory, "free_bytes", lambda device, free=free: free)
        assert memory.within_room(500, model) == room
    monkeypatch.setattr(state, "within_room", lambda wanted, gaussians, frozen: len(gaussians) + 3)
    plan = make_small_plan(ALL)
    training = TrainState.begin(tiny_scene.true_model(), plan, Techniques())
    training.density.score_sum += 1.0
    training.density.seen += 1.0
    training.control_density(plan, plan.schedule.density.first)
    assert training.history.growth_ended == plan.schedule.density.first
    assert len(training.gaussians) == tiny_scene.GAUSSIANS + 3


def test_a_memory_limit_applies_to_the_device_that_trains() -> None:
    each, recorder = limits.device_bytes_per_gaussian(3), tiny_scene.Recorder()
    pixels = tiny_scene.WIDTH * tiny_scene.HEIGHT
    limit = limits.FIXED_BYTES + pixels * limits.PIXEL_BYTES + 5000 * each
    plan = make_small_plan(ALL.model_copy(update={"max_memory_bytes": limit, "max_gaussians": 1_000_000}))
    assert planning.within_memory(plan, 150, recorder, on_cuda=True).options.max_gaussians == 5000
    # 236 bytes of parameters and 472 of moments, 12 of statistics; a tenth of a million more fit than on the CPU.
    assert 708 + 12 < each < limits.bytes_per_gaussian(TrainConfig().sh_degree)


def test_a_device_has_all_its_memory_again_after_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    shares: list[float] = []
    monkeypatch.setattr(devices, "kernels_of", lambda device: None)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(total_memory=8000))
    monkeypatch.setattr(torch.cuda, "set_per_process_memory_fraction", lambda share, device: shares.append(share))
    device = Device("cuda", torch.device("cuda", 0))
    for limit in (2000, 9000, 0):
        with pytest.raises(MachineError), device.memory_limit(limit):
            raise MachineError("It fails.")
    assert shares == [0.25, 1.0, 1.0, 1.0]


def test_the_host_is_a_few_iterations_ahead_of_a_device_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []

    class Event:
        def __init__(self, **how: bool) -> None:
            self.name = ""

        def record(self, stream: object) -> None:
            self.name = f"{len([line for line in log if line.startswith('queue')])}"

        def synchronize(self) -> None:
            log.append(f"wait {self.name}")

    uploader = Uploader(torch.device("cpu"))
    monkeypatch.setattr(uploader, "_stream", object())
    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: None)
    for number in range(QUEUED + 3):
        uploader.end(Upload(torch.zeros(2, 2, 3, dtype=torch.uint8), None, None))
        log.append(f"queue {number}")
    begun = [f"queue {number}" for number in range(QUEUED)]
    assert log == begun + [line for n in range(3) for line in (f"wait {n}", f"queue {n + QUEUED}")]


def budgeted(seconds: float, device: Device) -> tuple[TrainingPlan, PlanningInput]:
    config = TrainConfig(time_budget_s=seconds)
    views = [View(camera, Path(), None) for camera in tiny_scene.cameras(4)]
    plan = make_plan(config, views, tiny_scene.split_of(views), 100)
    return plan, PlanningInput(config, InitialGaussians(tiny_scene.true_model(100), 100), views, 1, Machine(), device)


def test_a_budgets_forecast_is_measured_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    free: list[int | None] = [None]
    monkeypatch.setattr(planning, "free_bytes", lambda device: free[0])
    cuda = Device("cuda", torch.device("cuda", 0))
    found = [pilot(*budgeted(60.0, device)).options.max_gaussians for device in (cpu(), cuda)]
    assert found == [9_000, 900_000]
    assert pilot(*budgeted(6000.0, cuda)).options.max_gaussians == TrainConfig().max_gaussians
    free[0] = 2 * 20_000 * limits.device_bytes_per_gaussian(3)
    assert pilot(*budgeted(60.0, cuda)).options.max_gaussians == 20_000


def test_a_trial_that_does_not_fit_on_the_device_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(*given: object) -> object:
        raise torch.OutOfMemoryError("out of memory")

    monkeypatch.setattr(planning, "measure", measure)
    with pytest.raises(MachineError, match=r"too little memory for the trial .* of 9,000 Gaussians") as failure:
        planning.within_time(*budgeted(60.0, cpu()), tiny_scene.Recorder())
    assert "train.max_megapixels" in failure.value.hint


def test_colours_are_the_same_numbers_on_a_device() -> None:
    pixels = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    expected = pixels.astype(np.float32) * np.float32(1.0 / 255.0)
    assert np.array_equal(colours_of(torch.from_numpy(pixels)).numpy(), expected)


def test_rows_lie_along_a_curve_after_density_control() -> None:
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(2000, 3, generator=generator)
    rows = torch.arange(2000)
    growth = DensifiedGaussians(rows, rows >= 1500, means, means + 1.0, means[:, 0])
    sorted_ = along_curve(growth)
    with use_kernels(kernels_on_cpu()):
        assert torch.equal(along_curve(growth).source, sorted_.source)
    assert torch.equal(sorted_.source.sort().values, rows)
    assert torch.equal(sorted_.means, means[sorted_.source]) and torch.equal(sorted_.fresh, sorted_.source >= 1500)

    def step(points: Tensor) -> float:
        return float((points[1:] - points[:-1]).norm(dim=1).mean())

    assert step(sorted_.means) < 0.25 * step(means)


def test_an_unused_card_is_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        cuda_library, "unavailable_reason", lambda: cuda_library.NoCuda("The driver is old.", "Install another.")
    )
    notes: list[str] = []
    monkeypatch.setattr(cuda_driver, "has_card", lambda: False)
    assert choose_device("auto", "", notes.append).name == "cpu" and not notes
    monkeypatch.setattr(cuda_driver, "has_card", lambda: True)
    assert choose_device("cpu", "", notes.append).name == "cpu" and not notes
    assert choose_device("auto", "", notes.append).name == "cpu"
    assert notes == ["computing on the CPU, not on the NVIDIA graphics card: The driver is old. Install another."]
    choose_device("auto", TrainConfig(loss="kornia").unfit_for_cuda(), notes.append)
    assert len(notes) == 2 and "kornia" in notes[1] and notes[1] == notes[1].strip()


def test_a_training_reports_a_card_that_it_does_not_use(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(
        cuda_library, "unavailable_reason", lambda: cuda_library.NoCuda("The driver is old.", "Install another.")
    )
    monkeypatch.setattr(cuda_driver, "has_card", lambda: True)
    tiny_scene.write_dataset(tmp_path / "dataset")
    parts = {"undistort.dataset": tmp_path / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, tmp_path), tmp_path, tiny_scene.Recorder())
    parts |= {"initialize.splat": tmp_path / "init.ply", **tiny_scene.split_part(tmp_path / "dataset", 4)}
    recorder = tiny_scene.Recorder()
    summary = train.run(tiny_scene.plain(iterations=2), Inputs(parts, tmp_path), tmp_path, recorder)
    assert summary["device"] == "cpu"
    assert [note for note in recorder.notes if "The driver is old. Install another." in note] == recorder.notes[:1]


def test_the_device_is_chosen_or_refused_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    kornia = TrainConfig(loss="kornia").unfit_for_cuda()
    assert "kornia" in kornia and not TrainConfig().unfit_for_cuda()
    monkeypatch.setattr(cuda_library, "unavailable_reason", lambda: cuda_library.NoCuda("There is none.", "Buy one."))
    assert choose_device("cpu").name == choose_device("auto").name == "cpu"
    with pytest.raises(UsageError, match='no device "gpu"'):
        choose_device("gpu")
    with pytest.raises(MachineError, match="There is none") as failure:
        choose_device("cuda")
    assert failure.value.hint == "Buy one."
    monkeypatch.setattr(cuda_library, "unavailable_reason", lambda: None)
    monkeypatch.setattr(cuda_library, "cannot_compute", lambda: cuda_library.NoCuda("It is full.", "Wait."))
    assert choose_device("auto").name == "cpu"
    with pytest.raises(MachineError, match="It is full"):
        choose_device("cuda")
    monkeypatch.setattr(cuda_library, "cannot_compute", lambda: None)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setenv(devices.CUBLAS_WORKSPACE[0], "kept")
    torch.backends.cuda.matmul.allow_tf32 = True  # as TORCH_ALLOW_TF32_CUBLAS_OVERRIDE does
    assert choose_device("auto") == choose_device("cuda") == Device("cuda", torch.device("cuda", 0))
    assert not torch.backends.cuda.matmul.allow_tf32
    assert choose_device("auto", kornia).name == choose_device("cpu").name == "cpu"
    with pytest.raises(UsageError, match="kornia"):
        choose_device("cuda", kornia)
