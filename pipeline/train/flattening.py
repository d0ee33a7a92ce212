"""A flattened copy of a trained model, in which every ray meets one smooth surface, for rendering depths.

A splat is trained for images. Its surfaces are translucent clouds of Gaussians, and on textureless walls they hang in
front of and behind the surface, because no photo constrains them. The copy is trained further for some hundred
iterations, at the size at which a whole photo fits in one window, with a distortion loss about the median, which
pulls everything along a ray to one depth, and a smoothness loss between neighbouring depths. Density control is off;
sky and exposures keep their trained values. This costs some decibels of image quality, so the delivered splat is not
changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatpipe.pipeline.engine.stage import Machine, Reporter
from splatpipe.pipeline.photos.pixels.dataset import Split, View, load_split, load_views
from splatpipe.pipeline.raster.device import Device, choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.rendering import Rendering, load_rendering
from splatpipe.pipeline.splat.containers.ply import read_splat, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.panorama import read_panorama
from splatpipe.pipeline.train.appearance.exposure import Exposure, read_exposures
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.loop import CHECKPOINT, TrainingSetup, run_training
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import WINDOW_PIXELS, Stretch
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.rates import Rates
from splatpipe.pipeline.train.plan.training_order import PhotoOrder, TrainingOrder
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.techniques.distortion_loss import DistortionLoss
from splatpipe.pipeline.train.techniques.smoothness_loss import SmoothnessLoss
from splatpipe.pipeline.train.techniques.techniques import Techniques, make_techniques

VISITS = 8  # iterations per photo, or per part of it
MIN_ITERATIONS = 300  # iterations at least, if there are few photos
SPREAD_WEIGHT = 0.5  # ten times that of a splat trained for images
EVENNESS_WEIGHT = 0.1
# positions' learning rates over the extent: later half of the published
FIRST_MEANS_RATE, LAST_MEANS_RATE = 1.6e-5, 1.6e-6
OPACITY_RATE = 0.05  # as published

FLATTENED = "flattened.ply"


@dataclass(frozen=True)
class TrainedParts:
    """The trained model to flatten, and what it was trained on.

    Attributes:
        model: The splat.
        rendering: How it is to be rendered.
        sky: Its panorama.
        exposures: The photos' exposures.
        dataset: Photos and sparse points.
        split: Which photos were trained on; the copy is not trained on the others either.
    """

    model: Path
    rendering: Path
    sky: Path
    exposures: Path
    dataset: Path
    split: Path


def flatten(trained: TrainedParts, machine: Machine, out: Path, report: Reporter) -> Gaussians:
    """Return the flattened copy, kept in `flattened.ply`; resumes from the checkpoint of a killed run.

    The result is bit-identical for any number of threads and for a resumed run.

    Args:
        trained: The model to flatten.
        machine: Affects only speed.
        out: Folder of the copy and, meanwhile, a checkpoint and decoded photos; an existing copy is reused.
        report: Receives progress and messages.

    Raises:
        SplatpipeError: if a file is missing or broken.
        MachineError: if the requested device is not available.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after a checkpoint.
    """
    path = out / FLATTENED
    if not path.is_file():
        device = choose_device(machine.device, note=report.note)
        with same_bits(machine.threads), device.deterministic():
            setup = _copy_setup(trained, device, machine.threads)
            state = run_training(setup, out, report)
            aside = path.with_suffix(".part")
            write_splat(aside, state.finished())
            aside.replace(path)
        (out / CHECKPOINT).unlink(missing_ok=True)
    return read_splat(path)


def _copy_setup(trained: TrainedParts, device: Device, threads: int) -> TrainingSetup:
    """The training setup of the copy."""
    views, split = load_views(trained.dataset), load_split(trained.split)
    exposures = read_exposures(trained.exposures, "train")
    gaussians, rendering = read_splat(trained.model), load_rendering(trained.rendering)
    options = options_of(gaussians, rendering, has_exposures=bool(exposures))
    plan = flattening_plan(options, views, split, len(gaussians), WINDOW_PIXELS[device.name])
    kept = set(split.train)
    trained_on = [view for view in views if view.camera.name in kept]
    sky = _sky(trained, trained_on, threads)

    def order_of(sizes: Sequence[TrainingSize]) -> TrainingOrder:
        return PhotoOrder([view.camera for view in trained_on], sizes, options.seed, plan.megapixels)

    def techniques() -> Techniques:
        made = make_techniques(plan, sky, device=device.tensors)
        if exposures:
            given = Exposure.given({name: exposures[name] for name in plan.train_views})
            given.move_to(device.tensors)
            made = made.with_given(given)
        return Techniques((*made, DistortionLoss(SPREAD_WEIGHT, 0, about_median=True), SmoothnessLoss(EVENNESS_WEIGHT)))

    return TrainingSetup(plan, device, trained_on, order_of, techniques, start=lambda: gaussians)


def _sky(trained: TrainedParts, views: Sequence[View], threads: int) -> SkyModel | None:
    """The trained panorama, with the photos' sky masks detected again; None if there is no sky."""
    panorama = read_panorama(trained.sky)
    if panorama is None:
        return None
    found = SkyModel.begin(views, trained.dataset, threads)
    return None if found is None else SkyModel.given(panorama, found.masks)


def options_of(gaussians: Gaussians, rendering: Rendering, has_exposures: bool) -> TrainConfig:
    """Options of a training that continues a model with the same number of Gaussians.

    Args:
        gaussians: The model.
        rendering: How it is to be rendered.
        has_exposures: Whether photos have exposures of their own.
    """
    return TrainConfig(
        max_megapixels=rendering.megapixels or 0.0,
        max_gaussians=max(1, len(gaussians)),
        sh_degree=gaussians.sh_degree,
        exposure="affine" if has_exposures else "off",
        antialias=rendering.antialias,
        densify=False,
        prune_free_space=0,
        dropout=0.0,
    )


def flattening_plan(
    options: TrainConfig, views: Sequence[View], split: Split, gaussians: int, window_pixels: int
) -> TrainingPlan:
    """The training plan of the copy.

    Args:
        options: From ``options_of``.
        views: All photos of the dataset.
        split: Which of them are trained on.
        gaussians: Number of Gaussians in the model.
        window_pixels: Most pixels of a photo that an iteration uses; photos are halved until they fit into that.
    """
    plan = make_plan(options, views, split, gaussians, window_pixels)
    footage = plan.footage
    level = footage.first_level
    iterations = max(MIN_ITERATIONS, VISITS * footage.parts(level))
    schedule = replace(
        plan.schedule,
        iterations=iterations,
        sh_every=1,
        stretches=(Stretch(level, footage.window_at(level), iterations),),
        rates=Rates(means=FIRST_MEANS_RATE, means_final=LAST_MEANS_RATE, opacity=OPACITY_RATE),
    )
    return replace(plan, schedule=schedule, last_iteration=iterations)
