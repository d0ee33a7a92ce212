"""The dense cloud of a capture as a file, `cloud.laz`: fused, thinned and coloured tile by tile in plan."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.mvs.array_file import save_arrays
from splatpipe.pipeline.splat.containers.archives import open_archive
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet
from splatpipe.pipeline.surface.depths.run_sources import RunSurface
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent
from splatpipe.pipeline.surface.depths.sources import HeightRange
from splatpipe.pipeline.surface.rasters.grid import make_grid
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile, tiled
from splatpipe.pipeline.surface.shapes.fusion import FusedPoints, concatenate_clouds, finest_of_cubes, fuse_depths
from splatpipe.pipeline.surface.shapes.point_cloud import UNDATED, CloudChunk, CloudFrame, write_cloud
from splatpipe.pipeline.surface.shapes.point_colours import photo_set, point_colours

SIDE = 1024  # cells of a part of the plan, in which each photo is read once: some 2 million points; 2048 took 3.2 GB
TILE = 256  # cells of a tile, in which depths are compared
CLASSES = 256  # numbers that a class may have
MARGIN = 3  # cells around a tile from which points may move into it


Classify = Callable[
    [Float64[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"], tuple[float, float], float], UInt8[np.ndarray, " n"]
]


@dataclass(frozen=True, eq=False)
class CloudTask:
    """Inputs of a cloud.

    Attributes:
        surface: The run's photos and depths.
        site: The area that they cover.
        spacing_m: A cube of this side holds at most one point; the photos' GSD, metres.
        threads: Tiles or photos in parallel.
        classify: Classes of points from their positions and normals, the corner of the cloud's cells (east and north)
            and the spacing; None leaves all unclassified.
    """

    surface: RunSurface
    site: SiteExtent
    spacing_m: float
    threads: int
    classify: Classify | None = None


def make_cloud(task: CloudTask, work: Path, out: Path, report: Reporter) -> dict[str, Any]:
    """Write the cloud; a killed run resumes after the last finished part of the plan.

    Args:
        task: Inputs.
        work: Folder for intermediate files.
        out: Output folder.
        report: Receives progress.

    Returns:
        Statistics: number of points, their spacing, and the CRS.

    Raises:
        SplatpipeError: if the site is absurdly large.
        ValueError: if depths or pixels do not fit their camera.
        MachineError: if the disk is full.
    """
    grid = make_grid(task.surface.frame, task.site.box, task.spacing_m)
    lattice, relief = _lattice(task), HeightRange(task.site.low_m, task.site.high_m)
    work.mkdir(exist_ok=True)
    parts = [part for part in tiled(lattice.height, lattice.width, SIDE) if _tiles(task, lattice, part)]
    photos = None
    for done, part in enumerate(parts):
        path = work / f"{done:06d}.npz"
        if not path.is_file():
            photos = photos or photo_set(task.surface.photos, task.spacing_m, task.threads)
            chunk = _part(task, photos, (lattice, relief), part)
            save_arrays(path, **vars(chunk))
        report.progress(done + 1, len(parts), "dense cloud", "parts")
    count = write_cloud(out / "cloud.laz", _load_chunks(work, len(parts)), CloudFrame.of_grid(grid), UNDATED)
    facts = {"points": count, "spacing_m": task.spacing_m, "crs": grid.crs.horizontal.name}
    return facts if task.classify is None else {**facts, "classes": _count_classes(work, len(parts))}


def _lattice(task: CloudTask) -> Lattice:
    (west, south, _), (east, north, _) = task.site.box
    columns, rows = (max(1, int(np.ceil(size / task.spacing_m))) for size in (east - west, north - south))
    return Lattice(float(west), float(north), task.spacing_m, columns, rows)


def _tiles(task: CloudTask, lattice: Lattice, part: Tile) -> list[Tile]:
    """Tiles of a part that the site covers."""
    found = []
    for tile in tiled(part.height, part.width, TILE):
        moved = Tile(part.row + tile.row, part.column + tile.column, tile.height, tile.width)
        corners = lattice.centres(moved)[[0, -1], [0, -1]]
        if task.site.sees(np.stack([corners.min(axis=0), corners.max(axis=0)])):
            found.append(moved)
    return found


def _part(task: CloudTask, photos: PhotoSet, space: tuple[Lattice, HeightRange], part: Tile) -> CloudChunk:
    """The cloud of a part of the plan."""
    tiles = _tiles(task, space[0], part)
    points = concatenate_clouds(list(ordered_map(partial(tile_cloud, photos, *space), tiles, task.threads)))
    if task.surface.area is not None:
        points = points.select(task.surface.area.contains(points.pieces.xyz.T))
    colours, known = point_colours(photos, points.pieces, task.spacing_m, task.threads)
    points = points.select(known)  # drop points that moved to where no photo sees them
    positions, normals = (np.ascontiguousarray(each.T) for each in (points.pieces.xyz, points.pieces.normal))
    directions = normals.astype(np.float32)
    classes = np.zeros(len(positions), np.uint8)
    if task.classify is not None:
        corner = space[0].east_m, space[0].north_m
        classes = task.classify(positions, directions, corner, task.spacing_m)
    return CloudChunk(positions, colours[known], directions, points.confidence, classes)


def tile_cloud(photos: PhotoSet, lattice: Lattice, relief: HeightRange, tile: Tile) -> FusedPoints:
    """The points of one tile, by cell and height: at most one for each cube of cell size."""
    wide = tile.grown(MARGIN)
    points = fuse_depths(photos.parts_in(lattice, wide, relief), lattice, wide, relief)
    return points.select(finest_of_cubes(points.pieces.xyz, points.footprint, lattice, tile))


def _count_classes(work: Path, count: int) -> dict[str, int]:
    """Number of points of each class that occurs."""
    counts = np.zeros(CLASSES, np.int64)
    for number in range(count):
        with open_archive(work / f"{number:06d}.npz") as kept:
            counts += np.bincount(kept["classes"], minlength=CLASSES)
    return {str(number): int(counts[number]) for number in np.flatnonzero(counts).tolist()}


def _load_chunks(work: Path, count: int) -> Iterator[CloudChunk]:
    for number in range(count):
        with open_archive(work / f"{number:06d}.npz") as kept:
            yield CloudChunk(**kept)
