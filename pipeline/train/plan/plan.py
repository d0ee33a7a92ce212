"""The training plan: every schedule resolved, written once before training begins and reused on resume."""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.geometry.camera import Camera, reduced_size
from splatpipe.pipeline.photos.pixels.dataset import Split, View
from splatpipe.pipeline.render.rendering import Rendering
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import WINDOW_PIXELS, PhotoSizes, Stretch
from splatpipe.pipeline.train.plan.schedule import Schedule, resolve_schedule
from splatpipe.pipeline.train.plan.windows import TrainingSize

PLAN_FORMAT = 4
MAX_PLAN_BYTES = 64 << 20
EXTENT_MARGIN = 1.1  # extent over the cameras' radius, as in 3D Gaussian splatting's NeRF++ normalisation
NEAR_PER_EXTENT = 0.01  # 3DGS uses 0.2 world units at extents of about 5; drones see nothing that near


@dataclass(frozen=True)
class TrainingPlan:
    """A resolved training plan.

    Attributes:
        options: The configuration, including what a budget set.
        schedule: The schedule that follows from the options.
        extent: Radius of the camera positions, world units.
        near: Near plane, world units.
        train_views: Names of the photos trained on, sorted.
        test_views: Names of the held-out views, sorted.
        train_megapixels: Mean size of the training photos, as they are trained on in the end.
        initial_gaussians: Number of Gaussians at the start.
        megapixels: Photos are reduced to at most this size; None keeps the dataset's size.
        last_iteration: The training ends here at the latest. Iterations beyond the schedule, if any, fill a time
            budget: they use its final rates.
        train_seconds: The training ends after this time, done or not; 0 for no limit.
        forecast_seconds: Forecast of the training time; 0 if nothing was measured.
        sizes: Width, height and count of the dataset's training photos; empty if they do not matter.
        window_pixels: Most pixels of a photo that an iteration uses; 0 for the whole photo.
        ends_when_flat: Whether `stop_when_flat` may end the training itself, or only the sizes before the finest.
    """

    options: TrainConfig
    schedule: Schedule
    extent: float
    near: float
    train_views: tuple[str, ...]
    test_views: tuple[str, ...]
    train_megapixels: float
    initial_gaussians: int
    last_iteration: int
    megapixels: float | None = None
    train_seconds: float = 0.0
    forecast_seconds: float = 0.0
    sizes: tuple[tuple[int, int, int], ...] = ()
    window_pixels: int = 0
    ends_when_flat: bool = True

    def to_json(self) -> str:
        """The plan as canonical JSON."""
        fields = asdict(self) | {"format": PLAN_FORMAT, "options": self.options.model_dump(mode="json")}
        return json.dumps(fields, indent=1, sort_keys=True, ensure_ascii=False) + "\n"

    def rendering(self) -> Rendering:
        """How the model is to be rendered; a random background becomes black."""
        behind = self.schedule.background or (0.0, 0.0, 0.0)
        return Rendering(self.options.antialias, behind, self.near, self.megapixels)

    def figures(self) -> dict[str, JSON]:
        """Options and schedule as one flat table, for display."""
        schedule = asdict(self.schedule)
        parts = {f"{part}_{name}": value for part in ("rates", "density") for name, value in schedule.pop(part).items()}
        found = parts | self.options.model_dump(mode="json") | schedule
        sizes = [f"{size} until {stretch.until:,}" for size, stretch in zip(*self._size_labels(), strict=True)]
        return found | {"initial_gaussians": self.initial_gaussians, "stretches": "; ".join(sizes)}

    def digest(self) -> str:
        """SHA-256 of ``to_json``: identifies the plan in its checkpoints."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    def of(self, options: TrainConfig) -> TrainingPlan:
        """The same training with other options and everything that follows from them."""
        sizes = self.sizes or ((1, 1, len(self.train_views)),)
        limit = options.max_megapixels or None
        largest = max(width * height for width, height, _count in sizes)
        limit = None if limit is None or largest <= 1e6 * limit else limit
        footage = footage_of(sizes, limit, self.window_pixels)
        schedule = resolve_schedule(options, footage)
        return replace(
            self,
            options=options,
            schedule=schedule,
            last_iteration=schedule.iterations,
            megapixels=limit,
            train_megapixels=round(1e-6 * footage.pixels(TrainingSize(schedule.finest.level)), 4),
        )

    def within_windows(self, pixels: int) -> TrainingPlan:
        """The same training with windows of at most ``pixels`` pixels."""
        return replace(self, window_pixels=pixels).of(self.options)

    def after(self, sizes_ended: Sequence[int]) -> TrainingPlan:
        """The plan after sizes ended early: the finest size gets the time they saved, counted in pixels.

        Args:
            sizes_ended: Iterations after which sizes ended early, from the history.
        """
        schedule, footage = self.schedule, self.footage
        for iteration in sizes_ended:
            pixels = footage.pixels(schedule.training_size_at(iteration))
            schedule = schedule.without_rest(iteration, min(1.0, pixels / footage.pixels(schedule.finest)))
        spared = self.schedule.iterations - schedule.iterations
        return replace(self, schedule=schedule, last_iteration=self.last_iteration - spared) if sizes_ended else self

    @property
    def footage(self) -> PhotoSizes:
        """The photos at their training sizes."""
        return footage_of(self.sizes or ((1, 1, len(self.train_views)),), self.megapixels, self.window_pixels)

    def _size_labels(self) -> tuple[list[str], tuple[Stretch, ...]]:
        stretches, footage = self.schedule.stretches, self.footage
        whole = [1e-6 * footage.pixels(TrainingSize(stretch.level)) for stretch in stretches]
        windows = [" in windows" if stretch.window_pixels else "" for stretch in stretches]
        return [f"{size:.2f} MP{window}" for size, window in zip(whole, windows, strict=True)], stretches

    def described(self) -> str:
        """The plan as one readable line."""
        options = self.options
        parts = [
            self._size_text(),
            f"up to {options.max_gaussians:,} Gaussians",
            f"{self.schedule.iterations:,} iterations",
        ]
        if options.time_budget_s:
            takes = min(self.forecast_seconds, self.train_seconds)
            parts.append(f"about {duration(takes)} of the {duration(options.time_budget_s)} budget")
        if options.max_memory_bytes:
            parts.append(f"within {options.max_memory_bytes / 1e9:.1f} GB")
        return "plan: " + ", ".join(parts)

    def _size_text(self) -> str:
        """The photos' size, from first to last, and that of the windows."""
        footage, finest = self.footage, self.schedule.finest
        first = 1e-6 * footage.pixels(TrainingSize(self.schedule.stretches[0].level))
        text = f"{self.train_megapixels:.2f} MP"
        if len(self.schedule.stretches) > 1:
            text = f"{first:.2f} to {text}"
        if finest.window_pixels:
            text += f" in windows of {1e-6 * footage.pixels(finest):.2f} MP"
        return text

    @staticmethod
    def from_json(text: str) -> TrainingPlan:
        """Read ``to_json``'s text back.

        Raises:
            ValueError: if it is not a plan of this format.
        """
        fields = json.loads(text)
        if not isinstance(fields, dict) or fields.pop("format", None) != PLAN_FORMAT:
            raise ValueError("not a plan of this version")
        try:
            fields["options"] = TrainConfig.model_validate(fields["options"])
            fields["schedule"] = Schedule.from_json(fields["schedule"])
            fields["sizes"] = tuple(tuple(size) for size in fields["sizes"])
            fields["train_views"] = tuple(fields["train_views"])
            fields["test_views"] = tuple(fields["test_views"])
            return TrainingPlan(**fields)
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a plan: {error}") from error


def duration(seconds: float) -> str:
    """Seconds as readable text: `45 s`, `6 min 40 s`, `2 h 05 min`."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes == 0:
        return f"{rest} s"
    if minutes < 60:
        return f"{minutes} min {rest:02d} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes % 60 else f"{minutes // 60} h"


def scene_extent(cameras: Sequence[Camera]) -> float:
    """1.1 times the largest distance of a camera from the mean camera position, world units."""
    centres = np.array([camera.centre() for camera in cameras])
    radius = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    return EXTENT_MARGIN * radius


def sizes_of(cameras: Sequence[Camera]) -> tuple[tuple[int, int, int], ...]:
    """Width, height and count of photos of each size, sorted."""
    count_by_size = Counter((camera.width, camera.height) for camera in cameras)
    return tuple((*size, count_by_size[size]) for size in sorted(count_by_size))


def footage_of(sizes: Sequence[tuple[int, int, int]], most: float | None, window_pixels: int) -> PhotoSizes:
    """Photos at their training sizes.

    Args:
        sizes: Width and height in the dataset, and the count of photos of that size.
        most: Photos are reduced to at most this many megapixels; None keeps the dataset's size.
        window_pixels: Most pixels of a photo that an iteration uses; 0 for the whole photo.
    """
    if most is None:
        return PhotoSizes(tuple(sizes), window_pixels)
    reduced = tuple((*reduced_size(width, height, most), count) for width, height, count in sizes)
    return PhotoSizes(reduced, window_pixels)


def make_plan(
    config: TrainConfig, views: Sequence[View], split: Split, gaussians: int, window_pixels: int = WINDOW_PIXELS["cpu"]
) -> TrainingPlan:
    """Resolve the plan of a training.

    Args:
        config: The training options.
        views: All photos of the dataset.
        split: Which photos are trained on.
        gaussians: Number of Gaussians at the start.
        window_pixels: Most pixels of a photo that an iteration uses; 0 for the whole photo.

    Raises:
        SplatpipeError: if all cameras are at one position.
    """
    kept = set(split.train)
    cameras = [view.camera for view in views if view.camera.name in kept]
    extent = scene_extent(cameras)
    if not math.isfinite(extent) or extent <= 0.0:
        raise SplatpipeError(
            f"All {len(cameras)} cameras are at one position, so the scene's extent is undefined.",
            hint="Take photos from different positions, and hold out fewer of them.",
        )
    plan = TrainingPlan(
        options=config,
        schedule=resolve_schedule(config),
        extent=extent,
        near=NEAR_PER_EXTENT * extent,
        train_views=split.train,
        test_views=split.held_out,
        train_megapixels=0.0,
        initial_gaussians=gaussians,
        last_iteration=0,
        sizes=sizes_of(cameras),
        window_pixels=window_pixels,
    )
    return plan.of(config)


def load_or_write_plan(path: Path, make: Callable[[], TrainingPlan]) -> TrainingPlan:
    """The plan already at ``path``, or a new one, written there before anything is trained.

    The folder belongs to one key of configuration and inputs, so a plan found in it belongs to this training.

    Args:
        path: Path of the plan.
        make: Makes a plan; called only if there is none, because it may take measurements for a while.
    """
    try:
        return TrainingPlan.from_json(read_small(path, MAX_PLAN_BYTES).decode("utf-8"))
    except (OSError, ValueError):
        fresh = make()
        write_durably(path, fresh.to_json())
        return fresh
