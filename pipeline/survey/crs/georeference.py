"""`georef.json`: a splat's georeference, for programs that only handle JSON, matrices and PROJ pipelines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.survey.crs.crs import describe_vertical
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.world import World, open_world

FORMAT = 1
EXTENT_PERCENTILES = (1.0, 99.0)  # percentiles that bound the sparse points: the rest may lie kilometres away


def scene_box(points: Float64[np.ndarray, "n 3"], centres: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "2 3"]:
    """The scene's bounding box: its sparse points without the outermost, and the cameras.

    Args:
        points: Sparse points, world units.
        centres: Camera centres, likewise.

    Returns:
        Least and largest coordinates.
    """
    usable = points[np.isfinite(points).all(axis=1)]
    corners = [centres, np.percentile(usable, EXTENT_PERCENTILES, axis=0)] if len(usable) else [centres]
    every = np.concatenate([*corners, np.zeros((0 if len(centres) or len(usable) else 1, 3))])
    return np.stack([every.min(axis=0), every.max(axis=0)])


def georeference(frame: Frame, box: Float64[np.ndarray, "2 3"]) -> dict[str, Any]:
    """The contents of `georef.json`.

    Args:
        frame: georef's.
        box: Of the scene, in the world frame.
    """
    head = {"format": FORMAT, "note": frame.note}
    if frame.origin is None:
        scale = "metres, arbitrary place" if frame.metres else "arbitrary scale"
        return {**head, "frame": f"z up, {scale} and heading", "origin": None}
    world = open_world(frame)
    there = world.crs_from_local(np.zeros((1, 3)))[0]
    return {
        **head,
        "frame": "local east, north, up, metres",
        "origin": {
            "latitude": frame.origin.latitude,
            "longitude": frame.origin.longitude,
            "height_m": frame.origin.height_m,
            "in_crs": there.tolist(),
        },
        "crs": _crs(world),
        "vertical": {
            "of_local_heights": world.vertical,
            "of_crs_heights": world.heights,
            "name": describe_vertical(world.heights),
        },
        "exact_path": _exact_path(world),
        **_matrices(world, box),
        "lengths": _lengths(world),
    }


def accuracy_in_words(accuracy_m: float | None) -> str:
    """Phrase PROJ's accuracy of an operation, to two significant digits; 0 means a conversion without error.

    Args:
        accuracy_m: Metres; None where PROJ does not know it.
    """
    if accuracy_m is None:
        return "of unknown accuracy"
    if accuracy_m == 0.0:
        return "an exact conversion"
    if accuracy_m < 0.01:
        return f"accurate to {accuracy_m * 1000.0:.2g} mm"
    return f"accurate to {accuracy_m:.2g} m" if accuracy_m < 99.5 else f"accurate to {accuracy_m:,.0f} m"


def accuracy_line(georeferenced: Mapping[str, Any]) -> str:
    """One or two sentences on the CRS and the operation of a `georef.json` that has an origin."""
    crs, operation = georeferenced["crs"], georeferenced["crs"]["operation"]
    accuracy = accuracy_in_words(operation["accuracy_m"])
    best = "" if operation["best"] else "; a better one lacks its grid"
    return (
        f"Coordinates are in {crs['id']} ({crs['name']}), by {operation['name']}, {accuracy}{best}. "
        f"Vertical datum: {georeferenced['vertical']['name']}. {operation['note']}"
    ).strip()


def _crs(world: World) -> dict[str, Any]:
    axes = [f"{axis.name} ({axis.unit_name})" for axis in world.crs.horizontal.axis_info[:2]]
    east_first = axes if world.crs.horizontal.axis_info[0].direction != "north" else axes[::-1]
    operation = world.operation
    return {
        "id": world.crs.text,
        "name": world.crs.name,
        "axes": [*east_first, f"height ({world.crs.height_unit_m:.10g} m)"],
        "operation": {
            "name": operation.name,
            "accuracy_m": operation.accuracy_m,
            "best": operation.best,
            "note": operation.note,
            "pipeline": operation.definition,
        },
    }


def _exact_path(world: World) -> dict[str, Any]:
    heights = "the height is as stated, in the datum of the local heights"
    steps = [
        "matrix times (east, north, up, 1), in float64",
        f"EPSG:4978 to EPSG:4979: latitude, longitude, height; {heights}",
    ]
    if world.heights != world.vertical:
        steps.append(f"the height to {describe_vertical(world.heights)}, by the geoid's grid")
    steps.append(
        "latitude, longitude, height by the inverse of crs.operation.pipeline: easting (longitude), northing (latitude)"
    )
    return {"matrix": world.origin.ecef_from_enu().tolist(), "steps": steps}


def _matrices(world: World, box: Float64[np.ndarray, "2 3"]) -> dict[str, Any]:
    placement, tangent = world.placement(box), world.tangent(box)
    return {
        "ecef_from_local": {
            "crs": "EPSG:4978",
            "matrix": placement.matrix.tolist(),
            "approximate": placement.approximate,
            "largest_error_m": _rounded(placement.largest_error_m),
            "note": placement.note,
        },
        "crs_from_local_tangent": {
            "matrix": tangent.matrix.tolist(),
            "largest_error_m": _rounded(tangent.largest_error_m),
            "largest_height_error_m": _rounded(tangent.largest_height_error_m),
            "over_box_m": np.round(box, 3).tolist(),
            "note": "For programs that take only a matrix; it needs float64.",
        },
    }


def _lengths(world: World) -> dict[str, Any]:
    scale = world.grid_scale()
    local = "ground lengths: straight, at the scene's own height"
    if scale is None:
        return {"local": local, "crs": "degrees"}
    return {
        "local": local,
        "crs": "grid lengths: ground lengths times grid_per_ground",
        "grid_per_ground": scale.ground,
        "grid_per_ellipsoid": scale.projection,
        "convergence_deg": scale.convergence_deg,
    }


def _rounded(length_m: float | None) -> float | None:
    return None if length_m is None else round(length_m, 6)
