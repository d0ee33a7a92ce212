"""Classify the triangles of the true surface: ground, roof, wall or something else."""

from __future__ import annotations

import json

import numpy as np
from jaxtyping import Float64, Int8

from splatpipe.demo import CAPTURE
from splatpipe.demo.site.house import BRICK, CREAM, NORTH_PLASTER, SHEET, SLATE, TILES
from splatpipe.demo.site.scene import building_corners, foliage_corners
from splatpipe.demo.truth.truth import Triangles

OTHER, GROUND, HOUSE, TILED, SLATED, SHEETED, PLAIN, BRICKS, FOLIAGE = range(9)
NAMES = ("others", "ground", "house", "tiles", "slates", "metal roof", "plain walls", "bricks", "foliage")
PAINTS = {TILED: TILES, SLATED: SLATE, SHEETED: SHEET, BRICKS: BRICK}
PLASTERS = (CREAM, NORTH_PLASTER)
GROUND_M = 0.02  # targets lie 12 mm above the plot, which is level and at 0
TARGET_REACH_M = 0.36  # from a target's centre to its corners, at most
TARGET_OFF_M = 1e-3  # distance from its plane
TARGETS_ON = {"roof": TILED, "wall": HOUSE, "ground": GROUND}
FLAT = 0.9999  # upward part of the plot's normal


def parts_of(triangles: Triangles) -> Int8[np.ndarray, " m"]:
    """Return each triangle's class, a constant of this module; targets count as the surface they lie on.

    Args:
        triangles: From ``true_surface``.
    """
    parts = np.full(len(triangles), OTHER, np.int8)
    up = unit_normals(triangles)[:, 2]
    heights = triangles[..., 2]
    rows = {key: row for row, key in enumerate(_keys(triangles))}
    parts[_rows(rows, foliage_corners())] = FOLIAGE
    parts[(np.abs(heights) < GROUND_M).all(axis=1) & (np.abs(up) > FLAT)] = GROUND
    for part, corners in ((HOUSE, building_corners()), *((p, building_corners(paint)) for p, paint in PAINTS.items())):
        parts[_rows(rows, corners)] = part
    for paint in PLASTERS:
        parts[_rows(rows, building_corners(paint))] = PLAIN
    for point in json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))["points"]:
        apart = triangles - np.array(point["xyz_m"])
        near = (np.linalg.norm(apart, axis=2) < TARGET_REACH_M) & (np.abs(apart @ point["normal"]) < TARGET_OFF_M)
        parts[near.all(axis=1)] = TARGETS_ON[point["where"]]
    return parts


def _rows(rows: dict[bytes, int], corners: Triangles) -> list[int]:
    return [rows[key] for key in _keys(corners) if key in rows]  # degenerate slivers were left out


def _keys(triangles: Triangles) -> list[bytes]:
    """Keys that are equal for the same three corners in any order."""
    order = np.lexsort((triangles[..., 2], triangles[..., 1], triangles[..., 0]), axis=-1)
    in_order = np.take_along_axis(triangles, order[..., None], axis=1) + 0.0  # no negative zeros
    return [corners.astype(np.float32).tobytes() for corners in in_order]


def unit_normals(triangles: Triangles) -> Float64[np.ndarray, "m 3"]:
    """Unit normals by the corners' winding; zero for slivers."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))
