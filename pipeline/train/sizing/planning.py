"""Planning a training under time and memory budgets, once, before its first iteration."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.machine import resident_bytes
from splatpipe.pipeline.engine.stage import Machine, Reporter
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.raster.device import Device, cpu, free_bytes
from splatpipe.pipeline.render.options import JUDGED_MEGAPIXELS
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.options import FILM_FROM_BUDGET_S, TrainConfig
from splatpipe.pipeline.train.plan.budget import FIRST_GROWTH, MIN_GAUSSIANS, BudgetTask, choose
from splatpipe.pipeline.train.plan.limits import (
    FIRST_ITERATIONS,
    FIXED_BYTES,
    PIXEL_BYTES,
    bytes_per_gaussian,
    device_bytes_per_gaussian,
    window_within,
    worthwhile_iterations,
)
from splatpipe.pipeline.train.plan.plan import TrainingPlan, footage_of
from splatpipe.pipeline.train.plan.start import InitialGaussians, started
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.sizing.measure import MachineSpeed, MeasuringBudget, TimedScene, measure
from splatpipe.pipeline.train.sizing.shortage import HINT

RESIDENT_STEP = 16_000_000  # resident memory is rounded up to it: a few pages more or less change no plan
MEASURE_SHARE = 0.05  # share of the budget spent on measuring at most
MEASURE_SECONDS = 10.0  # spent on measuring at most: by then the noise of a shared machine is averaged out
PILOT_GROWTH_A_SECOND = {"cpu": 150.0, "cuda": 15_000.0}
"""Approximate number of Gaussians that a second of budget pays for: where the forecast has to be accurate. Measured on
CPUs; for CUDA a judgement, two orders of magnitude more: with fewer Gaussians an iteration there is all fixed cost,
which says nothing about the cost per Gaussian."""
MIN_SHARE = 0.1  # share of the budget for the training, even if nothing is left: the overall tolerance
FILM_VIEWS = 40  # held-out views that take as long to evaluate as a ten-second film takes to render
EXPORT_SECONDS = 5.5  # fixed cost of the last stages: digests, the report with its images, process exit


@dataclass(frozen=True)
class PlanningInput:
    """The scene and machine to plan for.

    Attributes:
        config: The options, not resolved.
        start: The initial Gaussians.
        trained_on: Views to train on.
        held_out: Number of other views that `evaluate` measures.
        machine: Threads, and the start time of the command.
        device: The training device.
        sky: The initial sky; None without one.
    """

    config: TrainConfig
    start: InitialGaussians
    trained_on: Sequence[View]
    held_out: int
    machine: Machine
    device: Device = field(default_factory=cpu)
    sky: SkyModel | None = None


def plan_within_budgets(plan: TrainingPlan, scene: PlanningInput, report: Reporter) -> TrainingPlan:
    """Fit a plan to the budgets of its options, and its initial Gaussians to the cap.

    Args:
        plan: A plan with resolved schedules.
        scene: The scene to train.
        report: Receives warnings.

    Raises:
        MachineError: if memory is too small for any training.
    """
    if plan.options.max_memory_bytes:
        plan = within_memory(plan, scene.start.sparse, report, scene.device.name == "cuda")
    if plan.options.time_budget_s:
        plan = within_time(plan, scene, report)
    start = scene.start
    return replace(plan, initial_gaussians=started(start.sparse, start.dense, plan.options.max_gaussians))


def within_memory(plan: TrainingPlan, sparse: int, report: Reporter, on_cuda: bool = False) -> TrainingPlan:
    """The plan with windows and a cap on Gaussians that keep the process, or a device's tensors, within the limit.

    Args:
        plan: The plan without the limit, which is ``max_memory_bytes`` of its options.
        sparse: Number of initial Gaussians from sparse points; dense ones are dropped first, without a warning.
        report: Receives a warning if those from sparse points have to be thinned.
        on_cuda: Whether the training's tensors are on a CUDA device.

    Raises:
        MachineError: if not even the minimum fits beside what the process already uses.
    """
    return_free_heap()
    limit, taken = plan.options.max_memory_bytes, -(-resident_bytes() // RESIDENT_STEP) * RESIDENT_STEP
    of_one = bytes_per_gaussian(plan.options.sh_degree)
    if on_cuda:
        taken, of_one = 0, device_bytes_per_gaussian(plan.options.sh_degree)
    room = limit - taken - FIXED_BYTES
    plan = plan.within_windows(window_within(room, plan.window_pixels))
    pixels = max(plan.footage.largest(stretch.training_size) for stretch in plan.schedule.stretches)
    most = (room - PIXEL_BYTES * pixels) // of_one
    if most < min(MIN_GAUSSIANS, sparse):
        least = limit - room + PIXEL_BYTES * pixels + MIN_GAUSSIANS * of_one
        raise MachineError(
            f"Training cannot keep to {limit / 1e9:.2f} GB: the process takes {taken / 1e9:.2f} GB already, "
            f"and {pixels / 1e6:.2f} megapixels of a photo need memory as well.",
            hint=f"Give --max-memory at least {least / 1e6 + 1:.0f}M.",
        )
    if most < sparse:
        report.warning(
            f"{limit / 1e9:.2f} GB hold {most:,} Gaussians, fewer than the {sparse:,} sparse points: "
            "every part of the scene is thinned evenly.",
            hint="For a finer model, give more with --max-memory.",
        )
    cap = min(plan.options.max_gaussians, int(most))
    return plan.of(plan.options.model_copy(update={"max_gaussians": cap}))


def within_time(plan: TrainingPlan, scene: PlanningInput, report: Reporter) -> TrainingPlan:
    """The plan that fills the time budget left after reserving time for the last stages."""
    budget, began = plan.options.time_budget_s, time.monotonic()
    if 0.0 < scene.machine.began_s < began:
        began = scene.machine.began_s
    before = time.monotonic() - began
    effort = MeasuringBudget(
        min(MEASURE_SECONDS, MEASURE_SHARE * budget),
        max(MIN_SHARE * budget, budget - before) / worthwhile_iterations(budget - before),
    )
    trial = pilot(plan, scene)
    subject = TimedScene(scene.start.within(trial.options.max_gaussians), scene.trained_on, scene.device, scene.sky)
    try:
        measured = measure(trial, subject, effort, report)
    except torch.OutOfMemoryError as error:
        raise MachineError(
            f"The graphics card has too little memory for the trial run that plans --time-budget, of "
            f"{trial.options.max_gaussians:,} Gaussians.",
            hint=HINT,
        ) from error
    left = budget - (time.monotonic() - began)
    choice = choose(_task(plan, scene, measured, left))
    if choice.seconds <= MIN_SHARE * budget:
        report.warning(
            f"The stages before training took {before:.0f} s of the {budget:.0f} s, so there is time only for a "
            "rough model.",
            hint="Run again with the same or a longer --time-budget: earlier results are reused.",
        )
    return replace(
        plan.of(choice.options),
        last_iteration=choice.last_iteration,
        train_seconds=max(0.01, round(choice.seconds, 2)),
        forecast_seconds=round(choice.forecast_s, 2),
        ends_when_flat=choice.is_most,
    )


def pilot(plan: TrainingPlan, scene: PlanningInput) -> TrainingPlan:
    """The plan of a short trial run, with a cap close to the one that the budget may allow.

    Args:
        plan: A plan without a budget.
        scene: The scene to train.
    """
    paid_for = PILOT_GROWTH_A_SECOND[scene.device.name] * scene.config.time_budget_s
    free = free_bytes(scene.device.tensors)
    if free is not None:  # a smaller model exists at the same time; both are discarded
        paid_for = min(paid_for, free / (2 * device_bytes_per_gaussian(plan.options.sh_degree)))
    wanted = max(FIRST_GROWTH * scene.start.sparse, paid_for, MIN_GAUSSIANS)
    short = {"iterations": FIRST_ITERATIONS, "max_gaussians": min(plan.options.max_gaussians, int(wanted))}
    return plan.of(scene.config.model_copy(update=short))


def _task(plan: TrainingPlan, scene: PlanningInput, measured: MachineSpeed, left: float) -> BudgetTask:
    options = scene.config.model_copy(update={"max_gaussians": plan.options.max_gaussians})
    least = MIN_SHARE * options.time_budget_s
    views = scene.held_out + (FILM_VIEWS if options.time_budget_s >= FILM_FROM_BUDGET_S else 0)
    looked_at = 1e-6 * footage_of(plan.sizes, JUDGED_MEGAPIXELS, 0).pixels(TrainingSize())  # whatever is trained
    after = EXPORT_SECONDS + views * measured.evaluate_s * looked_at
    return BudgetTask(
        config=options,
        sparse=scene.start.sparse,
        dense=scene.start.dense,
        sizes=plan.sizes,
        window_pixels=plan.window_pixels,
        speed=measured.speed,
        prepare_s=measured.decode_s * len(scene.trained_on),
        seconds=max(least, left - after),
    )
