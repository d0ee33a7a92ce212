"""A run's `mesh.glb` as ODM's clients want it: z up, in the CRS less a centre that CESIUM_RTC names.

The centre's height is zero, so that heights are those of the maps, for readers that only know it as an offset in plan,
too. The extension is not required: a reader without it shows the mesh at the zero of the CRS.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BufferedReader
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.app.node.assets.earth import Earth
from splatpipe.pipeline.engine.files.json_file import parse_json
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.engine.files.small_file import open_regular

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
HEAD, CHUNK = struct.Struct("<III"), struct.Struct("<II")
FLOAT = 5126
MAX_JSON_BYTES = 16 << 20
MAX_BYTES = (1 << 32) - 1  # of a file: glTF states lengths in 32 bits
VERTICES_AT_ONCE = 1 << 17
VERTEX_BYTES = 12
COPY_BYTES = 1 << 20
RTC = "CESIUM_RTC"
LOCAL_FROM_GLTF = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # +Y up to +Z up


class UnusableMesh(Exception):
    """A mesh that cannot be placed; its text is the reason."""


@dataclass(frozen=True)
class _Positions:
    """Vertices in the binary chunk.

    Attributes:
        accessor: Number of their accessor.
        start: Offset in the chunk.
        count: Their number.
    """

    accessor: int
    start: int
    count: int

    @property
    def stop(self) -> int:
        return self.start + self.count * VERTEX_BYTES


def plan_centre(earth: Earth, source: Path) -> tuple[float, float, float]:
    """The point in the CRS that a mesh's vertices are counted from: whole units near its middle, and height zero.

    Args:
        earth: Where the run lies.
        source: `mesh.glb`.

    Raises:
        UnusableMesh: if it is not one of ours.
        OSError: if it cannot be read.
    """
    with open_regular(source) as file:
        document, _, _ = _read_head(file)
    _positions(document)
    corners = [document["accessors"][each][end] for each in _accessors(document) for end in ("min", "max")]
    box = np.array(corners, np.float64).reshape(-1, 3) @ LOCAL_FROM_GLTF.T
    if not len(box) or not np.isfinite(box).all():
        raise UnusableMesh("it has no vertices")
    middle = (box.min(axis=0) + box.max(axis=0)) / 2.0
    x, y, _ = earth.crs.crs_from_local(middle[None])[0].tolist()
    return float(round(x)), float(round(y)), 0.0


def write_geo_glb(source: Path, target: Path, earth: Earth, centre: tuple[float, float, float]) -> None:
    """Write a mesh in the CRS; a hundred thousand vertices at a time are in memory.

    Args:
        source: `mesh.glb`: local metres, y up.
        target: Output file.
        earth: Where the run lies.
        centre: What is subtracted from the CRS's coordinates.

    Raises:
        UnusableMesh: if it is not one of ours.
        OSError: if a file cannot be read, or the disk is full.
    """
    moved = target.with_suffix(".vertices")
    try:
        with open_regular(source) as file:
            document, start, length = _read_head(file)
            places = _positions(document)
            if any(place.stop > length for place in places):
                raise UnusableMesh("it ends too early")
            with new_file(moved) as vertices:
                for place in places:
                    file.seek(start + place.start)
                    _move(file, vertices, document["accessors"][place.accessor], place.count, earth, centre)
            with moved.open("rb") as vertices, new_file(target) as made:
                _write_head(made, _placed(document, earth, centre), length)
                _copy_around(file, start, length, places, vertices, made)
    finally:
        moved.unlink(missing_ok=True)


def _read_head(file: BufferedReader) -> tuple[dict[str, Any], int, int]:
    """A file's document, and the offset and length of its binary chunk."""
    magic, version, size = _unpacked(file, HEAD)
    length, kind = _unpacked(file, CHUNK)
    if (magic, version, kind) != (MAGIC, 2, JSON_CHUNK) or length > MAX_JSON_BYTES:
        raise UnusableMesh("it is not a binary glTF 2.0 file")
    try:
        document = parse_json(file.read(length))
    except ValueError as error:
        raise UnusableMesh(f"its document cannot be read: {error}") from error
    binary_length, binary_kind = _unpacked(file, CHUNK)
    start = HEAD.size + 2 * CHUNK.size + length
    if binary_kind != BINARY_CHUNK or start + binary_length > size or not isinstance(document, dict):
        raise UnusableMesh("it has no binary chunk")
    return document, start, binary_length


def _unpacked(file: BufferedReader, layout: struct.Struct) -> tuple[int, ...]:
    data = file.read(layout.size)
    if len(data) != layout.size:
        raise UnusableMesh("it ends too early")
    return layout.unpack(data)


def _accessors(document: Mapping[str, Any]) -> list[int]:
    """Numbers of the accessors of positions."""
    primitives = [each for mesh in document["meshes"] for each in mesh["primitives"]]
    return sorted({int(each["attributes"]["POSITION"]) for each in primitives})


def _positions(document: Mapping[str, Any]) -> list[_Positions]:
    """The vertices, in the order of the chunk; they must be packed, apart from each other, and not moved by nodes."""
    try:
        found = []
        for number in _accessors(document):
            accessor = document["accessors"][number]
            view = document["bufferViews"][accessor["bufferView"]]
            layout = accessor["componentType"], accessor["type"], view.get("byteStride", VERTEX_BYTES)
            if layout != (FLOAT, "VEC3", VERTEX_BYTES) or accessor.get("sparse"):
                raise UnusableMesh("its vertices are not floats")
            start, count = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0)), int(accessor["count"])
            if min(start, count) < 0 or count * VERTEX_BYTES > int(view["byteLength"]):
                raise UnusableMesh("it ends too early")
            found.append(_Positions(number, start, count))
        moved = [
            each
            for node in document["nodes"]
            for each in ("matrix", "translation", "rotation", "scale")
            if each in node
        ]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise UnusableMesh("it is not laid out as a mesh of ours") from error
    found.sort(key=lambda place: place.start)
    if moved or any(one.stop > other.start for one, other in pairwise(found)):
        raise UnusableMesh("it is not laid out as a mesh of ours")
    return found


def _move(
    file: BufferedReader,
    vertices: BinaryIO,
    accessor: dict[str, Any],
    count: int,
    earth: Earth,
    centre: tuple[float, float, float],
) -> None:
    """Write vertices in the CRS, and their bounds into their accessor."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for batch in _batches(file, count):
        there = earth.crs.crs_from_local(batch @ LOCAL_FROM_GLTF.T) - centre
        if not np.isfinite(there).all():
            raise UnusableMesh("it has vertices that are no numbers")
        written = np.ascontiguousarray(there, "<f4")
        low, high = np.minimum(low, written.min(axis=0)), np.maximum(high, written.max(axis=0))
        vertices.write(written.data)
    if count:
        accessor["min"], accessor["max"] = low.tolist(), high.tolist()


def _batches(file: BufferedReader, count: int) -> Iterator[Float64[np.ndarray, "n 3"]]:
    for start in range(0, count, VERTICES_AT_ONCE):
        data = file.read(min(VERTICES_AT_ONCE, count - start) * VERTEX_BYTES)
        yield np.frombuffer(data, "<f4").reshape(-1, 3).astype(np.float64)


def _placed(document: dict[str, Any], earth: Earth, centre: tuple[float, float, float]) -> dict[str, Any]:
    """The document, with the centre, and the CRS in words."""
    used = [*document.get("extensionsUsed", ()), RTC]
    extensions = {**document.get("extensions", {}), RTC: {"center": list(centre)}}
    extras = {"crs": earth.crs_name, "heights": earth.crs.described_heights(), "up": "z"}
    return {
        **document,
        "asset": {**document["asset"], "extras": extras},
        "extensionsUsed": used,
        "extensions": extensions,
    }


def _write_head(made: BinaryIO, document: dict[str, Any], length: int) -> None:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = HEAD.size + 2 * CHUNK.size + len(text) + length
    if size > MAX_BYTES:
        raise UnusableMesh("it would be larger than a glTF file can be")
    made.write(HEAD.pack(MAGIC, 2, size) + CHUNK.pack(len(text), JSON_CHUNK) + text + CHUNK.pack(length, BINARY_CHUNK))


def _copy_around(
    file: BufferedReader, start: int, length: int, places: list[_Positions], vertices: BinaryIO, made: BinaryIO
) -> None:
    """Write the chunk with moved vertices in the place of the old ones."""
    at = 0
    for place in places:
        _copy(file, start + at, place.start - at, made)
        _copy(vertices, vertices.tell(), place.stop - place.start, made)
        at = place.stop
    _copy(file, start + at, length - at, made)


def _copy(source: BinaryIO, at: int, length: int, made: BinaryIO) -> None:
    source.seek(at)
    while length:
        chunk = source.read(min(length, COPY_BYTES))
        if not chunk:
            raise UnusableMesh("it ends too early")
        made.write(chunk)
        length -= len(chunk)
