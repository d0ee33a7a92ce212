"""One iteration of training, from top to bottom.

Every optional part is a technique: an object with the hooks of ``hooks.Technique``, which ``iterate`` calls in turn.
To add one, write it in a file of its own with the hooks that it needs and list it in ``techniques.py``; an option in
``options.py`` turns it on. Its trained state is kept in checkpoints through ``to_arrays`` and ``load``.
Whatever changes with the iteration comes from ``Schedule.at``, resolved before the first iteration.
"""

from __future__ import annotations

import torch

from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.loss import photo_loss, photo_loss_reference
from splatpipe.pipeline.train.flatness import end_epoch, ends_at
from splatpipe.pipeline.train.hooks import RenderedView
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import ScheduleStep
from splatpipe.pipeline.train.state.memory import over_memory
from splatpipe.pipeline.train.state.state import TrainState

SSIM_WEIGHT = 0.2  # weight of 1 - SSIM in the loss, the rest is L1; published


def iterate(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
    """Render, compare, step the parameters, then run density control if it is due.

    Args:
        state: Changed in place; ready for the next iteration afterwards.
        plan: The current training plan.
        photo: The photo to compare with.
    """
    now = plan.schedule.at(state.iteration + 1, state.history.flat_at)
    if not photo.is_empty:
        optimise_step(state, plan, photo, now)
    # Density.
    if photo.round:
        state.techniques.after_epoch(now.iteration)
    state.control_density(plan, now.iteration)
    close(state, plan, photo, now)


def optimise_step(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto, now: ScheduleStep) -> None:
    """Render, compare, step; all intermediate tensors are freed on return, because density control needs the memory.

    Args:
        state: Changed in place.
        plan: The training plan.
        photo: The photo to compare with.
        now: The schedule's values for this iteration.
    """
    techniques = state.techniques
    # Render.
    settings = techniques.settings(render_options(plan, now), state.gaussians, photo.camera, now)
    probe = state.screen_probe() if now.is_observed else None
    model = techniques.before_render(state.drawn, now)
    rendered = rasterizer.render(model, photo.camera, settings, means2d_probe=probe, buffers=state.buffers)
    # Show.
    rendered_view = RenderedView(photo, rendered, settings, now)
    picture = techniques.apply_appearance(rendered_view)
    # Loss.
    masked = techniques.mask_pixels(picture, rendered_view)
    measure = photo_loss if plan.options.loss == "native" else photo_loss_reference
    photometric = measure(picture, masked.colour, SSIM_WEIGHT, masked.mask, masked.inner)
    loss = techniques.with_penalties(photometric, rendered_view)
    # Backward.
    loss.backward()  # type: ignore[no-untyped-call]
    # Step.
    with torch.no_grad():
        own = state.of_trained(rendered)
        state.step(own.visible, now, plan, photo.camera)
        if probe is not None and probe.grad is not None:
            state.density.observe(own, probe.grad, plan.schedule.density, photo)
        techniques.after_step(rendered_view)
    state.history.add_loss(photometric.detach())


def render_options(plan: TrainingPlan, now: ScheduleStep) -> rasterizer.RenderOptions:
    """The render options of an iteration, before the techniques'."""
    return rasterizer.RenderOptions(
        sh_degree=now.sh_degree,
        background=now.background,
        antialias=plan.options.antialias,
        near=plan.near,
        depth=False,
        magnitudes=now.is_observed and plan.options.density == "absolute",
    )


def close(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto, now: ScheduleStep) -> None:
    """Count the iteration and record its consequences: growth ended by memory, a flat loss, the curve."""
    history = state.history
    if not history.growth_ended and plan.schedule.density.is_step(now.iteration):
        # A device's memory is checked before anything grows (see ``within_room``).
        on_cpu = state.gaussians.means.device.type == "cpu"
        history.growth_ended = now.iteration if on_cpu and over_memory(plan.options) else 0
    state.iteration = now.iteration
    if plan.options.stop_when_flat > 0.0 and photo.round:
        end_epoch(history, plan, now.iteration, photo.round)
    is_last = now.iteration == ends_at(plan, history.flat_at)
    history.end_iteration(now.iteration, is_last, curve_facts(state, plan, photo))


def curve_facts(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> dict[str, int]:
    """The values of a point of the history's curve besides the loss."""
    return {
        "gaussians": len(state.gaussians),
        "sh_degree": plan.schedule.sh_degree_at(state.iteration),
        "width": photo.camera.uncropped().width,
    }
