"""Measure CPU seconds of surface model and orthophoto per million cells: ``surface_speed --depths FOLDER``.

FOLDER is written by ``python -m splatpipe.demo.truth.depth_maps`` (extra ``demo``): depth maps of the demo's photos,
true or with errors (``--noise``), and beside the true ones the undistorted photos. A part of the plot around the house
is processed on one thread; nearly all photos see all of it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from tables import Row, print_table

from splatpipe.demo.truth.depth_maps import load
from splatpipe.pipeline.surface.depths.exposures import exposure_levels
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.sources import DepthSource, HeightRange, LruCache, MetricMap
from splatpipe.pipeline.surface.heights.height_field import HeightField
from splatpipe.pipeline.surface.heights.heights import TILE as HEIGHTS_TILE
from splatpipe.pipeline.surface.heights.heights import HeightInput, surface_heights
from splatpipe.pipeline.surface.ortho.orthophoto import TILE, OrthoInput, orthophotos
from splatpipe.pipeline.surface.rasters.lattice import Lattice

GSD_M = 0.028  # ground sample distance of the original photos at the house
HALF_M = 9.0  # half the side of the part
RELIEF = HeightRange(-2.0, 14.0)
CACHE_BYTES = 1 << 30
EVERY = 5  # spacing, in cells of the surface model, of the places where exposures are compared
FIGURES = {"what": "what:", "cells": "cells:,", "CPU s": "cpu:.2f", "s a million": "million:.1f", "known": "known:.4f"}
Result = TypeVar("Result")


def lattice_of(cell_m: float) -> Lattice:
    """Return the part's lattice with a given cell size."""
    side = round(2.0 * HALF_M / cell_m)
    return Lattice(-HALF_M, HALF_M, cell_m, side, side)


def timed(make: Callable[[], Result]) -> tuple[Result, float]:
    """Return a function's result and the CPU seconds that it took."""
    start = time.process_time()
    return make(), time.process_time() - start


def heights_of(sources: list[DepthSource], lattice: Lattice) -> HeightField:
    """Compute the surface model."""
    height = np.full((lattice.height, lattice.width), np.nan, np.float32)
    capture = HeightInput(sources, lattice, RELIEF, LruCache(CACHE_BYTES))
    for part in surface_heights(capture, list(lattice.tiles(HEIGHTS_TILE)), threads=1):
        height[part.tile.slices] = part.height
    return HeightField(lattice, height)


def coloured(photos: list[PhotoSource], surface: HeightField, lattice: Lattice) -> float:
    """Compute an orthophoto and return the share of its pixels that have a colour."""
    centres = surface.lattice.centres(next(surface.lattice.tiles(surface.lattice.width)))
    places = np.concatenate([centres, surface.height[..., None].astype(np.float64)], axis=-1)
    places = places[::EVERY, ::EVERY].reshape(-1, 3)
    levels = exposure_levels(photos, places[np.isfinite(places[:, 2])], 2.0 * lattice.cell_m, threads=1)
    album = OrthoInput(photos, surface, lattice, RELIEF, levels, LruCache(CACHE_BYTES), LruCache(CACHE_BYTES))
    tiles = list(lattice.tiles(TILE))
    known = sum(int(part.known.sum()) for part in orthophotos(album, tiles, threads=1))
    return known / (lattice.width * lattice.height)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depths", type=Path, required=True, help="depth maps")
    parser.add_argument("--photos", type=Path, help="the photos that they are of, where those lie elsewhere")
    parser.add_argument("--gsd", type=float, default=GSD_M, help="metres of a pixel; of a cell twice as much")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    photos = []
    for path in sorted(arguments.depths.glob("*.npz")):
        found = MetricMap(*load(path))
        pixels = cv2.imread(str((arguments.photos or arguments.depths) / f"{path.stem}.png"))[..., ::-1].copy()
        depths = DepthSource(found.camera, lambda found=found: found)
        photos.append(PhotoSource(found.camera, lambda pixels=pixels: pixels, depths))
    cells, fine = lattice_of(2.0 * arguments.gsd), lattice_of(arguments.gsd)
    surface, cpu = timed(lambda: heights_of([photo.depths for photo in photos if photo.depths], cells))
    known = float(np.isfinite(surface.height).mean())
    rows = [_row("surface model", cells, cpu, known)]
    share, cpu = timed(lambda: coloured(photos, surface, fine))
    print_table(f"{len(photos)} photos", [*rows, _row("orthophoto", fine, cpu, share)], FIGURES)


def _row(what: str, lattice: Lattice, cpu_s: float, known: float) -> Row:
    count = lattice.width * lattice.height
    return {"what": what, "cells": count, "cpu": cpu_s, "million": cpu_s / count * 1e6, "known": known}


if __name__ == "__main__":
    main()
