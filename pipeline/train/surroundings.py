"""What a training sees of its dataset besides the photos: made anew for each run of it, no checkpoint keeps it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.train.clearing import free_space_of
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan import Plan
from splatpipe.pipeline.train.sky import SkyModel
from splatpipe.pipeline.train.smoothing import sampling_of
from splatpipe.pipeline.train.state import TrainState


def begin_sky(
    config: TrainConfig, views: Sequence[View], dataset: Path, threads: int, report: Reporter
) -> SkyModel | None:
    """The sky to be trained; None where it is off or none of the photos shows any."""
    if config.sky == "off":
        return None
    sky = SkyModel.begin(views, dataset, threads)
    if sky is not None:
        report.note(f"sky in {sky.photos} photos")
    return sky


def surround(state: TrainState, plan: Plan, views: Sequence[View], dataset: Path) -> None:
    """Give a state what its techniques want of the dataset: sampling, free space, cameras to compare.

    Args:
        state: Changed in place.
        plan: The training's.
        views: Those that it trains on.
        dataset: Theirs, with the sparse points.

    Raises:
        StageError: if the dataset is broken.
    """
    state.sampling = sampling_of(plan, views)
    state.free_space = free_space_of(views, dataset, plan.options)
    if state.robust is not None:
        state.robust.watch(view.camera for view in views)
