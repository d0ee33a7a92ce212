"""The plan of a training: every schedule resolved, written once before it begins and taken as it is on resume."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.durable import write_durably
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import Split, View
from splatpipe.pipeline.render.rendering import Rendering
from splatpipe.pipeline.train.options import TrainConfig

PLAN_FORMAT = 2
EXTENT_MARGIN = 1.1  # of 3D Gaussian splatting's NeRF++ normalisation
NEAR_PER_EXTENT = 0.01  # 3DGS has 0.2 world units at extents of about 5; drones see nothing that near
PUBLISHED_RUN = 30_000  # iterations that the published lengths and rates are for
LARGEST_BOOST = 4.0  # of learning rates: measured best at 1,500 iterations, and beyond it Gaussians overshoot
FEW_PHOTOS, MANY_PHOTOS = 16, 32  # trained on: up to where a model leans on single photos, from where it does not
FEW_DROPOUT = 0.2
SHORT_RUN = 10_000  # iterations below which an opacity reset costs more than it brings


@dataclass(frozen=True)
class _Defaults:
    """What `auto` means for a strategy of density control.

    Attributes:
        gradient: Score above which Gaussians are densified.
        until: Last step, as a share of the run.
        resets: Whether opacities are reset.
    """

    gradient: float
    until: float = 0.5
    resets: bool = True


DENSITY_DEFAULTS = {
    "published": _Defaults(2e-4),
    "absolute": _Defaults(1.2e-3),
    "mcmc": _Defaults(1.0, until=25 / 30, resets=False),  # it has no score
}


@dataclass(frozen=True)
class Plan:
    """What a training does, resolved.

    Attributes:
        options: The configuration with every `auto` replaced by a number.
        extent: Radius of the cameras, world units.
        near: Near plane, world units.
        train_views: Names of the photos trained on, sorted.
        test_views: Names of those held out, sorted.
        train_megapixels: Mean size of the training photos, as they are trained on.
        initial_gaussians: Gaussians at the start.
        megapixels: Photos are reduced to at most so many; None where they keep the dataset's size.
        last_iteration: The training ends here at the latest. Iterations after ``options.iterations``, if any, fill a
            time budget: they are computed with the schedule's last rates.
        train_seconds: The training ends after so many, done or not; 0 for when it is done.
        forecast_seconds: When it should be done; 0 where nothing was measured.
    """

    options: TrainConfig
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

    def to_json(self) -> str:
        """The plan as canonical JSON."""
        fields = asdict(self) | {"format": PLAN_FORMAT, "options": self.options.model_dump(mode="json")}
        return json.dumps(fields, indent=1, sort_keys=True, ensure_ascii=False) + "\n"

    def rendering(self) -> Rendering:
        """How the model is to be rendered: a random background is black."""
        white = self.options.background == "white"
        behind = (1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0)
        return Rendering(self.options.antialias, behind, self.near, self.megapixels)

    def digest(self) -> str:
        """sha256 of ``to_json``: names the plan in its checkpoints."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    def described(self) -> str:
        """The plan in a line for people."""
        options = self.options
        parts = [
            f"{self.train_megapixels:.2f} MP",
            f"up to {options.max_gaussians:,} Gaussians",
            f"{options.iterations:,} iterations",
        ]
        if options.time_budget_s:
            takes = min(self.forecast_seconds, self.train_seconds)
            parts.append(f"about {duration(takes)} of the {duration(options.time_budget_s)} budget")
        if options.max_memory_bytes:
            parts.append(f"within {options.max_memory_bytes / 1e9:.1f} GB")
        return "plan: " + ", ".join(parts)

    @staticmethod
    def from_json(text: str) -> Plan:
        """Read ``to_json``'s text back.

        Raises:
            ValueError: if it is no plan of this format.
        """
        fields = json.loads(text)
        if not isinstance(fields, dict) or fields.pop("format", None) != PLAN_FORMAT:
            raise ValueError("not a plan of this version")
        try:
            fields["options"] = TrainConfig.model_validate(fields["options"])
            fields["train_views"] = tuple(fields["train_views"])
            fields["test_views"] = tuple(fields["test_views"])
            return Plan(**fields)
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a plan: {error}") from error


def duration(seconds: float) -> str:
    """Seconds for people: `45 s`, `6 min 40 s`, `2 h 05 min`."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes == 0:
        return f"{rest} s"
    if minutes < 60:
        return f"{minutes} min {rest:02d} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes % 60 else f"{minutes // 60} h"


def share_of_few(photos: int) -> float:
    """How much of what few photos need a training takes: all of it up to FEW_PHOTOS, nothing from MANY_PHOTOS on."""
    return min(1.0, max(0.0, (MANY_PHOTOS - photos) / (MANY_PHOTOS - FEW_PHOTOS)))


def resolve_schedule(config: TrainConfig, photos: int = MANY_PHOTOS) -> TrainConfig:
    """Replace every `auto` by the published value, changed for short runs and few photos as the option's text says.

    Args:
        config: The options.
        photos: That are trained on.
    """
    run, strategy = config.iterations, DENSITY_DEFAULTS[config.density]
    until = config.densify_until if config.densify_until != "auto" else int(run * strategy.until)
    auto = {
        "sh_every": max(1, min(1000, run // 5)),
        "densify_from": max(1, min(500, run // 5)),
        "densify_until": max(1, until),
        "densify_every": max(1, min(100, run // 10)),
        "reset_every": 3000 if run >= SHORT_RUN and strategy.resets else 0,
        "densify_gradient": strategy.gradient,
        "coarse_until": until,
        "dropout": round(FEW_DROPOUT * share_of_few(photos), 4),
        "lr_boost": round(min(LARGEST_BOOST, max(1.0, math.sqrt(PUBLISHED_RUN / run))), 4),
    }
    resolved = {name: value for name, value in auto.items() if getattr(config, name) == "auto"}
    return config.model_copy(update=resolved)


def scene_extent(cameras: Sequence[Camera]) -> float:
    """1.1 times the largest distance of a camera from the cameras' mean, world units."""
    centres = np.array([camera.centre() for camera in cameras])
    radius = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    return EXTENT_MARGIN * radius


def mean_megapixels(cameras: Sequence[Camera], most: float | None = None) -> float:
    """Mean size of photos when each is reduced to at most ``most`` megapixels."""
    pixels = [camera.width * camera.height / 1e6 for camera in cameras]
    return round(sum(min(size, most or size) for size in pixels) / len(pixels), 4)


def make_plan(config: TrainConfig, views: Sequence[View], split: Split, gaussians: int) -> Plan:
    """Resolve a training's plan.

    Args:
        config: The options.
        views: All photos of the dataset.
        split: Which of them are trained on.
        gaussians: Gaussians at the start.

    Raises:
        SplatpipeError: if all cameras stand in one place.
    """
    kept = set(split.train)
    cameras = [view.camera for view in views if view.camera.name in kept]
    extent = scene_extent(cameras)
    if not math.isfinite(extent) or extent <= 0.0:
        raise SplatpipeError(
            f"All {len(cameras)} cameras stand in one place, so the scene has no size.",
            hint="Take the photos from different places, and hold out fewer of them.",
        )
    return Plan(
        options=resolve_schedule(config, len(split.train)),
        extent=extent,
        near=NEAR_PER_EXTENT * extent,
        train_views=split.train,
        test_views=split.held_out,
        train_megapixels=mean_megapixels(cameras),
        initial_gaussians=gaussians,
        last_iteration=config.iterations,
    )


def load_or_write_plan(path: Path, make: Callable[[], Plan]) -> Plan:
    """The plan already at ``path``, or a new one, written there before anything is trained.

    The folder belongs to one key of configuration and inputs, so a plan in it is of this training.

    Args:
        path: Where the plan is.
        make: Makes one; called only where there is none, for it may measure for a while.
    """
    try:
        return Plan.from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        fresh = make()
        write_durably(path, fresh.to_json())
        return fresh


def coarse_level_at(options: TrainConfig, iteration: int) -> int:
    """How often an iteration's photo (from 1) is halved: equal shares of ``coarse_until``, coarsest first.

    Args:
        options: Resolved.
        iteration: From 1.
    """
    until = int(options.coarse_until)
    return options.coarse_levels - (iteration - 1) * options.coarse_levels // until if iteration <= until else 0


def coarse_levels(options: TrainConfig, last: int | None = None) -> list[int]:
    """``coarse_level_at`` for every iteration.

    Args:
        options: Resolved.
        last: The last iteration; that of the schedule without it.
    """
    return [coarse_level_at(options, iteration) for iteration in range(1, (last or options.iterations) + 1)]


def means_rate(plan: Plan, iteration: int) -> float:
    """Learning rate of the positions at an iteration (from 1), world units: exponential from start to end."""
    share = min(1.0, iteration / plan.options.iterations)
    boost = float(plan.options.lr_boost)
    first, last = boost * plan.options.lr_means, boost * boost * plan.options.lr_means_final
    return plan.extent * math.exp(math.log(first) * (1.0 - share) + math.log(last) * share)


def sh_degree_at(options: TrainConfig, iteration: int) -> int:
    """The degree trained at an iteration (from 1): one more every ``sh_every``."""
    return min(options.sh_degree, iteration // int(options.sh_every))
