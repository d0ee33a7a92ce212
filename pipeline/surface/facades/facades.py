"""The façades of a run: elevations of all detected walls, or of given ones, written into a folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import json_text, read_json
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.surface.depths.exposures import COMPARED_POINTS, exposure_levels
from splatpipe.pipeline.surface.depths.run_sources import RunSurface
from splatpipe.pipeline.surface.drawings.drawing_files import write_dxf_drawing, write_svg_drawing
from splatpipe.pipeline.surface.facades.elevation import Elevation, ElevationPhotos, draw_elevation
from splatpipe.pipeline.surface.facades.elevation_drawing import elevation_drawing
from splatpipe.pipeline.surface.facades.elevation_files import (
    elevation_facts,
    height_zero_m,
    write_depth,
    write_facades,
    write_picture,
)
from splatpipe.pipeline.surface.facades.facets import Facets, upright_facets
from splatpipe.pipeline.surface.facades.walls import Wall, find_walls, name_walls, stated_wall
from splatpipe.pipeline.surface.rasters.grid import DIGITS
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs, open_map

LIST = "facades.json"
ENDINGS = {"depth": ".tif", "picture": ".png", "dxf": ".dxf", "svg": ".svg"}
MAX_TEXT_LETTERS = 10_000  # characters of stated lines
Line = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class FacadesTask:
    """Inputs of façades.

    Attributes:
        surface: The run's photos and depths; walls whose middles lie outside of its area are not drawn.
        pixel_m: Pixel size of the elevations, metres; rounded to three digits.
        lines: Walls in plan, in the CRS's coordinates: left and right end, as seen from in front. If empty, walls are
            detected.
        threads: Tiles in parallel.
    """

    surface: RunSurface
    pixel_m: float
    lines: Sequence[Line]
    threads: int


def make_facades(task: FacadesTask, out: Path, report: Reporter) -> list[dict[str, Any]]:
    """Write the files of all façades, and `facades.json` at the end.

    A façade whose own JSON exists is not drawn again: its other files were written before it.

    Args:
        task: Inputs.
        out: Output folder; a killed call resumes from it.
        report: Receives progress.

    Returns:
        The entries of `facades.json`.

    Raises:
        SplatpipeError: if there is no wall along a given line, or a wall has too many pixels.
        MachineError, OSError: if the disk is full or not writable.
    """
    report.progress(0, 1, "looking for walls")
    crs, sources = open_map(task.surface.frame), task.surface.photos
    pixel_m = float(f"{task.pixel_m:.{DIGITS}g}")
    facets = upright_facets(task.surface.depths, task.threads)
    walls = stated_walls(task.lines, facets, crs) if task.lines else _within(find_walls(facets), task.surface.area)
    if not walls:
        report.progress(1, 1, "looking for walls")
        report.warning("No walls were found.", "Add photos that face them, or give walls by their end points.")
        write_facades(out / LIST, [], crs)
        return []
    places = facets.places[:: max(1, len(facets) // COMPARED_POINTS)]
    photos = ElevationPhotos(sources, exposure_levels(sources, places, 2.0 * pixel_m, task.threads), task.threads)
    facts = []
    for number, wall in enumerate(walls):

        def progress(done: int, total: int, number: int = number) -> None:
            report.progress(number + done / total, len(walls), "façades", "façades")

        own = out / f"{wall.name}.json"
        if not own.is_file():
            _write(out, draw_elevation(wall, pixel_m, photos, progress), crs)
        facts.append(read_json(own))
    write_facades(out / LIST, facts, crs)
    return facts


def _within(walls: Sequence[Wall], area: PlanArea | None) -> list[Wall]:
    """Walls whose middles lie in an area, renamed."""
    if area is None or not walls:
        return list(walls)
    middles = np.array([[*((wall.left + wall.right) / 2.0), wall.low_m] for wall in walls])
    return name_walls([wall for wall, inside in zip(walls, area.contains(middles), strict=True) if inside])


def parse_lines(text: str) -> list[Line]:
    """Parse walls in plan from ``x1,y1,x2,y2; …``.

    Raises:
        UsageError: if the text has another form.
    """
    if len(text) > MAX_TEXT_LETTERS:
        raise UsageError(f"{len(text):,} characters of lines are too many.", hint="Draw them in several runs.")
    lines: list[Line] = []
    for part in text.split(";") if text.strip() else ():
        try:
            x1, y1, x2, y2 = (float(number) for number in part.split(","))
        except ValueError:
            x1 = y1 = x2 = y2 = math.nan
        if not all(math.isfinite(number) for number in (x1, y1, x2, y2)):
            raise UsageError(f'Cannot understand the line "{part.strip()[:60]}".', hint="Write it as x1,y1,x2,y2.")
        lines.append((x1, y1, x2, y2))
    return lines


def stated_walls(lines: Sequence[Line], facets: Facets, crs: MapCrs) -> list[Wall]:
    """Walls along lines in plan.

    Args:
        lines: In the CRS's coordinates: left and right end, as seen from in front of the wall.
        facets: Facets of all photos.
        crs: CRS of the lines.

    Raises:
        SplatpipeError: if there is no wall along one of them.
    """
    middle = np.median(facets.places, axis=0) if len(facets) else np.zeros(3)
    height = float(crs.crs_from_local(middle[None])[0, 2])
    walls = []
    for x1, y1, x2, y2 in lines:
        ends = crs.local_from_crs(np.array([[x1, y1, height], [x2, y2, height]]))[:, :2]
        apart = float(np.linalg.norm(ends[1] - ends[0]))
        wall = stated_wall(ends[0], ends[1], facets) if np.isfinite(ends).all() and apart > 0.0 else None
        if wall is None:
            raise SplatpipeError(
                f"No wall seen by the photos lies along {x1:.10g},{y1:.10g},{x2:.10g},{y2:.10g}.",
                "Give its left end first, as seen from in front of it, in the run's CRS.",
            )
        walls.append(wall)
    return name_walls(walls)


def _write(folder: Path, elevation: Elevation, crs: MapCrs) -> None:
    name, zero_m = elevation.wall.name, height_zero_m(elevation, crs)
    files = {kind: name + ending for kind, ending in ENDINGS.items()}
    drawing = elevation_drawing(elevation, crs, zero_m, files["picture"])
    write_depth(folder / files["depth"], elevation, zero_m)
    write_picture(folder / files["picture"], elevation)
    write_dxf_drawing(folder / files["dxf"], drawing)
    write_svg_drawing(folder / files["svg"], drawing, elevation.colour, f"Façade {name}")
    write_durably(folder / f"{name}.json", json_text(elevation_facts(elevation, crs, files)))
