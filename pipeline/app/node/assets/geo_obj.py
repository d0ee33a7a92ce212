"""A run's `mesh.obj` in the CRS less the same centre as the GLB's: for CAD and GIS, which count from an offset."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from splatpipe.pipeline.app.node.assets.earth import Earth
from splatpipe.pipeline.app.node.assets.geo_glb import UnusableMesh
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.engine.files.small_file import open_regular

VERTICES_AT_ONCE = 1 << 15
MAX_LINE_BYTES = 1 << 12
COPY_BYTES = 1 << 20
VERTEX = "v %.4f %.4f %.4f\n"  # a tenth of a millimetre, in metres


def write_geo_obj(source: Path, target: Path, earth: Earth, centre: tuple[float, float, float], materials: str) -> None:
    """Write a mesh in the CRS; some ten thousand vertices at a time are in memory.

    Args:
        source: `mesh.obj`: local metres, z up, all vertices before the rest.
        target: Output file.
        earth: Where the run lies.
        centre: What is subtracted from the CRS's coordinates.
        materials: Name of the MTL file beside it.

    Raises:
        UnusableMesh: if it is not one of ours.
        OSError: if a file cannot be read, or the disk is full.
    """
    x, y, z = centre
    head = [
        "splatpipe: a mesh, z up",
        f"crs: {earth.crs_name}",
        f"heights: {earth.crs.described_heights()}",
        f"offset: {x:.0f} {y:.0f} {z:.0f} (to be added to the coordinates)",
    ]
    with open_regular(source) as file, new_file(target) as made:
        made.write("".join(f"# {line}\n" for line in head).encode())
        made.write(f"mtllib {materials}\no mesh\n".encode())
        first = _skip_head(file)
        for batch in _batches(file, first, made):
            there = earth.crs.crs_from_local(batch) - centre
            made.write(((VERTEX * len(there)) % tuple(there.ravel().tolist())).encode())
        shutil.copyfileobj(file, made, COPY_BYTES)


def _skip_head(file: BinaryIO) -> bytes:
    """Go on to the first vertex, and return its line."""
    line = file.readline(MAX_LINE_BYTES)
    while line and not line.startswith(b"v "):
        line = file.readline(MAX_LINE_BYTES)
    if not line:
        raise UnusableMesh("it has no vertices")
    return line


def _batches(file: BinaryIO, line: bytes, made: BinaryIO) -> Iterator[np.ndarray]:
    """The vertices from a line on, a batch at a time; then the line behind them is written."""
    batch: list[bytes] = []
    while line.startswith(b"v "):
        batch.append(line)
        if len(batch) == VERTICES_AT_ONCE:
            yield _vertices(batch)
            batch = []
        line = file.readline(MAX_LINE_BYTES)
    if batch:
        yield _vertices(batch)
    made.write(line)


def _vertices(lines: list[bytes]) -> np.ndarray:
    try:
        numbers = [float(word) for line in lines for word in line.split()[1:4]]
        vertices = np.array(numbers, np.float64).reshape(len(lines), 3)
    except ValueError as error:
        raise UnusableMesh("it has vertices that are no numbers") from error
    if not np.isfinite(vertices).all():
        raise UnusableMesh("it has vertices that are no numbers")
    return vertices
