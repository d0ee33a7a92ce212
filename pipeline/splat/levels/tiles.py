"""3D Tiles 1.1 of a georeferenced splat for CesiumJS: a tileset of LOD levels whose tiles are glTF with embedded SPZ.

Specifications: those of `tileset.py`; Khronos, "KHR_gaussian_splatting" and its
"KHR_gaussian_splatting_compression_spz_2". What they leave open follows CesiumJS 1.145: the tileset lists both glTF
extensions as required, or its tiles are drawn as points; the scene's first node holds the splat and a matrix; the SPZ
file must use the glTF's axes, y up; there is an attribute for each SH coefficient except the constant one, which is
COLOR_0, and none for opacities.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import new_file, own_folder, write_file
from splatpipe.pipeline.splat.containers.glb_container import FLOAT, UNSIGNED_BYTE, padded, write_head
from splatpipe.pipeline.splat.containers.spz_encoder import FIRST_THREE_VERSION, spz_bytes
from splatpipe.pipeline.splat.formats.glb_splats import EXTENSION, KERNEL, SPZ_EXTENSION, harmonics_names
from splatpipe.pipeline.splat.levels.levels import LevelNode
from splatpipe.pipeline.splat.levels.tileset import TILESET, EsriCrs, TilesetTile, column_major, tileset_text
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Axes, Scene, SceneFacts, turn_of

TILES = "tiles"
GLTF_CONTENT = "3DTILES_content_gltf"
_TILE = re.compile(r"[0-9]+\.glb", re.ASCII)  # names of tiles
_EXTENSIONS = [EXTENSION, SPZ_EXTENSION]


def write_tiles(
    folder: Path,
    scene: Scene,
    root: LevelNode,
    ecef_from_local: Float64[np.ndarray, "4 4"],
    esri_crs: EsriCrs | None = None,
) -> None:
    """Write `tileset.json` and a tile for each node; deterministic.

    Every tile has its own origin, so that SPZ's 24-bit positions are accurate to a millimetre in a site that is
    kilometres across.

    Args:
        folder: Created if missing; tiles of an earlier tileset are replaced or deleted, other files stay.
        scene: The scene of the levels; its metadata goes into the tileset.
        root: Root of its levels of detail, in its frame.
        ecef_from_local: Rigid transform of the scene, turned to z up, to earth-centred coordinates (EPSG:4978), metres.
        esri_crs: CRS for Esri software; None for the globe only.

    Raises:
        SplatpipeError: if the scene is not georeferenced.
        ValueError: if a value is not finite.
        OSError: if a file cannot be written.
    """
    require_georeference(scene.facts)
    own_folder(folder, TILES)
    names: dict[LevelNode, str] = {}
    for number, node in enumerate(root.nodes()):
        if len(node.gaussians):
            names[node] = f"{TILES}/{number}.glb"
            _write_tile(folder / names[node], node.gaussians, scene.facts)
    tile = _tile(root, names, scene.facts.axes)
    content = {GLTF_CONTENT: {"extensionsUsed": _EXTENSIONS, "extensionsRequired": _EXTENSIONS}}
    write_file(folder / TILESET, tileset_text(tile, ecef_from_local, esri_crs, scene.facts, content))
    _drop_earlier(folder, set(names.values()))


def _drop_earlier(folder: Path, named: Set[str]) -> None:
    """Delete tiles that the tileset no longer references."""
    for path in sorted((folder / TILES).iterdir()):
        if _TILE.fullmatch(path.name) and f"{TILES}/{path.name}" not in named:
            path.unlink()


def require_georeference(facts: SceneFacts) -> None:
    """Check that a scene is georeferenced, as tiles require.

    Raises:
        SplatpipeError: if it is not.
    """
    if facts.place is None:
        raise SplatpipeError(
            "3D Tiles need a georeferenced splat, and this one is not.",
            hint="Georeference its run (GPS in the photos, --geo or --gcp), or choose glb, spz or ply.",
        )


def box_z_up(box: Float64[np.ndarray, "2 3"], axes: Axes) -> Float64[np.ndarray, "2 3"]:
    """A box of a scene's frame, turned to east, north, up.

    Args:
        box: Lowest and highest corner.
        axes: Axes of the scene's frame.
    """
    corners = box @ turn_of("z up", axes).numpy().T
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def _tile(node: LevelNode, names: Mapping[LevelNode, str], axes: Axes) -> TilesetTile:
    """The tileset's entry for a node and all below it: z up, unlike their glTF."""
    children = tuple(_tile(child, names, axes) for child in node.children)
    return TilesetTile(box_z_up(node.box, axes), float(node.error), names.get(node), children)


def _write_tile(path: Path, gaussians: Gaussians, facts: SceneFacts) -> None:
    """Write a tile: glTF, y up, about its own origin, whose only data are an SPZ file of version 2."""
    turn = turn_of("y up", facts.axes)
    origin = np.rint((gaussians.means.amin(dim=0) + gaussians.means.amax(dim=0)).double().numpy() / 2.0)
    means = (gaussians.means.double() - torch.from_numpy(origin)).float()
    about = replace(gaussians, means=means)
    spz = spz_bytes(about, facts.antialias, turn=turn, version=FIRST_THREE_VERSION)
    corners = np.stack([means.amin(dim=0).numpy(), means.amax(dim=0).numpy()]).astype(np.float64) @ turn.numpy().T
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    matrix = np.eye(4)
    matrix[:3, 3] = turn.numpy() @ origin
    with new_file(path) as file:
        write_head(file, _document(about, matrix, bounds, len(spz)), padded(len(spz)))
        file.write(spz + b"\0" * (padded(len(spz)) - len(spz)))


def _document(
    gaussians: Gaussians, matrix: Float64[np.ndarray, "4 4"], bounds: Float64[np.ndarray, "2 3"], spz_size: int
) -> dict[str, Any]:
    """The glTF JSON: accessors without data, which comes from the SPZ file."""
    kinds = {
        "POSITION": {"componentType": FLOAT, "type": "VEC3", "min": bounds[0].tolist(), "max": bounds[1].tolist()},
        "COLOR_0": {"componentType": UNSIGNED_BYTE, "type": "VEC4", "normalized": True},
        f"{EXTENSION}:SCALE": {"componentType": FLOAT, "type": "VEC3"},
        f"{EXTENSION}:ROTATION": {"componentType": FLOAT, "type": "VEC4"},
    }
    harmonics = harmonics_names(gaussians.sh_degree)[1:]  # the constant one is COLOR_0
    kinds |= {name: {"componentType": FLOAT, "type": "VEC3"} for name in harmonics}
    inside = {SPZ_EXTENSION: {"bufferView": 0}}
    primitive = {
        "attributes": {name: index for index, name in enumerate(kinds)},
        "mode": 0,
        "extensions": {EXTENSION: {**KERNEL, "extensions": inside}},
    }
    return {
        "asset": {"version": "2.0", "generator": "splatpipe"},
        "extensionsUsed": _EXTENSIONS,
        "extensionsRequired": _EXTENSIONS,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": column_major(matrix)}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [{"count": len(gaussians), **kind} for kind in kinds.values()],
        "bufferViews": [{"buffer": 0, "byteLength": spz_size}],
        "buffers": [{"byteLength": padded(spz_size)}],
    }
