"""Measuring this machine's speed on this scene: real iterations on throw-away states, and one view's evaluation."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import torch

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.photos.pixels.images import reduced_view
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.device import Device
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality import metrics
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.photos.upload import Uploader
from splatpipe.pipeline.train.plan.budget import SMALLEST_MEGAPIXELS, Speed, Timing, fit_speed
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import Schedule
from splatpipe.pipeline.train.sizing.shortage import iterate_within_memory
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import make_techniques

MAX_VIEWS = 8  # timed per size: their mean is within a few percent of that of all photos
PICTURES = 3  # images that `evaluate` keeps per view: photo, render, error
NEVER = 1_000_000_000  # iterations until a step of density control
WARM_UP_ITERATIONS = 100  # until opacities, which step by a twentieth of a logit, are spread as in training
WARM_UP_SHARE = 0.5  # largest share of the measuring time
PILOT_ITERATION = 10  # iteration that the pilot's state claims, so that all SH degrees take part
WINDOW_SIDE = 2  # divisor of the sides of the timed windows
SPLIT_SHRINK = 0.25  # fall of log scales per log of growth: between clones, which keep their size, and splits (0.5)
STREAM = 7  # added to the seed for the jitter's random numbers; the pilot is thrown away, nothing depends on them


@dataclass(frozen=True)
class MachineSpeed:
    """The speed of this machine on this scene.

    Attributes:
        speed: Cost model of an iteration.
        decode_s: Seconds to read and reduce a photo of the dataset.
        evaluate_s: Seconds per megapixel to render, measure and store a held-out view.
    """

    speed: Speed
    decode_s: float
    evaluate_s: float


@dataclass(frozen=True)
class MeasuringBudget:
    """The time for measuring, and its target.

    Attributes:
        most_s: No round is started after this many seconds; one is always done.
        iteration_s: Approximate time of an iteration in the plan; photos of that cost are timed.
    """

    most_s: float
    iteration_s: float


@dataclass(frozen=True)
class TimedScene:
    """The scene of the timed trial.

    Attributes:
        start: The initial Gaussians.
        views: Views to train on.
        device: The compute device.
        sky: The initial sky; a copy is trained.
    """

    start: Gaussians
    views: Sequence[View]
    device: Device
    sky: SkyModel | None = None


def measure(plan: TrainingPlan, subject: TimedScene, effort: MeasuringBudget, report: Reporter) -> MachineSpeed:
    """Time real iterations at two sizes, on windows of the larger one, and at two numbers of Gaussians.

    Args:
        plan: A plan without a budget; its cap is the larger number of Gaussians.
        subject: The scene to time.
        effort: The time limit.
        report: Receives warnings about a lack of memory.
    """
    start, views, device = subject.start, subject.views, subject.device
    began = time.monotonic()
    chosen = [views[index * len(views) // min(len(views), MAX_VIEWS)] for index in range(min(len(views), MAX_VIEWS))]
    trial = replace(plan, schedule=pilot_schedule(plan.schedule))
    small, _ = _photos(chosen, SMALLEST_MEGAPIXELS, device)
    counts = sorted({min(len(start), plan.options.max_gaussians), plan.options.max_gaussians})
    models = [stretched(start, count, plan.options.seed) for count in counts]
    states = [_pilot_state(model.to(device.tensors), trial, subject) for model in models]
    _warm_up(states, trial, small, began + WARM_UP_SHARE * effort.most_s, report)
    first = _timed(states[0], trial, small[0], device, report)
    # Cost grows slightly slower than size, so the line through two sizes is accurate only near them.
    megapixels = SMALLEST_MEGAPIXELS * max(2.0, effort.iteration_s / first.seconds)
    large, decode_s = _photos(chosen, megapixels, device)
    finished = states[-1].finished().to(device.tensors)
    _evaluation_seconds(finished, small[0], plan)  # absorbs one-time loading
    evaluate_s = _evaluation_seconds(finished, large[0], plan)
    timings = [first]
    for photos in zip(small, large, map(middle_of, large), strict=True):
        for state in states:
            timings += [_timed(state, trial, photo, device, report) for photo in photos]
        if time.monotonic() - began > effort.most_s:
            break
    return MachineSpeed(fit_speed(timings), decode_s, evaluate_s)


def pilot_schedule(schedule: Schedule) -> Schedule:
    """The schedule without density-control steps and with all SH degrees active."""
    density = replace(schedule.density, first=1, last=NEVER, every=NEVER, reset_every=0)
    return replace(schedule, sh_every=1, density=density)


def stretched(start: Gaussians, count: int, seed: int) -> Gaussians:
    """The Gaussians thinned or multiplied to ``count``, with about the same area in the photos.

    Args:
        start: Of the scene.
        count: How many are wanted.
        seed: Of the jitter within each parent.
    """
    rows = torch.arange(count) * len(start) // count
    model = start.select(rows)
    if count > len(start):
        generator = torch.Generator().manual_seed(seed + STREAM)
        sizes = torch.exp(model.log_scales)
        model.means = model.means + sizes * torch.randn(count, 3, generator=generator)
        model.log_scales = model.log_scales - SPLIT_SHRINK * math.log(count / len(start))
    return model


def _pilot_state(start: Gaussians, trial: TrainingPlan, subject: TimedScene) -> TrainState:
    state = TrainState.begin(start, trial, make_techniques(trial, subject.sky, device=subject.device.tensors))
    state.iteration = PILOT_ITERATION
    return state


def _warm_up(
    states: Sequence[TrainState], trial: TrainingPlan, photos: Sequence[TrainingPhoto], until: float, report: Reporter
) -> None:
    """Train each state briefly: opacities and sizes cost more once they have moved from their initial values."""
    for number in range(WARM_UP_ITERATIONS):
        for state in states:
            iterate_within_memory(state, trial, photos[number % len(photos)], report)
        if time.monotonic() > until:
            break


def _photos(views: Sequence[View], megapixels: float, device: Device) -> tuple[list[TrainingPhoto], float]:
    """The views as training photos, and the mean seconds per view."""
    began = time.monotonic()
    uploader, photos = Uploader(device.tensors), []
    for view in views:
        camera, pixels, mask = reduced_view(view, megapixels)
        sent = uploader.end(uploader.begin(pixels, mask))
        photos.append(TrainingPhoto(camera, *sent, mask is not None and not mask.any()))
    return photos, (time.monotonic() - began) / len(photos)


def middle_of(photo: TrainingPhoto) -> TrainingPhoto:
    """The window in the middle of a photo, with half its sides: most Gaussians around it are not visible."""
    camera = photo.camera
    width, height = max(1, camera.width // WINDOW_SIDE), max(1, camera.height // WINDOW_SIDE)
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    rows, columns = slice(top, top + height), slice(left, left + width)
    mask = None if photo.mask is None else photo.mask[rows, columns].contiguous()
    share = width * height / (camera.width * camera.height)
    colour = photo.colour[rows, columns].contiguous()
    return TrainingPhoto(camera.crop(left, top, width, height), colour, mask, photo.is_empty, None, share)


def _timed(state: TrainState, trial: TrainingPlan, photo: TrainingPhoto, device: Device, report: Reporter) -> Timing:
    device.wait()
    began = time.monotonic()
    iterate_within_memory(state, trial, photo, report)
    device.wait()
    seconds = time.monotonic() - began
    pixels, whole = photo.camera.width * photo.camera.height, photo.camera.uncropped()
    return Timing(len(state.gaussians), pixels, max(seconds, 1e-6), pixels / (whole.width * whole.height))


def _evaluation_seconds(gaussians: Gaussians, photo: TrainingPhoto, plan: TrainingPlan) -> float:
    """Seconds per megapixel of a held-out view: a render, every metric, the images as PNG."""
    began = time.monotonic()
    with torch.no_grad():
        options = rasterizer.RenderOptions(
            gaussians.sh_degree, antialias=plan.options.antialias, near=plan.near, depth=False
        )
        colour = rasterizer.render(gaussians, photo.camera, options).colour.clamp(0.0, 1.0)
    photo_colour = photo.colour.cpu()
    mask = None if photo.mask is None else photo.mask.cpu()
    pair = metrics.pair_of(colour.cpu(), photo_colour, mask)
    for metric in metrics.METRICS.values():
        try:
            metric.of_pair(pair)
        except ValueError:
            continue  # too few pixels for this metric: `evaluate` leaves it out too
    pixels = (photo_colour * 255.0).to(torch.uint8).numpy()
    for _ in range(PICTURES):
        cv2.imencode(".png", pixels)
    return (time.monotonic() - began) / (1e-6 * photo.camera.width * photo.camera.height)
