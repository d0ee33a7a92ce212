"""The drawing of an elevation: the image at true size, outlines, level marks, a title and a scale bar."""

from __future__ import annotations

import numpy as np

from splatpipe.pipeline.surface.drawings.drawing import (
    EXTENT,
    GAP_MM,
    OPENINGS,
    OUTLINE,
    PROJECTIONS,
    Drawing,
    DrawingPicture,
    Label,
    Stroke,
    caption,
    plot_scale,
    rectangle,
    scale_bar,
)
from splatpipe.pipeline.surface.facades.elevation import Elevation
from splatpipe.pipeline.surface.facades.openings import outlines, projections, recesses
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs

TICK_MM = 4.0  # length of a level's mark on paper


def elevation_drawing(elevation: Elevation, crs: MapCrs, zero_m: float, picture: str) -> Drawing:
    """Draw an elevation: x from the wall's left end, y the height in the CRS's datum, metres.

    Args:
        elevation: The elevation.
        crs: CRS with the vertical datum.
        zero_m: Result of ``height_zero_m``.
        picture: Name of the image file.
    """
    wall, plane = elevation.wall, elevation.plane
    lattice = plane.lattice
    low, high = wall.low_m + zero_m, wall.high_m + zero_m
    width_m, height_m = lattice.width * lattice.cell_m, lattice.height * lattice.cell_m
    scale = plot_scale(width_m, height_m)
    strokes = [Stroke(EXTENT, rectangle(0.0, low, wall.length_m, high), closed=True)]
    for layer, rings in (
        (OUTLINE, outlines(elevation.depth, plane)),
        (OPENINGS, recesses(elevation.depth, plane)),
        (PROJECTIONS, projections(elevation.depth, plane)),
    ):
        strokes += [Stroke(layer, ring + np.array([0.0, zero_m]), closed=True) for ring in rings]
    levels, marks = _levels(low, high, scale)
    bar, lengths = scale_bar(wall.length_m, low, scale)
    about = (
        f"1:{scale} on A3, {wall.length_m:.2f} m × {high - low:.2f} m, {lattice.cell_m * 1000.0:g} mm a pixel",
        f"Heights: {crs.described_heights().rpartition(',')[0]}, metres. {crs.horizontal.name}",
    )
    title = caption(f"Façade {wall.name}", about, 0.0, low, scale)
    bottom = lattice.north_m + zero_m - height_m
    placed = DrawingPicture(picture, lattice.east_m, bottom, width_m, height_m, (lattice.width, lattice.height))
    return Drawing(scale, [*strokes, *levels, *bar], [*marks, *lengths, *title], placed)


def _levels(low: float, high: float, scale: int) -> tuple[list[Stroke], list[Label]]:
    """Level marks of foot and top, at the left."""
    mm = scale / 1000.0
    strokes, labels = [], []
    for height in (low, high):
        line = np.array([[-(GAP_MM + TICK_MM) * mm, height], [-GAP_MM / 2.0 * mm, height]])
        strokes.append(Stroke(EXTENT, line))
        labels.append(Label(f"{height:.2f}", -GAP_MM / 2.0 * mm, height + 1.0 * mm, anchor="end"))
    return strokes, labels
