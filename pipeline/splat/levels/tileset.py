"""`tileset.json` of 3D Tiles 1.1: a tree of tiles in local metres, z up, placed on the earth by its root.

Specifications: OGC 22-025r4, "3D Tiles 1.1"; Esri's extension `ESRI_crs` (github.com/Esri/3D-tiles).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.splat.formats.glb_splats import RECORD
from splatpipe.pipeline.splat.model.scene import SceneFacts

TILESET = "tileset.json"
ESRI_CRS = "ESRI_crs"
_STEP_M = 0.001  # step to which boxes are rounded outwards
_MIN_HALF_M = 0.001  # half side of a box: a zero one has no inverse


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

    def moved(self, local_from_tiles: Float64[np.ndarray, "4 4"]) -> EsriCrs:
        """The same for tiles whose frame lies elsewhere in the local one."""
        return replace(self, crs_from_local=self.crs_from_local @ local_from_tiles)


@dataclass(frozen=True, eq=False)
class TilesetTile:
    """A tile and all below it.

    Attributes:
        box: Least and largest east, north, up of what is in it and below it, local metres.
        error: Its geometric error: by how much it misses what it shows, metres.
        uri: Its content, relative to the tileset; None if it has none.
        children: The tiles that replace it.
    """

    box: Float64[np.ndarray, "2 3"]
    error: float
    uri: str | None
    children: tuple[TilesetTile, ...]


def tileset_text(
    root: TilesetTile,
    ecef_from_local: Float64[np.ndarray, "4 4"],
    esri_crs: EsriCrs | None,
    facts: SceneFacts,
    extensions: Mapping[str, Any],
) -> str:
    """The tileset as JSON text.

    Args:
        root: The tree.
        ecef_from_local: Its place on the earth, from local metres to EPSG:4978.
        esri_crs: The CRS for Esri's programs; None without one.
        facts: The georeference, which is recorded in it.
        extensions: The tileset's extensions by name, besides Esri's.

    Raises:
        ValueError: if a number is not finite.
    """
    tile = _entry(root, esri_crs)
    tile["transform"] = column_major(ecef_from_local)
    named = dict(extensions)
    if esri_crs is not None:
        tile["extensions"][ESRI_CRS]["transform"] = column_major(esri_crs.crs_from_local)
        code = {"wkt2": esri_crs.wkt} if esri_crs.wkid is None else {"wkid": esri_crs.wkid}
        heights = {} if esri_crs.vertical_wkid is None else {"vcsWkid": esri_crs.vertical_wkid}
        named[ESRI_CRS] = code | heights
    nothing_drawn = max(root.error, float(np.linalg.norm(root.box[1] - root.box[0])))
    tileset = {
        "asset": {"version": "1.1", "generator": "splatpipe", "extras": {RECORD: facts.record()}},
        **({"extensionsUsed": list(named), "extensions": named} if named else {}),
        "geometricError": nothing_drawn,
        "root": tile,
    }
    return json.dumps(tileset, separators=(",", ":"), allow_nan=False)


def _entry(tile: TilesetTile, esri_crs: EsriCrs | None) -> dict[str, Any]:
    volume = {"box": _box(tile.box)}
    entry: dict[str, Any] = {"boundingVolume": volume, "geometricError": tile.error, "refine": "REPLACE"}
    if tile.uri is not None:
        entry["content"] = {"uri": tile.uri}
    if esri_crs is not None:
        entry["extensions"] = {ESRI_CRS: {"boundingVolume": volume}}
    if tile.children:
        entry["children"] = [_entry(child, esri_crs) for child in tile.children]
    return entry


def _box(box: Float64[np.ndarray, "2 3"]) -> list[float]:
    """Centre and half axes of the box, rounded outwards."""
    steps = np.stack([np.floor(box[0] / _STEP_M), np.ceil(box[1] / _STEP_M)])
    centre = np.round(steps.mean(axis=0) * _STEP_M, 6)
    half = np.round(np.maximum((steps[1] - steps[0]) * (_STEP_M / 2.0), _MIN_HALF_M), 6)
    return [*centre.tolist(), *np.diag(half).ravel().tolist()]


def column_major(matrix: Float64[np.ndarray, "4 4"]) -> list[float]:
    """A 4×4 as JSON lists it."""
    return [float(value) for value in matrix.ravel(order="F")]
