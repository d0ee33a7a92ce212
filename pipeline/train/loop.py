"""train: from the sparse points to a splat, one photo an iteration."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from splatpipe.pipeline.engine.durable import write_durably
from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.stage import Inputs, Machine, Reporter, Summary
from splatpipe.pipeline.engine.worker import peak_memory_bytes
from splatpipe.pipeline.photos.dataset import View, load_split, load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.loss import photo_loss, photo_loss_reference
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.panorama import write_panorama
from splatpipe.pipeline.splat.ply import MIP_COMMENT, read_splat, write_splat
from splatpipe.pipeline.train.checkpoint import BrokenCheckpointError, load_checkpoint, save_checkpoint
from splatpipe.pipeline.train.draws import BACKGROUND, ELSEWHERE, uniform
from splatpipe.pipeline.train.dropout import dropped
from splatpipe.pipeline.train.exposure import exposures_json
from splatpipe.pipeline.train.flatness import ends_at, is_flat, place_in_schedule, settled_from
from splatpipe.pipeline.train.interrupts import deferred_interrupts
from splatpipe.pipeline.train.layers import depth_origin, is_spread_counted, spread_loss
from splatpipe.pipeline.train.memory import over_memory
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan import (
    Plan,
    load_or_write_plan,
    make_plan,
)
from splatpipe.pipeline.train.planning import Scene, under_budgets
from splatpipe.pipeline.train.sky import SkyModel
from splatpipe.pipeline.train.state import TrainState
from splatpipe.pipeline.train.stream import PhotoStream, TrainingPhoto
from splatpipe.pipeline.train.surroundings import begin_sky, surround

CHECKPOINT = "checkpoint.npz"
CHECKPOINT_SECONDS = 20.0  # between checkpoints: what a kill may cost
CHECKPOINT_SHARE = 0.02  # of the time at most goes into them
REPORT_EVERY = 10  # iterations
SSIM_WEIGHT = 0.2  # share of 1 - SSIM in the loss, the rest is L1: published
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def run(config: TrainConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the model, its history, its plan and side models; go on from a checkpoint where a killed run left one.

    Raises:
        SplatpipeError: if nothing is left to train on.
        MachineError: if the device asked for is not there.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after a checkpoint.
    """
    check_device(inputs.machine)
    dataset = inputs["undistort.dataset"]
    views = load_views(dataset)
    start = read_splat(inputs["initialize.splat"])
    free = make_plan(config, views, load_split(inputs["split.views"]), len(start))
    trained_on = views_of(free, views)
    scene = Scene(config, start, trained_on, len(free.test_views), inputs.machine)

    def make() -> Plan:
        return under_budgets(free, replace(scene, sky=sky), train_step, report)

    with same_bits(inputs.machine.threads):
        sky = begin_sky(config, trained_on, dataset, inputs.machine.threads, report)
        plan = load_or_write_plan(out / "plan.json", make)
        write_durably(out / "rendering.json", plan.rendering().to_json())
        if budgeted(plan):
            report.note(plan.described())
        state = resume(out / CHECKPOINT, plan, report, sky) or TrainState.begin(start, plan, sky)
        levels = plan.schedule.coarse_levels_to(ends_at(plan, state.history.flat_at))
        surround(state, plan, trained_on, dataset)
        first, size = state.iteration + 1, plan.megapixels
        with PhotoStream(trained_on, levels, plan.options.seed, first, out, size) as photos:
            photos.tell(report)
            optimise(state, plan, photos, out / CHECKPOINT, report)
        if (flat_at := state.history.flat_at) > 0:
            report.note(
                f"flat after {flat_at:,} iterations: ended with {state.iteration:,} of {plan.options.iterations:,}"
            )
        gaussians = state.finished()
    write_splat(out / "model.ply", gaussians, [MIP_COMMENT] if plan.options.antialias else [])
    (out / "history.json").write_text(state.history.to_json(), encoding="utf-8")
    return {
        "gaussians": len(gaussians),
        "iterations": state.iteration,
        "planned_iterations": plan.options.iterations,
        "loss": state.history.last_loss(),
        "train_seconds": round(state.seconds, 1),
        "train_megapixels": plan.train_megapixels,
        "peak_memory_bytes": peak_memory_bytes(),
        "device": "cpu",
        "instruction_set": rasterizer.isa_name(),
        "plan": plan.options.model_dump(mode="json") | {"initial_gaussians": plan.initial_gaussians},
    } | write_side_models(out, state, plan.options)


def write_side_models(out: Path, state: TrainState, options: TrainConfig) -> dict[str, int | float]:
    """Write what was trained beside the Gaussians; what the summary says of techniques that were asked for."""
    write_panorama(out / "sky.npz", None if state.sky is None else state.sky.panorama)
    (out / "exposures.json").write_text(exposures_json(state.exposure), encoding="utf-8")
    summary: dict[str, int | float] = {}
    if options.sky != "off":
        summary["sky_photos"] = 0 if state.sky is None else state.sky.photos
    if state.history.flat_at:
        summary["flat_at"] = state.history.flat_at
    if state.robust is not None:
        summary["robust_left_out"] = round(state.robust.share_left_out(), 5)
    return summary


def views_of(plan: Plan, views: Sequence[View]) -> list[View]:
    """The views that the plan trains on."""
    kept = set(plan.train_views)
    return [view for view in views if view.camera.name in kept]


def budgeted(plan: Plan) -> bool:
    """Whether a budget had a say in the plan, so that people want to see it."""
    return bool(plan.options.time_budget_s or plan.options.max_memory_bytes)


def check_device(machine: Machine) -> None:
    """Refuse a device that is not there.

    Raises:
        MachineError: for `cuda`, for which this build has no kernels.
    """
    if machine.device == "cuda":
        raise MachineError(
            "This build of splatpipe has no CUDA kernels, so it cannot train on a CUDA device.",
            hint="Leave --device out, or give --device cpu.",
        )


def resume(path: Path, plan: Plan, report: Reporter, sky: SkyModel | None) -> TrainState | None:
    """The state that a killed run left, or None; a broken one is told and ignored."""
    try:
        checkpoint = load_checkpoint(path, plan.digest())
        state = TrainState.restore(checkpoint, plan, sky)
    except FileNotFoundError:
        return None
    except BrokenCheckpointError as error:
        report.warning(f"The checkpoint of the training cannot be used: {error}. It starts afresh.")
        return None
    begun, here = checkpoint.facts.get("instruction_set"), rasterizer.isa_name()
    if begun != here:
        report.warning(f"The training goes on with {here} from {begun}: as good, but not the same to the last bit.")
    return state


def optimise(state: TrainState, plan: Plan, photos: PhotoStream, checkpoint: Path, report: Reporter) -> None:
    """Train to the plan's last iteration or last second, leaving checkpoints on the way.

    The clock decides when a checkpoint is written and, under a time budget, after which iteration the training ends.
    What an iteration computes does not depend on it.

    Raises:
        KeyboardInterrupt: when asked to end, after a checkpoint.
    """
    clock = _Clock(state.seconds)
    with deferred_interrupts() as interrupt:
        for photo in photos:
            train_step(state, plan, photo)
            state.seconds = clock.seconds()
            if state.history.growth_ended == state.iteration:
                report.warning(
                    f"The memory limit is close, so no Gaussian is added after iteration {state.iteration:,}.",
                    hint="Give more with --max-memory, or smaller photos with undistort.max_megapixels.",
                )
            if interrupt.requested:
                break
            if clock.is_up(plan):
                end_now(state, plan, photo, report)
                break
            last = ends_at(plan, state.history.flat_at)
            if clock.checkpoint_due() and state.iteration < last:
                with clock.checkpointing():
                    save_checkpoint(checkpoint, plan.digest(), state.checkpoint(rasterizer.isa_name()))
            if state.iteration % REPORT_EVERY == 0 or state.iteration == last:
                tell(state, plan, report)
            if state.iteration == last:
                break
    if interrupt.requested:  # asked of once more: it may have come after the last iteration's look
        save_checkpoint(checkpoint, plan.digest(), state.checkpoint(rasterizer.isa_name()))
        raise KeyboardInterrupt


def end_now(state: TrainState, plan: Plan, photo: TrainingPhoto, report: Reporter) -> None:
    """Close the history of a training whose time is up, and say where that cut the schedule."""
    state.history.end_iteration(state.iteration, True, curve_facts(state, plan, photo))
    tell(state, plan, report)
    if state.iteration < plan.options.iterations:
        report.note(
            f"its time is up after {state.iteration:,} of {plan.options.iterations:,} planned iterations; "
            "the model is taken as it stands"
        )


def tell(state: TrainState, plan: Plan, report: Reporter) -> None:
    """Report how far the training is."""
    planned = min(plan.options.iterations, ends_at(plan, state.history.flat_at))
    report.progress(state.iteration, max(state.iteration, planned), "training", "iterations")
    if (loss := state.history.recent_loss()) is not None:
        report.metric("loss", loss, state.iteration)
    report.metric("gaussians", len(state.gaussians), state.iteration)


def train_step(state: TrainState, plan: Plan, photo: TrainingPhoto) -> None:
    """One iteration: render, compare, step the parameters, then density control where it is due.

    Args:
        state: Changed in place; afterwards it is of the next iteration.
        plan: The training's.
        photo: What to compare with.
    """
    options, iteration = plan.options, state.iteration + 1
    if photo.mask is None or bool(photo.mask.any()):
        descend(state, plan, photo, iteration)
    state.end_epoch(iteration, plan)
    state.control_density(plan, iteration)
    growing = not state.history.growth_ended
    if growing and plan.schedule.density.is_step(iteration) and over_memory(options):
        state.history.growth_ended = iteration
    state.iteration = iteration
    if options.stop_when_flat > 0.0 and iteration % len(plan.train_views) == 0:
        judge_epoch(state, plan)
    is_last = iteration == ends_at(plan, state.history.flat_at)
    state.history.end_iteration(iteration, is_last, curve_facts(state, plan, photo))


def judge_epoch(state: TrainState, plan: Plan) -> None:
    """Close an epoch, and note where the loss is flat."""
    history, photos = state.history, len(plan.train_views)
    history.end_epoch(state.iteration - photos // 2, state.iteration - photos >= settled_from(plan.schedule))
    if not history.flat_at and is_flat(history.epochs, plan, state.iteration):
        history.flat_at = state.iteration


def curve_facts(state: TrainState, plan: Plan, photo: TrainingPhoto) -> dict[str, int]:
    """What a point of the history's curve says besides the loss."""
    return {
        "gaussians": len(state.gaussians),
        "sh_degree": plan.schedule.sh_degree_at(state.iteration),
        "width": photo.camera.width,
    }


def descend(state: TrainState, plan: Plan, photo: TrainingPhoto, iteration: int) -> None:
    """Render the photo's view and step the parameters against the loss's gradient."""
    options = plan.options
    density = plan.schedule.density
    observed = density.on and iteration <= density.last
    place = place_in_schedule(plan, state.history.flat_at, iteration)
    settings = render_options(plan, iteration, observed and state.density.magnitudes)
    if spread := is_spread_counted(options, place):
        settings = replace(settings, depth=True, depth_origin=depth_origin(state.gaussians.means, photo.camera))
    probe = state.probe() if observed else None
    model = dropped(state.rendered_model(options), plan.schedule, place)
    rendered = rasterizer.render(model, photo.camera, settings, means2d_probe=probe, buffers=state.buffers)
    photometric, penalties = losses(state, plan, photo, rendered, settings.background)
    loss = photometric + penalties
    if spread:
        loss = loss + options.distortion_weight * spread_loss(rendered, settings.depth_origin, photo.camera)
    loss.backward()  # type: ignore[no-untyped-call]
    state.history.add_loss(float(photometric.detach()))
    with torch.no_grad():
        if probe is not None and probe.grad is not None:
            state.density.observe(rendered, probe.grad, density)
        means_rate = plan.extent * plan.schedule.means_rate(place)
        state.step(rendered.visible, means_rate, plan.extent, plan.schedule)
        share = min(1.0, place / options.iterations)
        if state.exposure is not None:
            state.exposure.step(photo.camera.name, share)
        if state.sky is not None:
            state.sky.step(share)


def losses(
    state: TrainState, plan: Plan, photo: TrainingPhoto, rendered: rasterizer.Render, behind: tuple[float, float, float]
) -> tuple[Tensor, Tensor]:
    """How far a render is from its photo, shown as the photo's sky and exposure would, and what the sky adds to that.

    Args:
        state: Of whose side models the render is completed.
        plan: The training's.
        photo: What to compare with.
        rendered: The Gaussians alone.
        behind: The colour that they were rendered over.
    """
    options, shown, penalty = plan.options, rendered.colour, rendered.colour.new_zeros(())
    if state.sky is not None:
        elsewhere = random_colour(options, state.iteration + 1, ELSEWHERE)
        seen = state.sky.seen(photo.camera)
        shown = state.sky.composite(rendered, photo.camera, seen, behind, elsewhere)
        penalty = state.sky.penalty(rendered.alpha, seen)
    if state.exposure is not None:
        shown = state.exposure.shown(shown, photo.camera.name)
    if state.robust is not None:
        photo = state.robust.look(photo, rendered, shown)
    measure = photo_loss if options.loss == "native" else photo_loss_reference
    return measure(shown, photo.colour, SSIM_WEIGHT, photo.mask), penalty


def render_options(plan: Plan, iteration: int, magnitudes: bool) -> rasterizer.RenderOptions:
    """How an iteration renders; with ``magnitudes`` of the screen gradient where density control looks on."""
    options = plan.options
    return rasterizer.RenderOptions(
        sh_degree=plan.schedule.sh_degree_at(iteration),
        background=background(options, iteration),
        antialias=options.antialias,
        near=plan.near,
        depth=options.robust > 0.0,
        magnitudes=magnitudes,
    )


def background(options: TrainConfig, iteration: int) -> tuple[float, float, float]:
    """What is behind the Gaussians in an iteration, red, green, blue."""
    if options.background == "random":
        return random_colour(options, iteration, BACKGROUND)
    return BACKGROUNDS[options.background]


def random_colour(options: TrainConfig, iteration: int, stream: int) -> tuple[float, float, float]:
    """A colour of its own for every iteration, red, green, blue; ``stream`` as in ``draws``."""
    red, green, blue = uniform(options.seed, iteration, stream, [0, 1, 2]).tolist()
    return red, green, blue


class _Clock:
    """Seconds of a training over all its runs, and when a checkpoint is due."""

    def __init__(self, before: float) -> None:
        self._began = time.monotonic() - before
        self._last = time.monotonic()
        self._cost = 0.0

    def seconds(self) -> float:
        return time.monotonic() - self._began

    def is_up(self, plan: Plan) -> bool:
        return 0.0 < plan.train_seconds <= self.seconds()

    def checkpoint_due(self) -> bool:
        return time.monotonic() - self._last >= max(CHECKPOINT_SECONDS, self._cost / CHECKPOINT_SHARE)

    @contextmanager
    def checkpointing(self) -> Iterator[None]:
        started = time.monotonic()
        yield
        self._last = time.monotonic()
        self._cost = self._last - started
