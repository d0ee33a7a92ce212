"""Control data from the stages before georef: points without their marks, scale bars, targets detected in photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json
from splatpipe.pipeline.survey.files.scale_bars import ScaleBar

QUADRANT = "quadrant"


@dataclass(frozen=True)
class TargetFind:
    """A target in a photo.

    Attributes:
        photo: Its name.
        kind: ``quadrant``, or the dictionary of a coded one.
        number: Its id; None for a quadrant target.
        x: Of its centre, pixels of the stored grid; (0, 0) is the top-left corner of the first pixel.
        y: Likewise.
        size_px: The square root of its area.
        sigma_px: Standard deviation of x and y.
    """

    photo: str
    kind: str
    number: int | None
    x: float
    y: float
    size_px: float
    sigma_px: float


@dataclass(frozen=True)
class WantedTargets:
    """The points and scale bars whose targets are to be detected.

    Attributes:
        crs: Of the points; empty where there are none.
        points: Name, x, y, z (None where not measured) of control points.
        bars: Scale bars.
    """

    crs: str
    points: tuple[tuple[str, float, float, float | None], ...]
    bars: tuple[ScaleBar, ...]

    def __bool__(self) -> bool:
        return bool(self.points or self.bars)


def save_wanted(wanted: WantedTargets, path: Path) -> None:
    """Write ``points.json``; its bytes depend only on points and bars, not on marks."""
    bars = [asdict(bar) for bar in wanted.bars]
    write_json(path, {"crs": wanted.crs, "points": [list(point) for point in wanted.points], "bars": bars})


def load_wanted(path: Path) -> WantedTargets:
    """Read ``points.json``.

    Raises:
        SplatpipeError: if it is missing or broken.
    """
    try:
        value: Mapping[str, Any] = read_json(path)
        points = tuple((str(n), float(x), float(y), None if z is None else float(z)) for n, x, y, z in value["points"])
        return WantedTargets(str(value["crs"]), points, tuple(ScaleBar(**bar) for bar in value["bars"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatpipeError(f"The points {path} cannot be read: {error}", "Run with --rerun control.") from error


def save_finds(finds: Sequence[TargetFind], path: Path) -> None:
    """Write ``targets.json``."""
    write_json(path, {"targets": [asdict(find) for find in finds]})


def load_finds(path: Path) -> tuple[TargetFind, ...]:
    """Read ``targets.json``.

    Raises:
        SplatpipeError: if it is missing or broken.
    """
    try:
        return tuple(TargetFind(**find) for find in read_json(path)["targets"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatpipeError(f"The targets {path} cannot be read: {error}", "Run with --rerun targets.") from error
