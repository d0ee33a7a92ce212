"""Floater pruning: remove Gaussians in free space or directly in front of a camera during training.

The published trainer only has opacity resets against floaters. A place through which photos see sparse points is
stronger evidence: `splat.quality.free_space` has the test, here with training photos only, never held-out ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from splatpipe.pipeline.photos.pixels.dataset import View, load_points_and_tracks
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality.free_space import FreeSpace, free_space, near_or_free
from splatpipe.pipeline.train.hooks import Technique
from splatpipe.pipeline.train.plan.schedule import Schedule

STEPS_BETWEEN = 5  # steps of density control between checks: a check takes as long as several iterations
LAST_CHECK_SHARE = 0.9  # share of the run after which no floaters are pruned: the rest closes the holes


def free_space_of(views: Sequence[View], dataset: Path) -> FreeSpace:
    """The free space seen by the photos.

    Args:
        views: The training photos.
        dataset: Their dataset, with the sparse points.

    Raises:
        StageError: if the dataset is broken.
    """
    points, tracks = load_points_and_tracks(dataset)
    cameras = [view.camera for view in views]
    return free_space(cameras, points.xyz, [tracks[camera.name] for camera in cameras])


class FloaterPruning(Technique):
    """Removes Gaussians in free space from time to time.

    Args:
        space: The free space.
        schedule: The training schedule.
    """

    name = "clearing"

    def __init__(self, space: FreeSpace, schedule: Schedule) -> None:
        self._space, self._schedule = space, schedule

    def is_due(self, iteration: int) -> bool:
        """Whether floaters are pruned after an iteration (from 1).

        Pruning begins with density control but continues after its end: later floaters fit the photos by hanging in
        front of the surface, above all where there are few photos.
        """
        density = self._schedule.density
        due = (
            iteration % (STEPS_BETWEEN * density.every) == 0
            and iteration <= LAST_CHECK_SHARE * self._schedule.iterations
        )
        return density.on and due and density.first <= iteration

    def prune_mask(self, gaussians: Gaussians, iteration: int) -> Bool[Tensor, " n"] | None:
        """Gaussians in free space; None if it is not time to check."""
        if not self.is_due(iteration):
            return None
        return near_or_free(gaussians, self._space, self._schedule.density.prune_free_space)
