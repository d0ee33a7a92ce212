"""Parses edit steps from a command line, in order, and checks them before anything is opened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from splatpipe.pipeline.edit.clean import Clean
from splatpipe.pipeline.edit.crops import CropBox, CropHeights, CropPolygon
from splatpipe.pipeline.edit.editing import Step
from splatpipe.pipeline.edit.merge import Merge
from splatpipe.pipeline.edit.motions import Move, MoveTo, Pivot, Rotate, ScaleBy, ScaleFrom
from splatpipe.pipeline.edit.size import OutputFile, Reduce
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.geometry.camera import Camera

MAX_STEPS = 100


def parse_steps(
    given: Sequence[tuple[str, Any]], output: OutputFile, local: bool, cameras: Sequence[Camera] = ()
) -> list[Step]:
    """Convert command-line options to steps.

    Args:
        given: Option names (`crop_box`) with the user's values, in order.
        output: The file to write: `reduce` may depend on its size.
        local: Coordinates are metres from the splat's origin, not in its CRS.
        cameras: Cameras of the training photos, in the splat's frame as read, z up; empty if unknown.

    Raises:
        UsageError: if one is invalid, or there are too many.
    """
    if len(given) > MAX_STEPS:
        raise UsageError(
            f"{len(given)} steps are too many.", hint=f"At most {MAX_STEPS}; apply the rest to the edited file."
        )
    pivot = Pivot(None, local)
    steps: list[Step] = []
    for name, value in given:
        option = f"--{name.replace('_', '-')}"
        if name == "about":
            pivot = Pivot.parse(value, option, local)
            continue
        steps.append(Clean(cameras) if name == "clean" else _PARSERS[name](value, option, pivot, output))
    return steps


def _polygon(value: Path, option: str, local: bool, inside: bool) -> CropPolygon:
    if not value.is_file():
        raise UsageError(f"There is no file {value}.", hint=f"Give {option} a GeoJSON file of polygons.")
    return CropPolygon(value, local, inside)


_PARSERS: dict[str, Callable[[Any, str, Pivot, OutputFile], Step]] = {
    "crop_box": lambda value, option, pivot, _: CropBox.parse(value, option, pivot.local, True),
    "cut_box": lambda value, option, pivot, _: CropBox.parse(value, option, pivot.local, False),
    "crop_polygon": lambda value, option, pivot, _: _polygon(value, option, pivot.local, True),
    "cut_polygon": lambda value, option, pivot, _: _polygon(value, option, pivot.local, False),
    "crop_heights": lambda value, option, pivot, _: CropHeights.parse(value, option, pivot.local),
    "move": lambda value, option, _, __: Move.parse(value, option),
    "move_to": lambda value, option, pivot, _: MoveTo.parse(value, option, pivot, pivot.local),
    "rotate": lambda value, option, pivot, _: Rotate.parse(value, option, pivot),
    "scale": lambda value, option, pivot, _: ScaleBy.parse(value, option, pivot),
    "scale_from": lambda value, option, pivot, _: ScaleFrom.parse(value, option, pivot.local),
    "merge": lambda value, _, __, ___: Merge(value),
    "reduce": lambda value, option, _, output: Reduce.parse(value, option, output),
}
