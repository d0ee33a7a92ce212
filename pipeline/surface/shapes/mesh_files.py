"""A mesh as binary glTF for viewers and as PLY for other programs, in local metres, with its georeference.

glTF's vertex colours are linear (glTF 2.0, section 3.7.2.1); 8 bits are too few for shadows, so they have 16. The
material is unlit because the photos already contain the lighting (KHR_materials_unlit). PLY's colours are sRGB, as
usual.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from splatpipe.pipeline.delivery.delivery_frame import facts_of, georef_facts
from splatpipe.pipeline.delivery.sparse_scene import GLTF_FROM_WORLD
from splatpipe.pipeline.engine.durable import whole_file
from splatpipe.pipeline.engine.json_file import write_json
from splatpipe.pipeline.engine.output_file import new_file
from splatpipe.pipeline.splat.formats.plain_ply import frame_comments
from splatpipe.pipeline.surface.depths.photo_samples import linear_light
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh
from splatpipe.pipeline.survey.crs.frames import Frame

FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125  # glTF's component types
ARRAY, ELEMENTS = 34962, 34963  # what its buffers are for
MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
MAX_SHORT = 65535
UNLIT = "KHR_materials_unlit"


def write_mesh(folder: Path, made: ColouredMesh, frame: Frame, boundary: Path | None) -> None:
    """Write `mesh.glb`, `mesh.ply` and `georef.json`, which georeferences them, into a folder.

    Args:
        folder: Output folder.
        made: The mesh in the frame's local metres.
        frame: The run's frame from georef.
        boundary: `georef.boundary`; None if the run has none.

    Raises:
        OSError: if the disk is full or not writable.
    """
    with whole_file(folder / "mesh.glb") as aside, new_file(aside) as file:
        _write_glb(file, made)
    with whole_file(folder / "mesh.ply") as aside, new_file(aside) as file:
        _write_ply(file, made, frame_comments(facts_of(frame, antialias=False)))
    vertices = made.mesh.vertices
    box = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    write_json(folder / "georef.json", georef_facts(frame, box, boundary))


def _write_glb(file: BinaryIO, made: ColouredMesh) -> None:
    positions = (made.mesh.vertices @ GLTF_FROM_WORLD.T).astype("<f4")
    light = np.round(linear_light(made.colours / 255.0) * MAX_SHORT).astype("<u2")
    colours = np.column_stack([light, np.full(len(light), MAX_SHORT, "<u2")])  # 8 bytes a vertex: aligned
    triangles = made.mesh.triangles.astype("<u4")
    arrays = (positions, colours, triangles)
    text = json.dumps(_scene(*arrays), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = sum(each.nbytes for each in arrays)
    size = 12 + 8 + len(text) + 8 + length  # whole multiples of 4, all of them
    file.write(struct.pack("<III", MAGIC, 2, size) + struct.pack("<II", len(text), JSON_CHUNK) + text)
    file.write(struct.pack("<II", length, BINARY_CHUNK))
    for each in arrays:
        file.write(np.ascontiguousarray(each).data)


def _scene(positions: np.ndarray, colours: np.ndarray, triangles: np.ndarray) -> dict[str, Any]:
    """The glTF JSON of a mesh whose arrays are consecutive in one buffer."""
    lengths = [each.nbytes for each in (positions, colours, triangles)]
    starts = np.concatenate([[0], np.cumsum(lengths)]).tolist()
    return {
        "asset": {"version": "2.0", "generator": "splatpipe"},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "mesh", "mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0, "mode": 4}]}
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "doubleSided": True,
                "extensions": {UNLIT: {}},
            }
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": FLOAT,
                "count": len(positions),
                "type": "VEC3",
                "min": positions.min(axis=0).tolist(),
                "max": positions.max(axis=0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": UNSIGNED_SHORT,
                "normalized": True,
                "count": len(colours),
                "type": "VEC4",
            },
            {"bufferView": 2, "componentType": UNSIGNED_INT, "count": triangles.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": length, "target": target}
            for start, length, target in zip(starts, lengths, (ARRAY, ARRAY, ELEMENTS), strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }


def _write_ply(file: BinaryIO, made: ColouredMesh, comments: Sequence[str]) -> None:
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(made.mesh.vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(made.mesh.triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    file.write(("\n".join(header) + "\n").encode())
    vertices = np.empty(len(made.mesh.vertices), np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    vertices["xyz"], vertices["rgb"] = made.mesh.vertices, made.colours
    faces = np.empty(len(made.mesh.triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, made.mesh.triangles
    file.write(vertices.data)
    file.write(faces.data)
