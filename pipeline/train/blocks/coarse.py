"""The coarse pass: the whole scene at its first size, up to its cap or the memory limit.

Its model is rendered around blocks and outside all of them, and blocks start from it; they also use its sky and
exposures, so that no two blocks differ in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.appearance.sky_file import write_skies
from splatpipe.pipeline.train.blocks.block_windows import footage_on
from splatpipe.pipeline.train.blocks.lengths import coarse_lengths
from splatpipe.pipeline.train.blocks.schedules import coarse_schedule
from splatpipe.pipeline.train.loop import train_whole
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.start import started
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.sizing.planning import PlanningInput

SKIES = "skies.npz"


@dataclass(frozen=True)
class TrainingLimits:
    """Limits that keep a training within its memory.

    Attributes:
        gaussians: Maximum number of Gaussians.
        window_pixels: Most pixels of a photo that an iteration uses.
    """

    gaussians: int
    window_pixels: int


def train_coarse(config: TrainConfig, inputs: Inputs, limits: TrainingLimits, out: Path, report: Reporter) -> Summary:
    """Write the same files as the stage `train`, for the whole scene at its first size, and the photos' sky masks.

    Args:
        config: The options of the whole training; a time budget is ignored.
        inputs: The inputs of the stage `train`.
        limits: The limits of this pass.
        out: Output folder, also of the checkpoint.
        report: Receives progress and messages.

    Raises:
        SplatpipeError, MachineError, KeyboardInterrupt: as ``loop.run``.
    """

    def fit(plan: TrainingPlan, scene: PlanningInput, _report: Reporter) -> TrainingPlan:
        return coarse_plan(plan, scene, limits)

    unhurried = config.model_copy(update={"time_budget_s": 0.0})
    state, summary = train_whole(unhurried, inputs, out, report, fit)
    sky = state.techniques.find(SkyModel)
    write_skies(out / SKIES, {} if sky is None else sky.masks)
    return summary


def coarse_iterations(config: TrainConfig, cameras: Sequence[Camera], window_pixels: int) -> int:
    """Number of iterations of the coarse pass.

    Args:
        config: The options of the whole training.
        cameras: Cameras of the training photos.
        window_pixels: Most pixels of a photo that an iteration uses.
    """
    footage, _most = footage_on(config, cameras, window_pixels)
    return sum(count for _level, count in coarse_lengths(config, footage))


def coarse_plan(plan: TrainingPlan, scene: PlanningInput, limits: TrainingLimits) -> TrainingPlan:
    """The plan of the coarse pass.

    Args:
        plan: Plan of the whole training.
        scene: The scene to train.
        limits: The limits of the pass.
    """
    options = plan.options.model_copy(update={"max_gaussians": limits.gaussians})
    plan = plan.within_windows(limits.window_pixels).of(options)
    schedule = coarse_schedule(options, plan.footage)
    return replace(
        plan,
        schedule=schedule,
        last_iteration=schedule.iterations,
        train_megapixels=round(1e-6 * plan.footage.pixels(TrainingSize(schedule.finest.level)), 4),
        initial_gaussians=started(scene.start.sparse, scene.start.dense, limits.gaussians),
    )
