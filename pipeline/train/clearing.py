"""Gaussians that hang where photos look through, or right before a camera, are removed in training.

The published trainer has only an opacity reset against them. That photos see sparse points through a place says more:
`pipeline.scene.free_space` has the test, here with the photos trained on alone, so that no held-out one has a say.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from splatpipe.pipeline.photos.dataset import View, load_points_and_tracks
from splatpipe.pipeline.splat.free_space import FreeSpace, free_space, near_or_free
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.schedule import Schedule

STEPS_BETWEEN = 5  # steps of density control from one look to the next: a look takes as long as several iterations
LAST_LOOK = 0.9  # of the run: the rest closes the holes


def free_space_of(views: Sequence[View], dataset: Path, options: TrainConfig) -> FreeSpace | None:
    """What the photos say is free; None where nobody asks.

    Args:
        views: The photos trained on.
        dataset: Theirs, with the sparse points.
        options: The training's.

    Raises:
        StageError: if the dataset is broken.
    """
    if not options.prune_free_space:
        return None
    points, tracks = load_points_and_tracks(dataset)
    cameras = [view.camera for view in views]
    return free_space(cameras, points.xyz, [tracks[camera.name] for camera in cameras])


def is_clearing_step(space: FreeSpace | None, schedule: Schedule, iteration: int) -> bool:
    """Whether Gaussians in free space are looked for after an iteration (from 1).

    Density control has its own beginning and end. Looking goes on after it: what is left fits the photos by hanging
    before the surface, most of all where they are few.

    Args:
        space: What is free; None where nobody asks.
        schedule: The training's.
        iteration: The one that ends.
    """
    density = schedule.density
    due = iteration % (STEPS_BETWEEN * density.every) == 0 and iteration <= LAST_LOOK * schedule.iterations
    return space is not None and density.on and due and density.first <= iteration


def unwanted(gaussians: Gaussians, space: FreeSpace | None, schedule: Schedule, iteration: int) -> Bool[Tensor, " n"]:
    """Which Gaussians hang in free space, at a step of density control that looks; none at the others.

    Args:
        gaussians: As they are rendered.
        space: What is free.
        schedule: The training's.
        iteration: Now.
    """
    if space is None or not is_clearing_step(space, schedule, iteration):
        return torch.zeros(len(gaussians), dtype=torch.bool)
    return near_or_free(gaussians, space, schedule.density.prune_free_space)
