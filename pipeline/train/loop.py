"""The train stage: from sparse points to a splat, one photo per iteration."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.heap import keep_freed_heap
from splatpipe.pipeline.engine.runs.peak_memory import peak_memory_bytes
from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.plan_area import read_model_area
from splatpipe.pipeline.photos.pixels.dataset import View, load_split, load_views
from splatpipe.pipeline.raster.device import Device, choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.ply import MIP_COMMENT, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.panorama import write_panorama
from splatpipe.pipeline.train.appearance.brightness import decided_exposure
from splatpipe.pipeline.train.appearance.exposure import Exposure, exposures_json
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.flatness import ends_at
from splatpipe.pipeline.train.interrupts import deferred_interrupts
from splatpipe.pipeline.train.iteration import curve_facts
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import PhotoStream, TrainingPhoto
from splatpipe.pipeline.train.plan.lengths import WINDOW_PIXELS
from splatpipe.pipeline.train.plan.plan import TrainingPlan, load_or_write_plan, make_plan
from splatpipe.pipeline.train.plan.start import read_start
from splatpipe.pipeline.train.plan.training_order import PhotoOrder, TrainingOrder
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.sizing.planning import PlanningInput, plan_within_budgets
from splatpipe.pipeline.train.sizing.shortage import iterate_within_memory
from splatpipe.pipeline.train.state.checkpoint import BrokenCheckpointError, load_checkpoint, save_checkpoint
from splatpipe.pipeline.train.state.history import History
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import Techniques, begin_sky, make_techniques

CHECKPOINT = "checkpoint.npz"
CHECKPOINT_SECONDS = 20.0  # minimum time between checkpoints: what a kill may cost
CHECKPOINT_SHARE = 0.02  # maximum share of training time spent on checkpoints
REPORT_EVERY = 10  # iterations between progress reports on a CPU
# iterations between progress reports on CUDA, where reading the loss synchronizes with the device
CUDA_REPORT_EVERY = 50


@dataclass(frozen=True)
class TrainingSetup:
    """Everything that a training run needs.

    Attributes:
        plan: The training plan.
        device: The compute device.
        views: Views to train on.
        order_of: Makes the order of training from the training size of each iteration.
        techniques: Makes the plan's techniques, untrained.
        start: Makes the initial Gaussians.
        frozen: Makes the Gaussians that are rendered too but not trained; None for none.
    """

    plan: TrainingPlan
    device: Device
    views: Sequence[View]
    order_of: Callable[[Sequence[TrainingSize]], TrainingOrder]
    techniques: Callable[[], Techniques]
    start: Callable[[], Gaussians]
    frozen: Callable[[], Gaussians | None] = lambda: None

    def placed_frozen(self) -> Gaussians | None:
        """The frozen Gaussians on the device."""
        frozen = self.frozen()
        return None if frozen is None else frozen.to(self.device.tensors)


Fit = Callable[[TrainingPlan, PlanningInput, Reporter], TrainingPlan]
"""Adapts a plan to its scene, before the first iteration."""


def run(config: TrainConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the model, history, plan and auxiliary models; resume from the checkpoint of a killed run if there is one.

    Raises:
        SplatpipeError: if there is nothing to train on.
        MachineError: if the requested device is not available.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after a checkpoint.
    """
    _, summary = train_whole(config, inputs, out, report, plan_within_budgets)
    return summary


def train_whole(
    config: TrainConfig, inputs: Inputs, out: Path, report: Reporter, fit: Fit
) -> tuple[TrainState, Summary]:
    """Train the whole scene as ``run`` does, with another plan.

    Args:
        config: The training options.
        inputs: The stage's inputs.
        out: Output folder.
        report: Receives progress and messages.
        fit: Makes the plan from one without budgets.

    Returns:
        The final state and the stage's summary.

    Raises:
        SplatpipeError, MachineError, KeyboardInterrupt: as ``run``.
    """
    device = choose_device(inputs.machine.device, config.unfit_for_cuda(), report.note)
    dataset = inputs["undistort.dataset"]
    views = load_views(dataset)
    area = read_model_area(inputs.parts.get("georef.boundary"))
    start = read_start(inputs["initialize.splat"])
    split = load_split(inputs["split.views"])
    kept = set(split.train)
    trained_on = [view for view in views if view.camera.name in kept]
    free = make_plan(config, views, split, len(start.gaussians), WINDOW_PIXELS[device.name])
    scene = PlanningInput(config, start, trained_on, len(free.test_views), inputs.machine, device)

    def make() -> TrainingPlan:
        decided = decided_exposure(config, trained_on, dataset, inputs.machine.threads, report)
        return fit(free.of(decided), replace(scene, config=decided, sky=sky), report)

    limit = device.memory_limit(config.max_memory_bytes)
    with same_bits(inputs.machine.threads), device.deterministic(), limit:
        sky = begin_sky(config, trained_on, dataset, inputs.machine.threads, report)
        plan = load_or_write_plan(out / "plan.json", make)
        write_durably(out / "rendering.json", plan.rendering().to_json())
        if budgeted(plan) or plan.options.iterations == "auto":
            report.note(plan.described())

        def order_of(sizes: Sequence[TrainingSize]) -> TrainingOrder:
            cameras = [view.camera for view in trained_on]
            return PhotoOrder(cameras, sizes, plan.options.seed, plan.megapixels)

        setup = TrainingSetup(
            plan,
            device,
            trained_on,
            order_of,
            techniques=lambda: make_techniques(plan, sky, trained_on, dataset, device.tensors, area),
            start=lambda: start.within(plan.options.max_gaussians),
        )
        state = run_training(setup, out, report)
        gaussians = state.finished()
    write_splat(out / "model.ply", gaussians, [MIP_COMMENT] if plan.options.antialias else [])
    write_file(out / "history.json", state.whole_history().to_json())
    write_auxiliary_models(out, state.techniques)
    return state, {"gaussians": len(gaussians)} | summary_of(state, plan) | device.facts()


def run_training(setup: TrainingSetup, out: Path, report: Reporter) -> TrainState:
    """Train to the end, from the start or from a killed run's checkpoint, and return the final state.

    Args:
        setup: The training setup.
        out: Folder of the checkpoint and, during training, the decoded photos.
        report: Receives progress and messages.

    Raises:
        MachineError, KeyboardInterrupt: as ``run``.
    """
    plan, device = setup.plan, setup.device
    keep_freed_heap()  # an iteration allocates what the last one freed
    state = resume(out / CHECKPOINT, setup, report)
    first, history, seconds = 1, History(), 0.0
    if state is not None:
        first, history, seconds = state.iteration + 1, state.history, state.seconds
    clock, order = Clock(seconds), setup.order_of(training_sizes(plan, history))
    with PhotoStream(setup.views, order, first, out).to(device.tensors) as photos:
        photos.warn_if_disk_full(report)
        photos.fill(report)  # before the model exists, unless it was resumed: both need memory
        if state is None:
            begun = setup.start().to(device.tensors)
            state = TrainState.begin(begun, plan, setup.techniques(), setup.placed_frozen())
        optimise(Training(state, setup, out / CHECKPOINT, clock), photos, report)
    if (flat_at := state.history.flat_at) > 0:
        planned = plan.after(state.history.sizes_ended).schedule.iterations
        report.note(f"flat after {flat_at:,} iterations: finished at {state.iteration:,} of {planned:,}")
    return state


def write_auxiliary_models(out: Path, techniques: Techniques) -> None:
    """Write the auxiliary models (sky, exposures); a model that was not trained is written as absent."""
    sky = techniques.find(SkyModel)
    write_panorama(out / "sky.npz", None if sky is None else sky.panorama)
    write_file(out / "exposures.json", exposures_json(techniques.find(Exposure)))


def summary_of(state: TrainState, plan: TrainingPlan) -> dict[str, JSON]:
    """The stage's summary of a finished training."""
    found: dict[str, JSON] = {
        "iterations": state.iteration,
        "planned_iterations": plan.schedule.iterations,
        "loss": state.history.last_loss(),
        "train_seconds": round(state.seconds, 1),
        "train_megapixels": plan.train_megapixels,
        "peak_memory_bytes": peak_memory_bytes(),
        "plan": plan.figures(),
    }
    if plan.options.sky != "off":
        found["sky_photos"] = 0
    if state.history.sizes_ended:
        found["sizes_ended"] = list(state.history.sizes_ended)
    if state.history.flat_at:
        found["flat_at"] = state.history.flat_at
    return found | state.techniques.summary()


def training_sizes(plan: TrainingPlan, history: History) -> list[TrainingSize]:
    """The training size of every iteration, as far as it is known now.

    Args:
        plan: The training plan, as first made.
        history: The training's history.
    """
    now = plan.after(history.sizes_ended)
    return now.schedule.training_sizes_until(ends_at(now, history.flat_at))


def budgeted(plan: TrainingPlan) -> bool:
    """Whether a budget shaped the plan, so that it is worth showing."""
    return bool(plan.options.time_budget_s or plan.options.max_memory_bytes)


class Clock:
    """Training time over all runs, in seconds, and when a checkpoint is due.

    Args:
        before: Seconds spent in earlier runs.
    """

    def __init__(self, before: float = 0.0) -> None:
        self._began = time.monotonic() - before
        self._last = time.monotonic()
        self._cost = 0.0

    def seconds(self) -> float:
        """Seconds spent so far, over all runs."""
        return time.monotonic() - self._began

    def is_up(self, plan: TrainingPlan) -> bool:
        """Whether the time budget is used up."""
        return 0.0 < plan.train_seconds <= self.seconds()

    def checkpoint_due(self) -> bool:
        """Whether it is time for the next checkpoint."""
        return time.monotonic() - self._last >= max(CHECKPOINT_SECONDS, self._cost / CHECKPOINT_SHARE)

    @contextmanager
    def checkpointing(self) -> Iterator[None]:
        """Measure the cost of the checkpoint saved in the body."""
        started = time.monotonic()
        yield
        self._last = time.monotonic()
        self._cost = self._last - started


@dataclass(frozen=True)
class Training:
    """A running training.

    Attributes:
        state: Changed in place.
        setup: The training setup.
        path: Path of the checkpoint.
        clock: The training's clock.
    """

    state: TrainState
    setup: TrainingSetup
    path: Path
    clock: Clock

    def save(self) -> None:
        """Write a checkpoint."""
        save_checkpoint(self.path, self.setup.plan.digest(), self.state.checkpoint(self.setup.device.kernels))

    @property
    def now(self) -> TrainingPlan:
        """The current plan."""
        return self.setup.plan.after(self.state.history.sizes_ended)

    @property
    def last(self) -> int:
        """The last iteration, as far as it is known now."""
        return ends_at(self.now, self.state.history.flat_at)

    def report_due(self) -> bool:
        """Whether progress is reported after this iteration."""
        every = REPORT_EVERY if self.setup.device.name == "cpu" else CUDA_REPORT_EVERY
        return self.state.iteration % every == 0 or self.state.iteration == self.last


def resume(path: Path, setup: TrainingSetup, report: Reporter) -> TrainState | None:
    """The state that a killed run left, or None; a broken checkpoint is reported and ignored.

    Args:
        path: The checkpoint.
        setup: The training setup; training resumes on its device, whichever device it began on.
        report: Receives warnings.
    """
    device = setup.device
    try:
        checkpoint = load_checkpoint(path, setup.plan.digest())
        frozen = setup.placed_frozen()
        state = TrainState.restore(checkpoint, setup.plan, setup.techniques(), device.tensors, frozen)
    except FileNotFoundError:
        return None
    except BrokenCheckpointError as error:
        report.warning(f"The checkpoint of the training cannot be used: {error}. Training starts from the beginning.")
        return None
    begun, here = checkpoint.facts.get("instruction_set"), device.kernels
    if begun != here:
        report.warning(
            f"Training resumes on {here}, after starting on {begun}: the quality is the same, but the result is "
            "not bit-identical."
        )
    return state


def optimise(training: Training, photos: PhotoStream, report: Reporter) -> None:
    """Train to the plan's last iteration or last second, writing checkpoints on the way.

    The clock decides when a checkpoint is written and, under a time budget, after which iteration the training ends.
    What an iteration computes does not depend on it.

    Raises:
        KeyboardInterrupt: on a request to stop, after a checkpoint.
        MachineError: if the device's memory is too small.
    """
    state, plan, clock = training.state, training.now, training.clock
    with deferred_interrupts() as interrupt:
        for photo in photos:
            iterate_within_memory(state, plan, photo, report)
            state.seconds = clock.seconds()
            if state.history.growth_ended == state.iteration:
                report_growth_ended(state, plan, report)
            if state.iteration in state.history.sizes_ended[-1:]:
                plan = training.now
                order = training.setup.order_of(training_sizes(training.setup.plan, state.history))
                photos.switch_order(order, state.iteration + 1)
                report_larger_photos(state, plan, report)
            if interrupt.requested:
                break
            if clock.is_up(plan):
                end_early(state, plan, photo, report)
                break
            if clock.checkpoint_due() and state.iteration < training.last:
                with clock.checkpointing():
                    training.save()
            if training.report_due():
                report_progress(state, plan, report)
            if state.iteration == training.last:
                break
    if interrupt.requested:  # checked again: the request may have come after the last iteration's check
        training.save()
        raise KeyboardInterrupt


def report_growth_ended(state: TrainState, plan: TrainingPlan, report: Reporter) -> None:
    """Warn that memory stops the model from growing."""
    limited = plan.options.max_memory_bytes > 0
    report.warning(
        f"The {'memory limit is close' if limited else 'device has no memory left'}, "
        f"so no Gaussians are added after iteration {state.iteration:,}.",
        hint=f"{'Give more with --max-memory' if limited else 'Lower train.max_gaussians'}, "
        "or smaller photos with train.max_megapixels.",
    )


def report_larger_photos(state: TrainState, plan: TrainingPlan, report: Reporter) -> None:
    """Report that a photo size ended early, and how many iterations there are now in total."""
    report.note(
        f"flat after {state.iteration:,} iterations: continuing with larger photos, to "
        f"{plan.schedule.iterations:,} in all"
    )


def end_early(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto, report: Reporter) -> None:
    """Close the history of a training whose time is up, and report where the schedule was cut."""
    state.history.end_iteration(state.iteration, True, curve_facts(state, plan, photo))
    report_progress(state, plan, report)
    if state.iteration < plan.schedule.iterations:
        report.note(
            f"time budget used up after {state.iteration:,} of {plan.schedule.iterations:,} planned iterations; "
            "the model is kept as it is"
        )


def report_progress(state: TrainState, plan: TrainingPlan, report: Reporter) -> None:
    """Report the training's progress."""
    planned = min(plan.schedule.iterations, ends_at(plan, state.history.flat_at))
    report.progress(state.iteration, max(state.iteration, planned), "training", "iterations")
    if (loss := state.history.recent_loss()) is not None:
        report.metric("loss", loss, state.iteration)
    report.metric("gaussians", len(state.gaussians), state.iteration)
