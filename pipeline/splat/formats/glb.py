"""GLB: binary glTF with `KHR_gaussian_splatting`, uncompressed, y up.

Specification: Khronos, "KHR_gaussian_splatting" (ratified): points whose attributes are rotations (x, y, z, w), linear
scales, opacities and spherical harmonics in the order and with the signs of 3D Gaussian splatting. Position on the
earth and edits are in the string `splatpipe` in `asset.extras`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.splat.containers.bounded import CheckValues, check_values, open_file
from splatpipe.pipeline.splat.containers.glb_container import FLOAT, UNSIGNED_BYTE, open_container, write_head
from splatpipe.pipeline.splat.formats.glb_splats import (
    EXTENSION,
    KERNEL,
    RECORD,
    ROWS_AT_ONCE,
    harmonics_names,
    read_splats,
)
from splatpipe.pipeline.splat.formats.near_origin import scene_near_origin
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.position_cost import PositionCost, float32_cost
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, facts_of_record, turn_of
from splatpipe.pipeline.splat.model.sh import C0, multiply_rows

_ARRAY_BUFFER, _POINTS = 34962, 0


def write(path: Path, scene: Scene) -> PositionCost:
    """Write a scene y up, in bounded memory.

    Args:
        path: The file; replaced if it exists.
        scene: The scene.

    Raises:
        SplatpipeError: if it is empty, larger than a GLB can be (4.3 GB), or a Gaussian is larger than float32 holds.
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    gaussians = scene.gaussians
    count = len(gaussians)
    if not count:
        raise SplatpipeError("A GLB needs at least one Gaussian.", hint="Crop less.")
    if not bool(gaussians.finite().all()):
        raise ValueError("a GLB holds finite numbers only")
    facts = scene.facts.turned("y up")
    turn = turn_of("y up", scene.facts.axes)
    columns = _columns(gaussians.sh_degree)
    starts = np.cumsum([0, *(count * column.row_bytes for column in columns)]).tolist()
    with new_file(path) as file:
        write_head(file, _document(columns, starts, count, _bounds(gaussians, turn), facts.record()), starts[-1])
        first, done = file.tell(), 0
        for piece in gaussians.pieces(ROWS_AT_ONCE):
            for column, start, rows in zip(columns, starts, _rows(_turned(piece, turn)), strict=False):
                file.seek(first + start + done * column.row_bytes)
                file.write(rows.tobytes())
            done += len(piece)
    return float32_cost(gaussians)


def read(path: Path, check: CheckValues = check_values) -> Scene:
    """Read a file, y up; without a record of ours it is not georeferenced.

    Raises:
        SplatpipeError: if the file is missing, truncated, not a splat, damaged, or requires something unsupported.
    """
    with open_file(path) as file:
        container = open_container(path, file)
        gaussians = read_splats(container, check)
    check(path, gaussians)
    facts = facts_of_record(_record(container.document), SceneFacts("y up"))
    return scene_near_origin(path, gaussians, replace(facts, axes="y up"))


def _record(document: Mapping[str, Any]) -> str | None:
    asset = document.get("asset")
    extras = asset.get("extras") if isinstance(asset, dict) else None
    record = extras.get(RECORD) if isinstance(extras, dict) else None
    return record if isinstance(record, str) else None


@dataclass(frozen=True)
class _Column:
    """An attribute to write; its rows are multiples of 4 bytes."""

    name: str
    kind: str
    component: int
    row_bytes: int


def _columns(sh_degree: int) -> list[_Column]:
    columns = [
        _Column("POSITION", "VEC3", FLOAT, 12),
        _Column("COLOR_0", "VEC4", UNSIGNED_BYTE, 4),
        _Column(f"{EXTENSION}:ROTATION", "VEC4", FLOAT, 16),
        _Column(f"{EXTENSION}:SCALE", "VEC3", FLOAT, 12),
        _Column(f"{EXTENSION}:OPACITY", "SCALAR", FLOAT, 4),
    ]
    return columns + [_Column(name, "VEC3", FLOAT, 12) for name in harmonics_names(sh_degree)]


def _rows(gaussians: Gaussians) -> Iterator[np.ndarray]:
    """The columns' rows, y up."""
    opacities = torch.sigmoid(gaussians.opacity_logits.double())
    rgba = torch.cat([0.5 + C0 * gaussians.sh[:, 0].double(), opacities[:, None]], dim=1)
    quats = gaussians.quats[:, [1, 2, 3, 0]].double()
    lengths = torch.linalg.vector_norm(quats, dim=1, keepdim=True)
    identity = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    scales = torch.exp(gaussians.log_scales.double()).float()
    if not bool(torch.isfinite(scales).all()):
        raise SplatpipeError("Gaussians are larger than a GLB can store.", hint="Clean the splat: splatpipe edit.")
    yield gaussians.means.numpy().astype("<f4")
    yield torch.round(255.0 * rgba.clamp(0.0, 1.0)).to(torch.uint8).numpy()
    yield torch.where(lengths > 0.0, quats / lengths.clamp(min=1e-300), identity).numpy().astype("<f4")
    yield scales.numpy().astype("<f4")
    yield opacities.numpy().astype("<f4")
    for term in range(gaussians.sh.shape[1]):
        yield gaussians.sh[:, term].numpy().astype("<f4")


def _turned(gaussians: Gaussians, turn: torch.Tensor) -> Gaussians:
    if torch.equal(turn, torch.eye(3, dtype=torch.float64)):
        return gaussians
    return gaussians.transformed(1.0, turn, torch.zeros(3, dtype=torch.float64))


def _bounds(gaussians: Gaussians, turn: torch.Tensor) -> Float32[np.ndarray, "2 3"]:
    """Bit-exact minimum and maximum of the positions as written, as validators require."""
    lowest, highest = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
    for piece in gaussians.pieces(ROWS_AT_ONCE):
        means = multiply_rows(turn, piece.means.double()).float().numpy()
        lowest, highest = np.minimum(lowest, means.min(axis=0)), np.maximum(highest, means.max(axis=0))
    return np.stack([lowest, highest])


def _document(
    columns: list[_Column], starts: list[int], count: int, bounds: Float32[np.ndarray, "2 3"], record: str
) -> dict[str, Any]:
    """The glTF JSON for consecutive columns."""
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": count * column.row_bytes, "target": _ARRAY_BUFFER}
        for column, start in zip(columns, starts, strict=False)
    ]
    accessors: list[dict[str, Any]] = [
        {"bufferView": view, "componentType": column.component, "count": count, "type": column.kind}
        for view, column in enumerate(columns)
    ]
    accessors[0] |= {"min": bounds[0].tolist(), "max": bounds[1].tolist()}
    accessors[1]["normalized"] = True
    attributes = {column.name: index for index, column in enumerate(columns)}
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: KERNEL}}
    return {
        "asset": {"version": "2.0", "generator": "splatpipe", "extras": {RECORD: record}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
