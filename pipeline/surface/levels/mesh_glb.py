"""A part of a textured mesh as binary glTF, y up: positions, places in the texture, indices, a JPEG.

The material is unlit because the photos already contain the lighting (KHR_materials_unlit).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.splat.containers.glb_container import FLOAT, UNSIGNED_INT, UNSIGNED_SHORT, padded, write_head
from splatpipe.pipeline.surface.levels.charted_mesh import ChartedMesh
from splatpipe.pipeline.surface.levels.mesh_texture import PackedTexture

ARRAY, ELEMENTS = 34962, 34963  # what buffer views are for
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
MAX_SHORT_INDEX = 65_534  # 65,535 restarts primitives
UNLIT = "KHR_materials_unlit"
GLTF_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def write_part(path: Path, mesh: ChartedMesh, places: Float32[np.ndarray, "n 3"], texture: PackedTexture) -> None:
    """Write a GLB.

    Args:
        path: Output file.
        mesh: The part.
        places: East, north, up of all vertices about the tileset's origin: the same numbers in each part, so that
            parts meet without a gap.
        texture: Its texture.

    Raises:
        OSError: if the disk is full or not writable.
    """
    first, indices = mesh.wedges()
    positions = (places[mesh.triangles.ravel()[first]] @ GLTF_FROM_Z_UP.T.astype(np.float32)).astype("<f4")
    uv = texture.uv.reshape(-1, 2)[first].astype("<f4")
    number = np.dtype("<u2" if len(first) <= MAX_SHORT_INDEX else "<u4")
    parts = [positions.tobytes(), uv.tobytes(), indices.astype(number).tobytes(), texture.jpeg]
    lengths = [len(part) for part in parts]
    document = _document(positions, indices.size, number, lengths)
    with new_file(path) as file:
        write_head(file, document, sum(padded(length) for length in lengths))
        for part in parts:
            file.write(part + b"\0" * (padded(len(part)) - len(part)))


def _document(
    positions: Float32[np.ndarray, "n 3"], indices: int, number: np.dtype, lengths: list[int]
) -> dict[str, Any]:
    starts = np.concatenate([[0], np.cumsum([padded(length) for length in lengths])]).tolist()
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": length} for start, length in zip(starts, lengths, strict=False)
    ]
    for view, target in zip(views, (ARRAY, ARRAY, ELEMENTS), strict=False):
        view["target"] = target
    box = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    index_type = UNSIGNED_SHORT if number.itemsize == 2 else UNSIGNED_INT
    return {
        "asset": {"version": "2.0", "generator": "splatpipe"},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "doubleSided": True,
                "extensions": {UNLIT: {}},
            }
        ],
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [
            {
                "magFilter": LINEAR,
                "minFilter": LINEAR_MIPMAP_LINEAR,
                "wrapS": CLAMP_TO_EDGE,
                "wrapT": CLAMP_TO_EDGE,
            }
        ],
        "images": [{"bufferView": 3, "mimeType": "image/jpeg"}],
        "accessors": [
            {"bufferView": 0, "componentType": FLOAT, "count": len(positions), "type": "VEC3", **box},
            {"bufferView": 1, "componentType": FLOAT, "count": len(positions), "type": "VEC2"},
            {"bufferView": 2, "componentType": index_type, "count": indices, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
