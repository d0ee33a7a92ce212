"""3D Tiles 1.1 of a georeferenced splat for CesiumJS: a tileset of LOD levels whose tiles are glTF with embedded SPZ.

Specifications: OGC 22-025r4, "3D Tiles 1.1"; Khronos, "KHR_gaussian_splatting" and its
"KHR_gaussian_splatting_compression_spz_2"; Esri's extension `ESRI_crs` (github.com/Esri/3D-tiles). What they leave open
follows CesiumJS 1.145: the tileset lists both glTF extensions as required, or its tiles are drawn as points; the
scene's first node holds the splat and a matrix; the SPZ file must use the glTF's axes, y up; there is an attribute for
each SH coefficient except the constant one, which is COLOR_0, and none for opacities.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import new_file, own_folder, write_file
from splatpipe.pipeline.splat.containers.glb_container import FLOAT, UNSIGNED_BYTE, padded, write_head
from splatpipe.pipeline.splat.containers.spz_encoder import FIRST_THREE_VERSION, spz_bytes
from splatpipe.pipeline.splat.formats.glb_splats import EXTENSION, KERNEL, RECORD, SPZ_EXTENSION, harmonics_names
from splatpipe.pipeline.splat.levels.levels import LevelNode
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Axes, Scene, SceneFacts, turn_of

TILESET = "tileset.json"
TILES = "tiles"
GLTF_CONTENT = "3DTILES_content_gltf"
ESRI_CRS = "ESRI_crs"
_STEP_M = 0.001  # step to which boxes are rounded outwards
_MIN_HALF_M = 0.001  # half side of a box: a zero one has no inverse
_TILE = re.compile(r"[0-9]+\.glb", re.ASCII)  # names of tiles
_EXTENSIONS = [EXTENSION, SPZ_EXTENSION]


@dataclass(frozen=True, eq=False)
class EsriCrs:
    """A projected CRS in which Esri software shows the tiles instead of on the globe.

    Attributes:
        wkid: Well-known ID, the EPSG code that Esri accepts; None if there is none.
        wkt: The definition (WKT 2) if there is no ID; else empty.
        vertical_wkid: ID of the vertical CRS; None if unknown, which Esri interprets as heights above some geoid.
        crs_from_local: Best-fitting affine map from local metres, z up, to the CRS's units.
    """

    wkid: int | None
    wkt: str
    vertical_wkid: int | None
    crs_from_local: Float64[np.ndarray, "4 4"]


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
    tile = _tile(root, names, scene.facts.axes, esri_crs)
    tile["transform"] = _column_major(ecef_from_local)
    if esri_crs is not None:
        tile["extensions"][ESRI_CRS]["transform"] = _column_major(esri_crs.crs_from_local)
    tileset = _tileset(tile, root, scene.facts, esri_crs)
    text = json.dumps(tileset, separators=(",", ":"), allow_nan=False)
    write_file(folder / TILESET, text)
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


def _tileset(tile: Mapping[str, Any], root: LevelNode, facts: SceneFacts, esri_crs: EsriCrs | None) -> dict[str, Any]:
    content = {"extensionsUsed": _EXTENSIONS, "extensionsRequired": _EXTENSIONS}
    extensions: dict[str, Any] = {GLTF_CONTENT: content}
    if esri_crs is not None:
        named = {"wkt2": esri_crs.wkt} if esri_crs.wkid is None else {"wkid": esri_crs.wkid}
        heights = {} if esri_crs.vertical_wkid is None else {"vcsWkid": esri_crs.vertical_wkid}
        extensions[ESRI_CRS] = named | heights
    nothing_drawn = max(root.error, float(np.linalg.norm(root.box[1] - root.box[0])))
    return {
        "asset": {"version": "1.1", "generator": "splatpipe", "extras": {RECORD: facts.record()}},
        "extensionsUsed": list(extensions),
        "extensions": extensions,
        "geometricError": nothing_drawn,
        "root": tile,
    }


def _tile(node: LevelNode, names: Mapping[LevelNode, str], axes: Axes, esri_crs: EsriCrs | None) -> dict[str, Any]:
    """The tileset's entry for a node and all below it: z up, unlike their glTF."""
    volume = {"box": _box(box_z_up(node.box, axes))}
    tile: dict[str, Any] = {"boundingVolume": volume, "geometricError": float(node.error), "refine": "REPLACE"}
    if node in names:
        tile["content"] = {"uri": names[node]}
    if esri_crs is not None:
        tile["extensions"] = {ESRI_CRS: {"boundingVolume": volume}}
    if node.children:
        tile["children"] = [_tile(child, names, axes, esri_crs) for child in node.children]
    return tile


def _box(box: Float64[np.ndarray, "2 3"]) -> list[float]:
    """Centre and half axes of the box, rounded outwards."""
    steps = np.stack([np.floor(box[0] / _STEP_M), np.ceil(box[1] / _STEP_M)])
    centre = np.round(steps.mean(axis=0) * _STEP_M, 6)
    half = np.round(np.maximum((steps[1] - steps[0]) * (_STEP_M / 2.0), _MIN_HALF_M), 6)
    return [*centre.tolist(), *np.diag(half).ravel().tolist()]


def _column_major(matrix: Float64[np.ndarray, "4 4"]) -> list[float]:
    return [float(value) for value in matrix.ravel(order="F")]


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
        "nodes": [{"mesh": 0, "matrix": _column_major(matrix)}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [{"count": len(gaussians), **kind} for kind in kinds.values()],
        "bufferViews": [{"buffer": 0, "byteLength": spz_size}],
        "buffers": [{"byteLength": padded(spz_size)}],
    }
