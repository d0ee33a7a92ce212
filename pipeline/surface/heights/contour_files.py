"""Contours as GeoJSON for maps and as DXF for CAD.

GeoJSON is in WGS 84 longitude and latitude (RFC 7946 allows no other CRS, and web maps read no other); heights are a
property, because a third coordinate would be read as an ellipsoidal height. Between WGS 84 and an older datum, programs
choose different transformations, metres apart, so the DXF is in the run's CRS, with heights in the drawing's unit. It
has the AutoCAD 2000 format: the oldest with drawing units and polylines with an elevation, so most programs read it.
"""

from __future__ import annotations

import json
from io import TextIOWrapper
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.surface.drawings.dxf import new_document
from splatpipe.pipeline.surface.heights.contours import Contours, trace_contours
from splatpipe.pipeline.surface.rasters.grid import Grid
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs, unit_name

DXF_VERSION = "R2000"
DXF_UNITS = {"metre": 6, "foot": 2, "US survey foot": 21}  # codes of the header variable $INSUNITS
LAYER, INDEX_LAYER = "CONTOURS", "CONTOURS_INDEX"
LINE_WEIGHTS = {LAYER: 13, INDEX_LAYER: 35}  # hundredths of a millimetre
LAYER_COLOURS = {LAYER: 8, INDEX_LAYER: 7}  # AutoCAD's grey; black or white, depending on the background
DEGREE_DIGITS = 9  # a tenth of a millimetre
UNIT_DIGITS = 4  # decimals of metres and feet: a tenth of a millimetre, or less


def draw_contours(raster: Path, out: Path, grid: Grid, report: Reporter) -> None:
    """Write `contours.dxf`, and `contours.geojson` if the grid is georeferenced; a warning if there are too many lines.

    Args:
        raster: Raster with heights.
        out: Output folder.
        grid: Its grid.
        report: Receives the warning.
    """
    try:
        contours = trace_contours(raster)
    except SplatpipeError as error:
        report.warning(f"No contours were made: {error.message}", error.hint)
        return
    write_dxf(out / "contours.dxf", contours, grid.crs)
    if grid.crs.world is not None:
        write_geojson(out / "contours.geojson", contours, grid)


def write_geojson(path: Path, contours: Contours, grid: Grid) -> None:
    """Write contours as GeoJSON; a closed line repeats its first position at the end.

    Args:
        path: Output file.
        contours: In the grid's CRS.
        grid: The grid of the surface model.

    Raises:
        SplatpipeError: if the frame is not georeferenced.
    """
    if grid.crs.world is None:
        raise SplatpipeError(
            "The reconstruction is not georeferenced, so its contours have no longitude and latitude.",
            "Use the DXF, or georeference the run: give photos with positions, or a gcp_list.txt.",
        )
    header = {"type": "FeatureCollection", "heights": grid.crs.described_heights()}
    with whole_file(path) as aside, TextIOWrapper(new_file(aside), "utf-8") as file:
        file.write(json.dumps(header)[:-1] + ',\n"features": [')
        for number, contour in enumerate(contours.lines):
            line = np.concatenate([contour.line, contour.line[:1]]) if contour.closed else contour.line
            degrees = np.round(_degrees(line, contour.height, grid), DEGREE_DIGITS)
            feature = {
                "type": "Feature",
                "properties": {"height": contour.height, "index": contour.is_index},
                "geometry": {"type": "LineString", "coordinates": degrees.tolist()},
            }
            file.write(("," if number else "") + "\n" + json.dumps(feature))
        file.write("\n]}\n")


def write_dxf(path: Path, contours: Contours, crs: MapCrs) -> None:
    """Write contours as DXF: polylines with an elevation on two layers.

    Args:
        path: Output file.
        contours: In the CRS.
        crs: CRS of the contours.
    """
    with new_document(DXF_VERSION, DXF_UNITS.get(unit_name(crs.unit_m), 0)) as drawing:
        drawing.header["$MEASUREMENT"] = 1
        about = f"every {contours.interval:g}, {crs.described_heights()}; {crs.horizontal.name}"
        for name in (LAYER, INDEX_LAYER):
            layer = drawing.layers.add(name, color=LAYER_COLOURS[name], lineweight=LINE_WEIGHTS[name])
            layer.description = f"Contours {about}"
        model = drawing.modelspace()
        scale = crs.height_unit_m / crs.unit_m
        for contour in contours.lines:
            drawn = {"layer": INDEX_LAYER if contour.is_index else LAYER, "elevation": contour.height * scale}
            model.add_lwpolyline(np.round(contour.line, UNIT_DIGITS), close=contour.closed, dxfattribs=drawn)
        if contours.lines:
            lows, highs = zip(*((c.line.min(axis=0), c.line.max(axis=0)) for c in contours.lines), strict=True)
            model.reset_extents((*np.min(lows, axis=0), 0.0), (*np.max(highs, axis=0), 0.0))
        with whole_file(path) as aside:
            drawing.saveas(aside)


def _degrees(line: Float64[np.ndarray, "n 2"], height: float, grid: Grid) -> Float64[np.ndarray, "n 2"]:
    """Longitude and latitude (WGS 84)."""
    assert grid.crs.world is not None
    local = grid.local_from_crs(np.column_stack([line, np.full(len(line), height)]))
    return np.asarray(grid.crs.world.origin.geodetic_from_enu(local)[:, 1::-1])
