"""Read a binary glTF of splats from its specification, without our own reader, and compare two of them."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float64

from splatpipe.pipeline.splat.model.sh import rotate_sh

PREFIX = "KHR_gaussian_splatting:"
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {5126: "<f4", 5121: "u1", 5123: "<u2", 5125: "<u4"}
HALF_TURN = np.diag([-1.0, 1.0, -1.0])
"""About glTF's vertical, +Y: our files look south along +Z, splat-transform's north."""


@dataclass(frozen=True)
class SplatGlb:
    """One primitive.

    Attributes:
        document: The JSON document.
        primitive: The primitive of the only mesh.
        attributes: Attributes by name, a row per splat; integers that represent 0..1 are converted.
    """

    document: dict[str, Any]
    primitive: dict[str, Any]
    attributes: dict[str, npt.NDArray[np.float64]]


def read_glb(path: Path) -> SplatGlb:
    """Read a file that contains one primitive, by us or by splat-transform."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    primitive = document["meshes"][0]["primitives"][0]
    attributes = {name: _values(document, binary, index) for name, index in primitive["attributes"].items()}
    return SplatGlb(document, primitive, attributes)


def _values(document: dict[str, Any], binary: bytes, index: int) -> npt.NDArray[np.float64]:
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    kind, columns = np.dtype(_TYPES[accessor["componentType"]]), _COMPONENTS[accessor["type"]]
    stride = view.get("byteStride", kind.itemsize * columns)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    shape = (accessor["count"], columns)
    found = np.ndarray(shape, kind, binary, start, (stride, kind.itemsize)).astype(np.float64)
    return found / np.iinfo(kind).max if accessor.get("normalized") else found


def largest_differences(ours: SplatGlb, theirs: SplatGlb) -> dict[str, float]:
    """Return the largest difference per attribute between two files of one splat in the same order, headings aligned.

    Relative where a value exceeds 1; quaternions up to their sign.
    """
    turned = _turned(theirs.attributes, HALF_TURN)
    found = {}
    for name, mine in ours.attributes.items():
        other = turned[name]
        if name == f"{PREFIX}ROTATION":
            other = other * np.where((mine * other).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
        found[name] = float((np.abs(mine - other) / np.maximum(1.0, np.abs(other))).max())
    return found


def _turned(
    attributes: dict[str, npt.NDArray[np.float64]], turn: Float64[np.ndarray, "3 3"]
) -> dict[str, npt.NDArray[np.float64]]:
    found = dict(attributes)
    found["POSITION"] = attributes["POSITION"] @ turn.T
    x, y, z, w = attributes[f"{PREFIX}ROTATION"].T
    found[f"{PREFIX}ROTATION"] = np.stack(
        [z, w, -x, -y], axis=1
    )  # (0, 1, 0, 0) times the quaternion: half a turn about y
    names = [f"{PREFIX}SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)]
    names = [name for name in names if name in attributes]
    sh = torch.from_numpy(np.stack([attributes[name] for name in names], axis=1))
    rotated = rotate_sh(sh, torch.from_numpy(turn)).numpy()
    return found | {name: rotated[:, index] for index, name in enumerate(names)}
