"""Writes a product and dies halfway, by a signal or a full disk; a program for test_surface_kills.py.

Arguments: the folder. Every product is tried in a process of its own, in both ways; the outcome is printed to stdout.
"""

import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from hills import hill_grid, placed
from made_mesh import made_site

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.files.durable import beside
from splatpipe.pipeline.surface.heights.contour_files import write_dxf, write_geojson
from splatpipe.pipeline.surface.heights.contours import Contour, Contours
from splatpipe.pipeline.surface.levels.copc import write_copc
from splatpipe.pipeline.surface.levels.map_tiles import write_ortho_tiles
from splatpipe.pipeline.surface.levels.mesh_tiles import write_mesh_tiles
from splatpipe.pipeline.surface.rasters.geotiff import COLOURS, CONFIDENCE, HEIGHTS, RasterForm, raster_file
from splatpipe.pipeline.surface.rasters.grid import Grid
from splatpipe.pipeline.surface.shapes.point_cloud import CloudChunk, CloudFrame, write_cloud

DISK_BYTES = 100_000
SMALL_BYTES = 1000  # less than any tile of a mesh has
Halfway = Callable[[], None]


def write_raster(path: Path, grid: Grid, form: RasterForm, halfway: Halfway) -> None:
    rng = np.random.default_rng(0)
    with raster_file(path, grid, form) as file:
        for number, tile in enumerate(grid.tiles()):
            file.write(tile, rng.integers(0, 255, (len(form.bands), tile.height, tile.width)).astype(form.dtype))
            if number == 2:
                halfway()


def fill_late(path: Path, grid: Grid, halfway: Halfway) -> None:
    """The disk holds all tiles, but not the file that is made of them, which has overviews, too."""
    size = int(1.1 * 4 * grid.width * grid.height)
    with raster_file(path, grid, CONFIDENCE) as file:
        for tile in grid.tiles():
            file.write(tile, np.random.default_rng(0).integers(0, 65535, (2, tile.height, tile.width), np.uint16))
        halfway() if halfway is die else fill_the_disk(size)


def write_points(path: Path, grid: Grid, halfway: Halfway) -> None:
    rng = np.random.default_rng(0)

    def chunks() -> Iterator[CloudChunk]:
        for number in range(4):
            places = rng.uniform(-10.0, 10.0, (40_000, 3))
            normals = rng.uniform(-1.0, 1.0, (40_000, 3)).astype(np.float32)
            yield CloudChunk(places, rng.integers(0, 255, (40_000, 3), np.uint8), normals, np.ones(40_000, np.uint8))
            if number == 2:
                halfway()

    write_cloud(path, chunks(), CloudFrame.of_grid(grid))


def write_lines(path: Path, grid: Grid, halfway: Halfway) -> None:
    west, south, _, _ = grid.bounds

    class Lines(tuple[Contour, ...]):
        def __iter__(self) -> Iterator[Contour]:
            for number, contour in enumerate(super().__iter__()):
                yield contour
                if number == len(self) // 2:
                    halfway()

    line = np.array([west, south]) + np.random.default_rng(0).uniform(0.0, 20.0, (500, 2))
    contours = Contours(1.0, Lines(Contour(float(number), False, False, line) for number in range(40)))
    (write_dxf(path, contours, grid.crs) if path.suffix == ".dxf" else write_geojson(path, contours, grid))


def write_octree(path: Path, grid: Grid, halfway: Halfway) -> None:
    source = path.with_name(f"source of {path.name}")
    if not source.is_file():
        write_points(source, grid, lambda: None)
    calls: list[int] = []
    write_copc(source, path, path.with_name(f"work of {path.name}"), lambda done, _: halfway_of(calls, done, halfway))


def write_map(path: Path, grid: Grid, halfway: Halfway) -> None:
    source = path.with_name(f"source of {path.name}.tif")
    if not source.is_file():
        write_raster(source, grid, COLOURS, lambda: None)
    calls: list[int] = []
    write_ortho_tiles(source, path, placed(), lambda done, _: halfway_of(calls, done, halfway))


def write_meshes(path: Path, grid: Grid, halfway: Halfway) -> None:
    made = path.with_name(f"source of {path.name}")
    mesh = made_site(made / str(os.getpid()), 50, 512, 20.0)
    calls: list[int] = []
    halfway = halfway if halfway is die else lambda: fill_the_disk(SMALL_BYTES)
    with beside(path) as aside:
        aside.mkdir()
        work = path.with_name(f"work of {path.name}")
        write_mesh_tiles(aside, mesh, placed(), work, lambda done, _: halfway_of(calls, done, halfway))


def halfway_of(calls: list[int], done: int, halfway: Halfway) -> None:
    """Call ``halfway`` the third time that work is reported."""
    calls.append(done)
    if len(calls) == 3:
        halfway()


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fill_the_disk(size: int = DISK_BYTES) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def main(folder: Path) -> None:
    grid = hill_grid(gsd_m=0.04)
    products: dict[str, Callable[[Path, Halfway], None]] = {
        "dsm.tif": lambda path, halfway: write_raster(path, grid, HEIGHTS, halfway),
        "ortho.tif": lambda path, halfway: write_raster(path, grid, COLOURS, halfway),
        "confidence.tif": lambda path, halfway: fill_late(path, grid, halfway),
        "cloud.laz": lambda path, halfway: write_points(path, grid, halfway),
        "cloud.copc.laz": lambda path, halfway: write_octree(path, grid, halfway),
        "ortho.mbtiles": lambda path, halfway: write_map(path, grid, halfway),
        "mesh-tiles": lambda path, halfway: write_meshes(path, grid, halfway),
        "contours.dxf": lambda path, halfway: write_lines(path, grid, halfway),
        "contours.geojson": lambda path, halfway: write_lines(path, grid, halfway),
    }
    for name, write in products.items():
        for how in (fill_the_disk, die):
            child = os.fork()
            if child == 0:
                try:
                    write(folder / name, how)
                except (MachineError, OSError) as error:
                    print(name, type(error).__name__, flush=True)
                os._exit(0)
            status = os.waitpid(child, 0)[1]
            there = sorted(path.name for path in folder.iterdir() if path.name.startswith((name, f".{name}.")))
            print(name, how.__name__, os.waitstatus_to_exitcode(status), len(there), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
