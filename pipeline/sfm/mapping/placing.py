"""Place photos with COLMAP's incremental mapper, stopped wherever an adjustment of our own does the same for less.

When no photo is left, COLMAP adjusts everything twice, although all matches are added and adjusted next; and it adjusts
more than 1,000 photos by iterating, several times as slowly as by factorizing. So it is stopped as soon as every photo
has a pose, and with more photos than that also whenever they have grown by half. Each time the model is adjusted here.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import pycolmap

from splatpipe.pipeline.sfm.mapping.completion import Progress, settle

Model: TypeAlias = pycolmap.Reconstruction

GROWTH = 1.5  # of photos or points between global adjustments; COLMAP's 1.1 makes four times as many
MAX_FACTORIZED = 1000  # photos that COLMAP's mapper adjusts by factorizing
NEVER = 10**9


class Placement:
    """The placing of a database's photos, in one model or several.

    Args:
        settings: The mapper's options; changed.
        stop: Cancelled by ``cancel``.
        on_progress: Called after each placed photo.
    """

    def __init__(
        self, settings: pycolmap.IncrementalPipelineOptions, stop: pycolmap.CancellationToken, on_progress: Progress
    ) -> None:
        self._settings, self._stop, self._on_progress = settings, stop, on_progress
        self._leg = pycolmap.CancellationToken()
        self._total = self._goal = 0  # photos
        self._models = self._placed = 0  # begun in this leg; photos in the latest
        self._goes_on = False

    def cancel(self) -> None:
        """End ``run`` early, from any thread."""
        self._stop.cancel()
        self._leg.cancel()

    def run(self, database: Path, total: int, folder: Path) -> list[Model]:
        """Place the photos, on one thread.

        Args:
            database: Cameras, images, keypoints and verified two-view geometries; only read.
            total: Photos that can be placed.
            folder: An existing folder for temporary files.

        Returns:
            The models, in no order.

        Raises:
            InterruptedError: If it was cancelled.
        """
        self._total, self._goal = total, min(total, MAX_FACTORIZED)
        found = self._map(database, folder, None)
        before = 0
        while self._leg.is_cancelled and len(found) == 1:
            settle(found[0], database, self._settings, self._stop)
            # The mapper may have dropped photos after they were counted, as an adjustment may: they are tried again.
            self._placed = found[0].num_reg_images()
            if self._placed >= total or self._placed <= before:
                break
            before, self._goal = self._placed, min(total, int(GROWTH * self._placed))
            found = self._map(database, folder, found[0])
        return found

    def _map(self, database: Path, folder: Path, known: Model | None) -> list[Model]:
        """Place photos until the goal is reached or no other can be placed; go on from a known model if there is one.

        Returns:
            The models; ``_leg`` is cancelled if the goal was reached.
        """
        self._leg, self._models, self._goes_on = pycolmap.CancellationToken(), 0, known is not None
        if self._stop.is_cancelled:
            self._leg.cancel()
        before, after = folder / "before", folder / "after"
        for each in (before, after):
            shutil.rmtree(each, ignore_errors=True)
            each.mkdir()
        if known is not None:
            known.write(before)
            self._settings.ba_global_frames_ratio = self._settings.ba_global_points_ratio = NEVER
            self._settings.ba_global_frames_freq = self._settings.ba_global_points_freq = NEVER
        try:
            found: Mapping[int, Model] = pycolmap.incremental_mapping(
                database,
                folder,
                after,
                self._settings,
                input_path="" if known is None else before,
                initial_image_pair_callback=self._begin,
                next_image_callback=self._count,
                cancellation_token=self._leg,
            )
        except InterruptedError:
            if self._stop.is_cancelled:
                raise
            # COLMAP has written the models: new ones into numbered folders, one that it went on with into the upper.
            return [Model(each) for each in (sorted(after.iterdir()) if known is None else [after])]
        return list(found.values())

    def _begin(self) -> None:
        """Count the first two photos of a model; COLMAP also calls this for one that it goes on with."""
        self._models += 1
        if self._models > 1 or not self._goes_on:
            self._placed = 1
            self._count()

    def _count(self) -> None:
        self._placed += 1
        what = "placing photos" if self._models < 2 else f"placing photos (model {self._models})"
        self._on_progress(min(self._placed, self._total), self._total, what, "photos")
        if self._placed >= (self._goal if self._models < 2 else self._total):
            self._leg.cancel()
