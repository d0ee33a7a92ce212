"""A textured mesh as binary glTF 2.0, y up: one primitive and one JPEG per page, inside of the file.

The material is unlit because the photos already contain the lighting (KHR_materials_unlit).
"""

from __future__ import annotations

import json
import shutil
import struct
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt32

from splatpipe.pipeline.delivery.sparse_scene import GLTF_FROM_WORLD
from splatpipe.pipeline.surface.shapes.triangles import TriangleMesh
from splatpipe.pipeline.surface.texture.textured_mesh import Atlas, TexturedMesh

FLOAT, UNSIGNED_INT = 5126, 5125  # glTF's component types
ARRAY, ELEMENTS = 34962, 34963  # what its buffers are for
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
MAX_BYTES = (1 << 32) - 1  # of a file: glTF states lengths in 32 bits
UNLIT = "KHR_materials_unlit"


@dataclass(frozen=True, eq=False)
class PageMesh:
    """The triangles of a page, with a vertex for each chart that a mesh's vertex is in.

    Attributes:
        vertices: East, north, up, metres.
        uv: Texture coordinates, 0 to 1; v goes down.
        triangles: Three indices each.
        vertex: Index of each vertex in the mesh.
        face: Row of each triangle in the mesh.
    """

    vertices: Float64[np.ndarray, "n 3"]
    uv: Float32[np.ndarray, "n 2"]
    triangles: UInt32[np.ndarray, "m 3"]
    vertex: Int64[np.ndarray, " n"]
    face: Int64[np.ndarray, " m"]


def split_corners(mesh: TriangleMesh, atlas: Atlas, page: int) -> PageMesh:
    """Take the triangles of a page, and split vertices between charts.

    Corners of one chart at one vertex have one place in the page, except in charts of unseen triangles, which share
    nothing.
    """
    face = np.flatnonzero(atlas.page() == page)
    corner = mesh.triangles[face].ravel()
    place = atlas.corners[face].reshape(-1, 2)
    keys = np.empty(len(corner), np.dtype([("vertex", "<i8"), ("column", "<f4"), ("row", "<f4")]))
    keys["vertex"], keys["column"], keys["row"] = corner, place[:, 0], place[:, 1]
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    uv = place[first].astype(np.float64) / atlas.sizes[page]
    triangles = index.reshape(-1, 3).astype(np.uint32)
    return PageMesh(mesh.vertices[corner[first]], uv.astype(np.float32), triangles, corner[first], face)


def write_glb(file: BinaryIO, made: TexturedMesh) -> None:
    """Write a textured mesh.

    Args:
        file: Output.
        made: The mesh; its pages are copied, one after the other.

    Raises:
        OSError: if the disk is full, or a page cannot be read.
        ValueError: if the file would be larger than glTF allows.
    """
    parts = [split_corners(made.coloured.mesh, made.atlas, page) for page in range(len(made.pages))]
    arrays = [array for part in parts for array in _arrays(part)]
    images = [page.stat().st_size for page in made.pages]
    lengths = [array.nbytes for array in arrays] + images
    starts = np.concatenate([[0], np.cumsum([length + -length % 4 for length in lengths])]).tolist()
    text = json.dumps(_scene(parts, lengths, starts), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + starts[-1]
    if size > MAX_BYTES:
        raise ValueError(f"a glTF file of {size:,} bytes")
    file.write(struct.pack("<III", MAGIC, 2, size) + struct.pack("<II", len(text), JSON_CHUNK) + text)
    file.write(struct.pack("<II", starts[-1], BINARY_CHUNK))
    for array in arrays:
        file.write(array.data)
    for page, length in zip(made.pages, images, strict=True):
        with page.open("rb") as image:
            shutil.copyfileobj(image, file)
        file.write(b"\0" * (-length % 4))


def _arrays(part: PageMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    positions = np.ascontiguousarray(part.vertices @ GLTF_FROM_WORLD.T, "<f4")
    return positions, np.ascontiguousarray(part.uv, "<f4"), np.ascontiguousarray(part.triangles, "<u4")


def _scene(parts: list[PageMesh], lengths: list[int], starts: list[int]) -> dict[str, Any]:
    """The glTF JSON of pages whose arrays, and then images, are consecutive in one buffer."""
    accessors: list[dict[str, Any]] = []
    for number, part in enumerate(parts):
        positions, uv, triangles = _arrays(part)
        low, high = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
        view = 3 * number
        accessors += [
            {
                "bufferView": view,
                "componentType": FLOAT,
                "count": len(positions),
                "type": "VEC3",
                "min": low,
                "max": high,
            },
            {"bufferView": view + 1, "componentType": FLOAT, "count": len(uv), "type": "VEC2"},
            {"bufferView": view + 2, "componentType": UNSIGNED_INT, "count": triangles.size, "type": "SCALAR"},
        ]
    pages = range(len(parts))
    targets = [ARRAY, ARRAY, ELEMENTS] * len(parts)
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": length} for start, length in zip(starts, lengths, strict=False)
    ]
    for view, target in zip(views, targets, strict=False):
        view["target"] = target
    return {
        "asset": {"version": "2.0", "generator": "splatpipe"},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "mesh", "mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 3 * page, "TEXCOORD_0": 3 * page + 1},
                        "indices": 3 * page + 2,
                        "material": page,
                        "mode": 4,
                    }
                    for page in pages
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": page},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "doubleSided": True,
                "extensions": {UNLIT: {}},
            }
            for page in pages
        ],
        "textures": [{"sampler": 0, "source": page} for page in pages],
        "samplers": [
            {"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
        ],
        "images": [{"bufferView": 3 * len(parts) + page, "mimeType": "image/jpeg"} for page in pages],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
