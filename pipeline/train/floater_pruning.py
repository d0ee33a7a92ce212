"""Gaussians that hang where photos look through, or right before a camera, are removed in training.

The published trainer has only an opacity reset against them. That photos see sparse points through a place says more:
`splat.free_space` has the test, here with the photos trained on alone, so that no held-out one has a say.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from splatpipe.pipeline.photos.dataset import View, load_points_and_tracks
from splatpipe.pipeline.splat.free_space import FreeSpace, free_space, near_or_free
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.hooks import Technique
from splatpipe.pipeline.train.schedule import Schedule

STEPS_BETWEEN = 5  # steps of density control from one look to the next: a look takes as long as several iterations
LAST_LOOK = 0.9  # of the run: the rest closes the holes


def free_space_of(views: Sequence[View], dataset: Path) -> FreeSpace:
    """What the photos say is free.

    Args:
        views: The photos trained on.
        dataset: Theirs, with the sparse points.

    Raises:
        StageError: if the dataset is broken.
    """
    points, tracks = load_points_and_tracks(dataset)
    cameras = [view.camera for view in views]
    return free_space(cameras, points.xyz, [tracks[camera.name] for camera in cameras])


class FloaterPruning(Technique):
    """Looks for Gaussians in free space now and then.

    Args:
        space: What is free.
        schedule: The training's.
    """

    name = "clearing"

    def __init__(self, space: FreeSpace, schedule: Schedule) -> None:
        self._space, self._schedule = space, schedule

    def is_due(self, iteration: int) -> bool:
        """Whether it looks after an iteration (from 1).

        Density control has its own beginning and end. Looking goes on after it: what is left fits the photos by
        hanging before the surface, most of all where they are few.
        """
        density = self._schedule.density
        due = iteration % (STEPS_BETWEEN * density.every) == 0 and iteration <= LAST_LOOK * self._schedule.iterations
        return density.on and due and density.first <= iteration

    def unwanted(self, gaussians: Gaussians, iteration: int) -> Bool[Tensor, " n"] | None:
        """Those that hang in free space; None where it does not look."""
        if not self.is_due(iteration):
            return None
        return near_or_free(gaussians, self._space, self._schedule.density.prune_free_space)
