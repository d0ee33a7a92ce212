"""The primitives that a glTF scene draws, and their transforms: visits each node once from the roots.

Specification: Khronos, "glTF 2.0", section 3.5 (scenes): nodes form trees; a node's matrix, or its translation,
rotation (x, y, z, w) and scale, is relative to its parent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from splatpipe.pipeline.splat.containers.glb_container import Container

MAX_PRIMITIVES = 1000
"""Limit per file: each primitive costs time, however little it draws."""
_MAX_NUMBER = 1e12
_IDENTITY = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}

Drawn = tuple[Mapping[str, Any], Float64[np.ndarray, "4 4"]]
"""A mesh primitive and its matrix, scene from primitive."""


def drawn_primitives(container: Container, extension: str) -> list[Drawn]:
    """The scene's primitives that use an extension, with their transforms.

    Args:
        container: The file.
        extension: Name of the extension.

    Raises:
        SplatpipeError: if the scene or a node is damaged, or there are too many primitives.
    """
    waiting = [(index, np.eye(4)) for index in reversed(_roots(container))]
    visited: set[int] = set()
    drawn: list[Drawn] = []
    while waiting:
        index, parent = waiting.pop()
        node = container.entry("nodes", index)
        if index in visited:
            container.refuse("its nodes are not a tree: one is drawn in two places")
        visited.add(index)
        matrix = parent @ _matrix(container, node)
        if "mesh" in node:
            primitives = _listed(container, container.entry("meshes", node["mesh"]), "primitives")
            drawn += [(one, matrix) for one in primitives if _has(one, extension)]
        if len(drawn) > MAX_PRIMITIVES:
            container.refuse(f"it draws more than {MAX_PRIMITIVES} splats")
        waiting += [(child, matrix) for child in reversed(_listed(container, node, "children"))]
    return drawn


def _has(primitive: Any, extension: str) -> bool:
    extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
    return isinstance(extensions, dict) and isinstance(extensions.get(extension), dict)


def _roots(container: Container) -> list[Any]:
    """The default scene's root nodes; in a file without scenes, all nodes without a parent."""
    if "scenes" in container.document:
        return _listed(container, container.entry("scenes", container.document.get("scene", 0)), "nodes")
    nodes = _listed(container, container.document, "nodes")
    children = [_listed(container, container.entry("nodes", index), "children") for index in range(len(nodes))]
    below = {child for row in children for child in row if isinstance(child, int)}
    return [index for index in range(len(nodes)) if index not in below]


def _listed(container: Container, holder: Mapping[str, Any], name: str) -> list[Any]:
    values = holder.get(name, [])
    if not isinstance(values, list):
        container.refuse(f"its {name} are not a list")
    return values


def _matrix(container: Container, node: Mapping[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """The matrix of a node, parent from node."""
    if "matrix" in node:
        return _numbers(container, node["matrix"], 16).reshape(4, 4).T  # column by column
    parts = {name: _numbers(container, node.get(name, rest), len(rest)) for name, rest in _IDENTITY.items()}
    if not np.linalg.norm(parts["rotation"]) > 0.0:
        container.refuse("a node's rotation is not valid")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(parts["rotation"]).as_matrix() * parts["scale"]
    matrix[:3, 3] = parts["translation"]
    return matrix


def _numbers(container: Container, values: Sequence[Any], count: int) -> Float64[np.ndarray, " n"]:
    fine = isinstance(values, list | tuple) and len(values) == count
    if not fine or not all(_is_number(value) for value in values):
        container.refuse("a node's transformation is not made of numbers")
    return np.array(values, np.float64)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= _MAX_NUMBER and not math.isnan(value)
