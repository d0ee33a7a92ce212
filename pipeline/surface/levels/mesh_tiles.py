"""3D Tiles 1.1 of a textured mesh, at its place on the earth: a quadtree of glTF tiles, textures reduced by level.

All tiles have the tileset's origin, in the middle of the site, and take their vertices' coordinates from one array of
32-bit numbers: neighbours have the same ones, and a viewer moves them by the same matrix, so that borders stay closed
to the last bit. The numbers' steps are 0.06 mm 1 km from the middle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from splatpipe.pipeline.delivery.delivery_frame import facts_of
from splatpipe.pipeline.delivery.ecef_tiles import esri_crs_of
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.splat.levels.tileset import TILESET, TilesetTile, tileset_text
from splatpipe.pipeline.surface.levels.charted_mesh import ChartedMesh
from splatpipe.pipeline.surface.levels.mesh_glb import write_part
from splatpipe.pipeline.surface.levels.mesh_quadtree import MeshQuadtree, MeshTile, TileKey, pixels_per_metre
from splatpipe.pipeline.surface.levels.mesh_texture import TexturePages, packed_texture
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.world import Placement, open_world

TILES = "tiles"
# Viewers show a tile up to an error of 16 pixels, CesiumJS's default: its texture's pixels are then as large as theirs
ERROR_PIXELS = 16.0


@dataclass(frozen=True)
class MeshTilesSummary:
    """What a tileset holds.

    Attributes:
        tiles: Number of tiles.
        levels: Number of levels.
        triangles: Triangles of the finest level.
        placement: How it was placed: ``approximate`` and ``note`` are for the user.
    """

    tiles: int
    levels: int
    triangles: int
    placement: Placement


def charted(made: TexturedMesh) -> tuple[ChartedMesh, Int64[np.ndarray, "c 5"]]:
    """A textured mesh's triangles, and its charts' rectangles."""
    mesh, atlas = made.coloured.mesh, made.atlas
    corners, charts = atlas.corners.astype(np.float64), atlas.chart.astype(np.int64)
    return ChartedMesh(mesh.vertices, mesh.triangles, corners, charts), atlas.rects.astype(np.int64)


def write_mesh_tiles(
    folder: Path, made: TexturedMesh, frame: Frame, work: Path, progress: Callable[[int, int], None]
) -> MeshTilesSummary:
    """Write `tileset.json` and a tile for each part that shows anything; deterministic.

    Args:
        folder: An empty folder.
        made: The mesh, in the frame's local metres.
        frame: The run's georeferenced frame.
        work: Folder for the decoded texture, three bytes a pixel; it is emptied first and removed afterwards.
        progress: Called with the tiles written so far, and all.

    Raises:
        SplatpipeError: if the run is not georeferenced, or a page cannot be read.
        OSError: if the disk is full or not writable.
    """
    if frame.origin is None:
        raise SplatpipeError(
            "3D Tiles need a georeferenced run, and this one is not.",
            hint="Give it control points or photos with positions.",
        )
    mesh, rects = charted(made)
    pixels, density = pixels_per_metre(mesh)
    tree = MeshQuadtree(mesh, pixels)
    middle = _middle(tree.mesh)
    writer = _TileWriter(folder, tree, rects, (tree.mesh.vertices - middle).astype(np.float32), 1.0 / density, progress)
    (folder / TILES).mkdir()
    writer.pages = TexturePages(made.pages, work)
    try:
        root = tree.build(writer.write)
    finally:
        writer.pages.remove()
    assert root is not None
    world = open_world(frame)
    top = writer.entry(root)
    box = top.box + middle
    placement, esri = world.placement(box), esri_crs_of(world, box)
    move = np.eye(4)
    move[:3, 3] = middle
    if esri is not None:
        esri = esri.moved(move)
    facts = facts_of(frame, antialias=False)
    write_file(folder / TILESET, tileset_text(top, placement.matrix @ move, esri, facts, {}))
    return MeshTilesSummary(len(writer.boxes), tree.depth + 1, len(tree.mesh), placement)


class _TileWriter:
    """Writes the tiles of a quadtree while they are made.

    Args:
        folder: The tileset's.
        tree: The quadtree.
        rects: Of the charts.
        places: Vertices about the tileset's origin.
        pixel_m: Size of a texture pixel on the surface, full size.
        progress: Called with the tiles written so far, and all.
    """

    pages: TexturePages

    def __init__(
        self,
        folder: Path,
        tree: MeshQuadtree,
        rects: Int64[np.ndarray, "c 5"],
        places: Float32[np.ndarray, "n 3"],
        pixel_m: float,
        progress: Callable[[int, int], None],
    ) -> None:
        self.boxes: dict[TileKey, Float64[np.ndarray, "2 3"]] = {}
        self._folder, self._depth, self._rects, self._places = folder, tree.depth, rects, places
        self._pixel_m, self._progress, self._count = pixel_m, progress, tree.tile_count

    def write(self, tile: MeshTile) -> None:
        """Write a tile."""
        texture = packed_texture(tile.mesh, self._rects, self.pages, 1 << self._depth - tile.key.level)
        write_part(self._folder / _uri(tile.key), tile.mesh, self._places, texture)
        corners = self._places[tile.mesh.triangles.ravel()].astype(np.float64)
        boxes = [np.stack([corners.min(axis=0), corners.max(axis=0)])]
        boxes += [self.boxes[child.key] for child in tile.children]
        every = np.stack(boxes)
        self.boxes[tile.key] = np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])
        self._progress(len(self.boxes), self._count)

    def entry(self, tile: MeshTile) -> TilesetTile:
        """The tileset's entry for a tile and all below it."""
        up = self._depth - tile.key.level
        error = 0.0 if up == 0 else max(tile.error_m, ERROR_PIXELS * self._pixel_m * (1 << up))
        children = tuple(self.entry(child) for child in tile.children)
        return TilesetTile(self.boxes[tile.key], round(error, 6), _uri(tile.key), children)


def _uri(key: TileKey) -> str:
    return f"{TILES}/{key.name}.glb"


def _middle(mesh: ChartedMesh) -> Float64[np.ndarray, " 3"]:
    """The middle of the box of a mesh's vertices, in whole metres."""
    used = mesh.vertices[np.unique(mesh.triangles)]
    return np.asarray(np.rint((used.min(axis=0) + used.max(axis=0)) / 2.0))
