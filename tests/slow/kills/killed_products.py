"""Makes surface products, killed several times halfway and gone on; a program for test_surface.py.

Arguments: the folder. For each product, the signals that its processes ended with, how many files of a killed process
were kept by the next one, and whether all bits are those of an undisturbed process are printed to stdout.
"""

import hashlib
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from hills import hill_grid, placed, write_hill
from house_photos import GSD_M, photos
from killed_surface import write_points, write_raster
from made_mesh import made_site

from splatpipe.pipeline.surface.depths.photo_set import PhotoSet
from splatpipe.pipeline.surface.ground import blocks
from splatpipe.pipeline.surface.ground.dtm import DtmTask, make_dtm
from splatpipe.pipeline.surface.heights.surface_file import open_surface
from splatpipe.pipeline.surface.rasters.geotiff import COLOURS
from splatpipe.pipeline.surface.shapes.point_colours import photo_set
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh, TriangleMesh
from splatpipe.pipeline.surface.texture import charts, packing
from splatpipe.pipeline.surface.texture.texture import TextureTask, texture_mesh
from splatpipe.pipeline.web.publication import RunProducts, write_publication, write_viewer_surfaces

PART_CELLS, CHART_PX, PAGE_PX = 120, 16, 64  # small ones, so that there are several
FORMATS = ("mesh-tiles", "copc", "mbtiles")


class Mortal:
    """A Reporter that kills the process at some report of progress; 0 for never."""

    def __init__(self, last: int) -> None:
        self.left = last

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None:
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def metric(self, name: str, value: float, step: int | None = None) -> None: ...
    def note(self, message: str) -> None: ...
    def warning(self, message: str, hint: str = "") -> None: ...


Make = Callable[[Path, Mortal], object]


def terrain(source: Path) -> Make:
    grid = hill_grid()
    write_hill(source / "dsm.tif", grid)
    surface = open_surface(source / "dsm.tif")

    def make(out: Path, report: Mortal) -> None:
        make_dtm(DtmTask(surface, grid, grid.cell_m / 2.0, 1), out / "work", out, out / "cover.tif", report)

    return make


def textures(_source: Path) -> Make:
    known: PhotoSet = photo_set(photos(), GSD_M, 1)
    rows, columns = np.divmod(np.arange(21**2), 21)
    vertices = np.stack([columns * 0.45 - 4.5, rows * 0.2 - 4.9, np.zeros(len(rows))], axis=1)
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    one, other = ([corner, corner + 1, corner + 22], [corner, corner + 22, corner + 21])
    mesh = TriangleMesh(vertices, np.concatenate([np.stack(each, axis=1) for each in (one, other)]))
    coloured = ColouredMesh(mesh, np.full((len(vertices), 3), 128, np.uint8))

    def make(out: Path, report: Mortal) -> None:
        (out / "work").mkdir(exist_ok=True)
        texture_mesh(TextureTask(known, GSD_M, 1e6, 1), coloured, out / "work", out, report)

    return make


def publication(source: Path) -> Make:
    grid = hill_grid()
    write_hill(source / "dsm.tif", grid)
    write_points(source / "cloud.laz", grid, lambda: None)
    write_raster(source / "ortho.tif", grid, COLOURS, lambda: None)
    files = (source / name for name in ("cloud.laz", "ortho.tif", "dsm.tif"))
    products = RunProducts(placed(), *files, made_site(source, 50, 512, 20.0))

    def make(out: Path, report: Mortal) -> None:
        write_viewer_surfaces(products, out / "surfaces.json", out / "work", report)
        write_publication(FORMATS, products, out / "export", out / "work", report)

    return make


def files_of(folder: Path) -> dict[Path, int]:
    """Files of finished work, and when they were written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file() and _is_finished(path)}


def _is_finished(path: Path) -> bool:
    return not any(part.startswith(".") for part in path.parts)


def digest(folder: Path) -> str:
    """Of the names and contents of all files that are not intermediate."""
    whole = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        if (name := path.relative_to(folder)).parts[0] != "work":
            whole.update(f"{name}\0".encode() + path.read_bytes())
    return whole.hexdigest()


PRODUCTS: dict[str, tuple[Callable[[Path], Make], tuple[int, ...]]] = {
    "terrain": (terrain, (5, 16, 9)),  # in each of its three steps
    "textures": (textures, (3, 27, 2)),  # while photos are rated, after the first page, after the second
    "publication": (publication, (2, 10, 24, 12, 9)),  # in what the viewer shows, the tiles, the cloud, and both maps
}
"""How each is made, and at which report of progress its first, second, … process dies."""


def main(folder: Path) -> None:
    blocks.SIDE, charts.MAX_SIDE, packing.PAGE_SIDE = PART_CELLS, CHART_PX, PAGE_PX
    for name, (prepare, kills) in PRODUCTS.items():
        source, whole, killed = (folder / name / each for each in ("source", "whole", "killed"))
        for each in (source, whole, killed):
            each.mkdir(parents=True)
        make = prepare(source)
        make(whole, Mortal(0))
        before: dict[Path, int] = {}
        kept = 0
        for last in (*kills, 0):
            child = os.fork()
            if child == 0:
                make(killed, Mortal(last))
                os._exit(0)
            status = os.waitpid(child, 0)[1]
            after = files_of(killed)
            kept += sum(after.get(path) == when for path, when in before.items())
            before = after
            print(name, "ended", os.waitstatus_to_exitcode(status), flush=True)
        print(name, "kept", kept, "same" if digest(killed) == digest(whole) else "other", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
