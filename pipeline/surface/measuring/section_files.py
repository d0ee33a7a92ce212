"""Files of sections: CSV for calculations, DXF at true size, PNG for viewing."""

from __future__ import annotations

import csv
import math
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.surface.drawings.drawing import (
    GRID,
    GROUND,
    POINTS,
    SURFACE,
    Dots,
    Drawing,
    Label,
    Stroke,
    caption,
    plot_scale,
    scale_bar,
)
from splatpipe.pipeline.surface.drawings.drawing_files import write_dxf_drawing
from splatpipe.pipeline.surface.drawings.drawing_picture import write_png_drawing
from splatpipe.pipeline.surface.measuring.sections import Section
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs, unit_name

UNIT_KEYS = {"metre": "m", "foot": "ft", "US survey foot": "us_ft"}
DIGITS = 4  # decimals of lengths and coordinates in metres: a tenth of a millimetre
GRID_STEPS_M = tuple(base * 10.0**power for power in range(-1, 4) for base in (1.0, 2.0, 5.0))
GRID_MM = 20.0  # between a section's grid lines on paper, at least
LABEL_MM = 2.0  # from the grid to its lengths and heights


def write_section(folder: Path, name: str, section: Section, crs: MapCrs) -> dict[str, Any]:
    """Write all files of a section.

    Args:
        folder: Output folder.
        name: Base name of the files.
        section: The section.
        crs: CRS of its coordinates.

    Returns:
        Its facts: ``name``, ``line``, ``length_m``, ``share_with_height``, ``height_sigma_m`` (the median; None if
        unknown), ``points``, and its files.

    Raises:
        OSError: if the disk is full or not writable.
    """
    files = {"csv": f"{name}.csv", "dxf": f"{name}.dxf", "picture": f"{name}.png"}
    _write_heights(folder / files["csv"], section, crs)
    if len(section.points):
        files["points_csv"] = f"{name}_points.csv"
        _write_points(folder / files["points_csv"], section)
    drawing = section_drawing(name, section, crs)
    write_dxf_drawing(folder / files["dxf"], drawing)
    write_png_drawing(folder / files["picture"], drawing)
    known = np.isfinite(section.height)
    sigma_m = section.sigma_m[known & np.isfinite(section.sigma_m)]
    return {
        "name": name,
        "line": [round(float(number), DIGITS) for number in section.line],
        "length_m": round(section.length_m, DIGITS),
        "share_with_height": round(float(known.mean()), DIGITS),
        "height_sigma_m": round(float(np.median(sigma_m)), DIGITS) if len(sigma_m) else None,
        "points": len(section.points),
        **files,
    }


def unit_key(unit_m: float) -> str:
    """A unit of length as the suffix of a column's name."""
    return UNIT_KEYS.get(unit_name(unit_m), f"{unit_m:.6g}m")


def section_drawing(name: str, section: Section, crs: MapCrs) -> Drawing:
    """Draw a section at true size: distances to the right, heights up, metres.

    Args:
        name: Name in the title.
        section: The section.
        crs: CRS of its coordinates.
    """
    lines_up = {SURFACE: section.height * crs.height_unit_m}
    if section.ground is not None:
        lines_up[GROUND] = section.ground * crs.height_unit_m
    every = np.concatenate([*lines_up.values(), section.points[:, 1]])
    heights = every[np.isfinite(every)]
    low, high = float(heights.min()), float(heights.max())
    scale = plot_scale(section.length_m, high - low)
    step = next((metres for metres in GRID_STEPS_M if metres * 1000.0 / scale >= GRID_MM), GRID_STEPS_M[-1])
    bottom, top = math.floor(low / step) * step, math.ceil(high / step) * step
    top = max(top, bottom + step)
    lines, numbers = _grid(section.length_m, (bottom, top), step, scale)
    profile = [
        Stroke(layer, line)
        for layer, up in reversed(lines_up.items())  # the surface over the ground
        for line in _unbroken(np.stack([section.distance_m, up], axis=1))
    ]
    bar, lengths = scale_bar(section.length_m, bottom - 3.0 * LABEL_MM * scale / 1000.0, scale)
    x1, y1, x2, y2 = section.line
    about = [
        f"1:{scale} on A3, {section.length_m:.2f} m from {x1:.3f}, {y1:.3f} to {x2:.3f}, {y2:.3f}",
        f"Heights: {crs.described_heights().rpartition(',')[0]}, metres. {crs.horizontal.name}",
    ]
    if section.ground is not None:
        about.append("Black: topmost surface. Brown: ground. Blue: what photos see near the plane.")
    title = caption(name.replace("-", " ").capitalize(), about, 0.0, bottom - 3.0 * LABEL_MM * scale / 1000.0, scale)
    dots = Dots(POINTS, section.points) if len(section.points) else None
    return Drawing(scale, [*lines, *bar, *profile], [*numbers, *lengths, *title], dots=dots)


def _grid(length_m: float, heights: tuple[float, float], step: float, scale: int) -> tuple[list[Stroke], list[Label]]:
    bottom, top = heights
    away = LABEL_MM * scale / 1000.0
    strokes, labels = [], []
    for height in bottom + np.arange(round((top - bottom) / step) + 1) * step:
        strokes.append(Stroke(GRID, np.array([[0.0, height], [length_m, height]])))
        labels.append(Label(f"{height:.10g}", -away, float(height) - away / 2.0, anchor="end"))
    for distance in [*(np.arange(math.floor(length_m / step) + 1) * step).tolist()]:
        strokes.append(Stroke(GRID, np.array([[distance, bottom], [distance, top]])))
        labels.append(Label(f"{distance:.10g}", distance, bottom - 2.0 * away, anchor="middle"))
    return strokes, labels


def _unbroken(line: Float64[np.ndarray, "n 2"]) -> list[Float64[np.ndarray, "k 2"]]:
    """Parts of a line between gaps, without collinear points."""
    known = np.isfinite(line[:, 1])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [line[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]


def _write_heights(path: Path, section: Section, crs: MapCrs) -> None:
    plan, height = unit_key(crs.unit_m), unit_key(crs.height_unit_m)
    header = ["distance_m", f"easting_{plan}", f"northing_{plan}", f"height_{height}", "height_sigma_m"]
    columns = [section.distance_m, *section.place.T, section.height, section.sigma_m]
    if section.ground is not None:
        header += [f"ground_{height}", f"over_ground_{height}"]
        columns += [section.ground, np.maximum(section.height - section.ground, 0.0)]
    _write_table(path, header, np.stack(columns, axis=1))


def _write_points(path: Path, section: Section) -> None:
    _write_table(path, ["distance_m", "height_m"], section.points)


def _write_table(path: Path, header: list[str], table: Float64[np.ndarray, "n k"]) -> None:
    """Write numbers as CSV with a header row; unknown values are empty."""
    with whole_file(path) as aside, TextIOWrapper(new_file(aside), "utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{v:.{DIGITS}f}" if math.isfinite(v) else "" for v in row] for row in table.tolist())
