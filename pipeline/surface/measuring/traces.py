"""Traces: thinned sections and outlines in the world frame, for a page that draws them over the model."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.plan_area import Polygon, Ring
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
from splatpipe.pipeline.surface.measuring.sections import Section
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs

DIGITS = 3  # a millimetre
Column = list[float | None]


def section_trace(section: Section, crs: MapCrs, most: int) -> dict[str, Column]:
    """A section's heights along its line; a long one keeps the extremes of each stretch, so that no peak is lost.

    Args:
        section: The section.
        crs: CRS of its coordinates.
        most: Maximum number of places, and likewise of points, at least 4.

    Returns:
        Columns, all in metres: ``distance``, ``height`` and ``sigma`` (heights as the CRS counts them, None where the
        surface has a hole), ``x``, ``y``, ``z`` of the same places in the world frame; ``point_distance``,
        ``point_height`` of what photos see near the plane; and ``ground`` as ``height``, if there is a terrain model.
    """
    rows = _rows_to_keep(section.height, most)
    height = section.height[rows]
    known = np.isfinite(height)
    local = np.full((len(rows), 3), np.nan)
    local[known] = crs.local_from_crs(np.column_stack([section.place[rows][known], height[known]]))
    ground = {} if section.ground is None else {"ground": _column(section.ground[rows] * crs.height_unit_m)}
    points = section.points[:: max(1, -(-len(section.points) // most))]
    return {
        "distance": _column(section.distance_m[rows]),
        "height": _column(height * crs.height_unit_m),
        "sigma": _column(section.sigma_m[rows]),
        **dict(zip("xyz", map(_column, local.T), strict=True)),
        "point_distance": _column(points[:, 0]),
        "point_height": _column(points[:, 1]),
        **ground,
    }


def polygon_trace(surface: SurfaceFile, polygon: Polygon, crs: MapCrs, most: int) -> list[dict[str, Column]]:
    """A polygon's rings draped onto the surface; holes of the surface are bridged.

    Args:
        surface: The surface model.
        polygon: East and north, local metres.
        crs: CRS of the surface model.
        most: Maximum number of places on each ring, at least 4.

    Returns:
        For each ring, closed: ``x``, ``y``, ``z`` in the world frame, metres.
    """
    return [_ring_trace(surface, ring, crs, most) for ring in polygon]


def _ring_trace(surface: SurfaceFile, ring: Ring, crs: MapCrs, most: int) -> dict[str, Column]:
    closed = np.concatenate([ring, ring[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.linspace(0.0, way[-1], most)
    if len(way) <= most // 2:  # with every corner
        at = np.union1d(way, at[::2])
    plan = np.stack([np.interp(at, way, closed[:, axis]) for axis in (0, 1)], axis=1)
    place = crs.crs_from_local(np.column_stack([plan, np.zeros(len(plan))]))
    height, _ = surface.along(np.ascontiguousarray(place[:, :2]))
    known = np.flatnonzero(np.isfinite(height))
    place[:, 2] = np.interp(np.arange(len(height)), known, height[known]) if len(known) else place[:, 2]
    local = crs.local_from_crs(place)
    return dict(zip("xyz", map(_column, local.T), strict=True))


def _rows_to_keep(height: Float64[np.ndarray, " n"], most: int) -> Int64[np.ndarray, " k"]:
    """Rows of places to keep: all if few; else both ends, and each stretch's lowest and highest. Holes stay holes."""
    if len(height) <= most:
        return np.arange(len(height))
    chosen = [0, len(height) - 1]
    for rows in np.array_split(np.arange(1, len(height) - 1), (most - 2) // 2):
        part = height[rows]
        if np.isfinite(part).any():
            chosen += [int(rows[np.nanargmin(part)]), int(rows[np.nanargmax(part)])]
        else:
            chosen.append(int(rows[0]))
    return np.unique(chosen)


def _column(values: Float64[np.ndarray, " n"]) -> Column:
    return [round(float(value), DIGITS) if np.isfinite(value) else None for value in values]
