"""A georeferenced splat on the globe: its 3D Tiles, placed as accurately as its heights are known."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.delivery.delivery_frame import frame_of
from splatpipe.pipeline.splat.levels.levels import LevelNode
from splatpipe.pipeline.splat.levels.tiles import box_z_up, require_georeference, write_tiles
from splatpipe.pipeline.splat.levels.tileset import EsriCrs
from splatpipe.pipeline.splat.model.scene import Scene
from splatpipe.pipeline.survey.crs.crs import ELLIPSOIDAL
from splatpipe.pipeline.survey.crs.world import Placement, World, open_world

ESRI_WGS84_HEIGHTS = 115700
"""Esri's number of heights above WGS 84's ellipsoid, which have none of EPSG's."""
_EPSG = re.compile(r"EPSG:(\d{1,6})")


def write_tiles_on_globe(folder: Path, scene: Scene, root: LevelNode) -> Placement:
    """Write a scene's 3D Tiles at its place on the earth.

    Args:
        folder: As for ``write_tiles``.
        scene: With its georeference.
        root: Root of its levels, in its frame.

    Returns:
        How it was placed: ``approximate`` and ``note`` are for the user.

    Raises:
        SplatpipeError: if it has no place on the earth, or its CRS cannot be used there.
        ValueError: as ``write_tiles``.
        OSError: as ``write_tiles``.
    """
    require_georeference(scene.facts)
    assert scene.facts.place is not None
    world = open_world(frame_of(scene.facts.place))
    box = box_z_up(root.box, scene.facts.axes)
    placement = world.placement(box)
    write_tiles(folder, scene, root, placement.matrix, esri_crs_of(world, box))
    return placement


def esri_crs_of(world: World, box: Float64[np.ndarray, "2 3"]) -> EsriCrs | None:
    """The CRS in which Esri's programs show tiles; None for a geographic CRS, whose degrees are not a map.

    Args:
        world: The scene's world.
        box: Lowest and highest east, north, up of the scene, metres.
    """
    if world.crs.is_geographic:
        return None
    number = _EPSG.match(world.crs.text)
    wkt = "" if number else world.crs.horizontal.to_2d().to_wkt()
    heights = _EPSG.fullmatch(world.heights)
    vertical = int(heights[1]) if heights else ESRI_WGS84_HEIGHTS if world.heights == ELLIPSOIDAL else None
    return EsriCrs(int(number[1]) if number else None, wkt, vertical, world.tangent(box).matrix)
