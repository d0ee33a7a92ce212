"""The boundary in the model's frames: inside, Gaussians are spent and figures count; the outside is a backdrop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import write_json
from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.geometry.plan_area import PlanArea, Ring
from splatpipe.pipeline.survey.crs.crs import parse_crs, to_geodetic
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.files.boundary_file import WGS84, BoundaryFile, read_boundary

FORMAT = 1
WITHOUT = "Or run without a boundary: --set georef.boundary=none."
DIRECTIONS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
LARGEST_DEGREES = (180.0, 90.0)
DEGREE_DIGITS = 8  # a millimetre
FEW_POINTS = 100  # sparse points inside; fewer are a poor start


@dataclass(frozen=True, eq=False)
class Boundary:
    """A boundary in the world frame.

    Attributes:
        area: The polygons in east and north, metres.
        degrees: Vertices of the same polygons as longitude and latitude, WGS 84, ring by ring.
        share: Share of the sparse points that lie inside, 0..1.
    """

    area: PlanArea
    degrees: tuple[tuple[Ring, ...], ...]
    share: float


def write_boundary(
    path: Path, frame: Frame, points: Float64[np.ndarray, "n 3"], out: Path, report: Reporter
) -> dict[str, JSON]:
    """Write the part `georef.boundary`: the polygons in the world and the model frame; null without a boundary.

    Args:
        path: The user's file; if it does not exist, there is no boundary.
        frame: georef's frame.
        points: Sparse points in the model's frame.
        out: The file to write.
        report: Receives messages about what lies inside.

    Returns:
        Entries for the stage's summary.

    Raises:
        SplatpipeError: if the file is broken, the model is not georeferenced, or no point lies inside.
    """
    if not path.is_file():  # must not contain the frame, so that training does not depend on it
        write_json(out, {"format": FORMAT, "world": None, "model": None, "degrees": None})
        return {}
    drawing = read_boundary(path)
    boundary = placed(drawing, frame, frame.world_from_model.apply(points))
    _report_boundary(drawing, boundary, len(points), report)
    value = {
        "format": FORMAT,
        "world": boundary.area.facts(),
        "model": boundary.area.in_source(frame.world_from_model).facts(),
        "degrees": [[np.round(ring, DEGREE_DIGITS).tolist() for ring in polygon] for polygon in boundary.degrees],
    }
    write_json(out, value)
    return {"boundary_m2": round(boundary.area.size(), 2), "boundary_points": round(boundary.share, 4)}


def placed(drawing: BoundaryFile, frame: Frame, points: Float64[np.ndarray, "n 3"]) -> Boundary:
    """Bring a boundary into the world frame.

    Args:
        drawing: The boundary file.
        frame: georef's frame.
        points: Sparse points in the world frame.

    Raises:
        SplatpipeError: if the frame is not georeferenced, the CRS cannot be used there, or no point lies inside.
    """
    text = _crs_of(drawing, frame)
    area, degrees = _in_world(drawing, text, frame, swapped=False)
    inside = area.contains(points)
    if not inside.any():
        raise _elsewhere(drawing, text, frame, points, area)
    return Boundary(area, degrees, float(inside.mean()))


def placed_area(drawing: BoundaryFile, frame: Frame) -> PlanArea:
    """Return the polygons in the world frame, without checking that points lie inside.

    Raises:
        SplatpipeError: as ``placed``, except for points inside.
    """
    return _in_world(drawing, _crs_of(drawing, frame), frame, swapped=False)[0]


def _crs_of(drawing: BoundaryFile, frame: Frame) -> str:
    """Return the CRS that the file names, or WGS 84 (RFC 7946), or the run's CRS if the numbers are not degrees."""
    if frame.origin is None:
        raise SplatpipeError(
            f"The boundary {drawing.name} cannot be used on a model that is not georeferenced: {frame.note}".rstrip(
                "."
            ),
            f"Give the photos' positions (geo.txt) or control points. {WITHOUT}",
        )
    if drawing.crs:
        return drawing.crs
    rings = [ring for polygon in drawing.polygons for ring in polygon]
    if all((np.abs(ring) <= LARGEST_DEGREES).all() for ring in rings):
        return WGS84
    if frame.crs and not parse_crs(frame.crs).is_geographic:
        return frame.crs
    raise SplatpipeError(
        f"The boundary {drawing.name} states no CRS, and its coordinates are not degrees.",
        "Save it in WGS 84 (EPSG:4326), or set the run's CRS: --set georef.crs=EPSG:n.",
    )


def _in_world(
    drawing: BoundaryFile, crs: str, frame: Frame, swapped: bool
) -> tuple[PlanArea, tuple[tuple[Ring, ...], ...]]:
    """Return the polygons in east and north, metres, and in longitude and latitude; ``swapped`` swaps the input
    axes."""
    assert frame.origin is not None
    every = np.concatenate([ring for polygon in drawing.polygons for ring in polygon])
    stated = np.column_stack([every[:, ::-1] if swapped else every, np.full(len(every), np.nan)])
    geodetic = to_geodetic(stated, parse_crs(crs), frame.approximate_crs).geodetic
    geodetic[:, 2] = frame.origin.height_m  # heights do not matter in plan
    plan = frame.origin.enu_from_geodetic(geodetic)[:, :2]
    world, degrees, start = [], [], 0
    for polygon in drawing.polygons:
        ends = start + np.cumsum([len(ring) for ring in polygon])
        spans = list(zip([start, *ends[:-1].tolist()], ends.tolist(), strict=True))
        world.append(tuple(plan[a:b] for a, b in spans))
        degrees.append(tuple(geodetic[a:b, 1::-1] for a, b in spans))
        start = int(ends[-1])
    return PlanArea.seen_from_above(world), tuple(degrees)


def _elsewhere(
    drawing: BoundaryFile, crs: str, frame: Frame, points: Float64[np.ndarray, "n 3"], area: PlanArea
) -> SplatpipeError:
    """Return the error for a boundary that contains no point, saying where it lies and the likely reason."""
    vertices = np.concatenate([ring for polygon in area.polygons for ring in polygon])
    middle = np.median(points[np.isfinite(points).all(axis=1)], axis=0)[:2]
    apart = vertices - middle
    nearest = apart[np.argmin(np.square(apart).sum(axis=1))]
    away = float(np.hypot(*nearest))
    direction = DIRECTIONS[round(math.atan2(nearest[1], nearest[0]) / (math.pi / 4.0)) % 8]
    hint = f"Check its position and its CRS, assumed to be {parse_crs(crs).name}. {WITHOUT}"
    try:
        if _in_world(drawing, crs, frame, swapped=True)[0].contains(points).any():
            hint = "Its coordinates are swapped: in GeoJSON, longitude (or easting) comes first."
    except SplatpipeError:  # swapped coordinates are invalid
        pass
    distance = f"{away / 1000.0:,.1f} km" if away >= 1000.0 else f"{away:.0f} m"
    return SplatpipeError(
        f"No part of the capture lies inside the boundary {drawing.name}, {distance} {direction} of its centre.", hint
    )


def _report_boundary(drawing: BoundaryFile, boundary: Boundary, points: int, report: Reporter) -> None:
    if drawing.crossing:
        x, y = drawing.crossing
        report.warning(
            f"The boundary {drawing.name} crosses itself near {x:.10g}, {y:.10g}.",
            "Areas enclosed twice count as outside; redraw it so that it does not cross itself.",
        )
    if drawing.passed_over:
        report.warning(f"The boundary {drawing.name} also has points or lines, which are ignored.")
    inside = round(boundary.share * points)
    if inside < FEW_POINTS:
        report.warning(
            f"Only {inside} points of the sparse model lie inside the boundary.",
            "Check its position: photo positions without RTK or PPK may be metres off.",
        )
    report.note(
        f"boundary: {boundary.area.size():,.0f} m², {100.0 * boundary.share:.0f} % of the sparse points inside; "
        "the outside stays coarse"
    )
