"""The Gaussians of a GLB with `KHR_gaussian_splatting`: all that its scene draws, in the scene's frame.

Specifications: Khronos, "KHR_gaussian_splatting" (ratified), and "KHR_gaussian_splatting_compression_spz_2", for which
we follow CesiumJS in taking the SPZ file's axes as the glTF's.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.splat.containers.bounded import CheckValues, read_exactly
from splatpipe.pipeline.splat.containers.glb_container import Accessor, Container
from splatpipe.pipeline.splat.containers.glb_nodes import drawn_primitives
from splatpipe.pipeline.splat.formats import spz
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import MAX_DEGREE, coefficient_count, multiply_rows, rgb_to_dc

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
RECORD = "splatpipe"
"""Key of the record in `asset.extras`."""
KERNEL = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
"""The rendering of 3D Gaussian splatting, in display-referred colours."""
ROWS_AT_ONCE = 1 << 16
_KNOWN = (EXTENSION, SPZ_EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit")
_MIN_ROW_BYTES = 12
"""Of a Gaussian's colour: bounds how many Gaussians a file can hold without drawing any of them repeatedly."""
_INFINITY_LOGIT, _INFINITY_LOG_SCALE = 20.0, -20.0
"""Stand for opacities of exactly 0 and 1, and for a scale of 0; equal in float32, and the same as in ``splat.ply``."""
_ROUNDING = 1e-3
"""Tolerance by which an opacity may lie outside 0..1."""
_SIMILAR = 1e-4
"""Tolerance for equal lengths and right angles of a node's axes."""
_HINT = "Give a splat: points with the attributes of KHR_gaussian_splatting."


def harmonics_names(sh_degree: int) -> list[str]:
    """Attribute names of the SH coefficients, from degree 0, in the order of ``Gaussians.sh``."""
    degrees = range(sh_degree + 1)
    return [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for degree in degrees for n in range(2 * degree + 1)]


def read_splats(container: Container, check: CheckValues) -> Gaussians:
    """Read all Gaussians that the scene draws, in the scene's frame.

    Args:
        container: The file.

    Raises:
        SplatpipeError: if there are none, the file is damaged, or it requires something unsupported.
    """
    required = container.document.get("extensionsRequired", [])
    unknown = [name for name in required if name not in _KNOWN] if isinstance(required, list) else [required]
    if unknown:
        raise SplatpipeError(f"{container.path} needs {str(unknown[0])[:60]}, which cannot be read.", hint=_HINT)
    drawn = drawn_primitives(container, EXTENSION)
    if not drawn:
        raise SplatpipeError(f"{container.path} contains no splat.", hint=_HINT)
    splats = [_splat(container, primitive) for primitive, _ in drawn]
    if sum(splat.least_bytes for splat in splats) > container.length:
        container.refuse("it draws more Gaussians than it contains")
    matrices = [matrix for _, matrix in drawn]
    parts = [_placed(container, one.read(container, check), at) for one, at in zip(splats, matrices, strict=True)]
    degree = max(part.sh_degree for part in parts)
    return parts[0] if len(parts) == 1 else Gaussians.concat([_of_degree(part, degree) for part in parts])


def _of_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The same Gaussians with SH padded with zeros up to a degree."""
    sh = torch.zeros(len(gaussians), coefficient_count(degree), 3)
    sh[:, : gaussians.sh.shape[1]] = gaussians.sh
    return replace(gaussians, sh=sh)


@dataclass(frozen=True)
class _SpzSplat:
    """A primitive whose Gaussians are an embedded SPZ file.

    Attributes:
        start: Offset of the SPZ file from the beginning of the GLB, bytes.
        length: Its length, bytes.
    """

    start: int
    length: int

    @property
    def least_bytes(self) -> int:
        return self.length

    def read(self, container: Container, check: CheckValues) -> Gaussians:
        """Read its Gaussians through the SPZ reader, which needs a file."""
        container.file.seek(self.start)
        data = read_exactly(container.path, container.file, self.length)
        with tempfile.TemporaryDirectory(prefix="splatpipe-") as folder:
            path = Path(folder) / "inside.spz"
            write_file(path, data)
            try:
                return spz.read(path, check).turned("y up").gaussians
            except SplatpipeError as error:
                message = error.message.replace(str(path), f"The SPZ file in {container.path}")
                raise SplatpipeError(message, hint=error.hint.replace(str(path), str(container.path))) from error


@dataclass(frozen=True)
class _Splat:
    """A primitive whose attributes are checked to lie inside the file.

    Attributes:
        columns: Its attributes other than SH, by short names.
        harmonics: SH coefficients from degree 0; empty if there are none, not even a constant.
    """

    columns: Mapping[str, Accessor]
    harmonics: tuple[Accessor, ...]

    @property
    def least_bytes(self) -> int:
        return _MIN_ROW_BYTES * self.columns["position"].count

    def read(self, container: Container, _: CheckValues) -> Gaussians:
        """Read its Gaussians, in its own frame; the caller checks their values."""
        count = self.columns["position"].count
        gaussians = Gaussians.empty(count, max(math.isqrt(len(self.harmonics)) - 1, 0))
        for start in range(0, count, ROWS_AT_ONCE):
            self._fill(container, gaussians, start, min(ROWS_AT_ONCE, count - start))
        return gaussians

    def _fill(self, container: Container, gaussians: Gaussians, start: int, count: int) -> None:
        def rows(accessor: Accessor) -> torch.Tensor:
            return torch.from_numpy(accessor.rows(container.path, container.file, start, count))

        part = slice(start, start + count)
        gaussians.means[part] = rows(self.columns["position"])
        gaussians.quats[part] = rows(self.columns["rotation"])[:, [3, 0, 1, 2]]
        scales = rows(self.columns["scale"])
        if bool((scales < 0.0).any()):
            container.refuse("scales are negative")
        log_scales = torch.log(scales)
        gaussians.log_scales[part] = torch.where(scales == 0.0, _INFINITY_LOG_SCALE, log_scales)
        opacity = self.columns["opacity"]
        opacities = rows(opacity)[:, -1].double()  # a colour's last component
        if bool(((opacities < -_ROUNDING) | (opacities > 1.0 + _ROUNDING)).any()):
            container.refuse("opacities are not between 0 and 1")
        logits = torch.logit(opacities.clamp(0.0, 1.0))
        gaussians.opacity_logits[part] = logits.clamp(-_INFINITY_LOGIT, _INFINITY_LOGIT).float()
        if not self.harmonics:
            gaussians.sh[part, 0] = rgb_to_dc(rows(self.columns["color"])[:, :3])
        for term, accessor in enumerate(self.harmonics):
            gaussians.sh[part, term] = rows(accessor)


def _splat(container: Container, primitive: Mapping[str, Any]) -> _Splat | _SpzSplat:
    """Locate and check a primitive's attributes.

    Raises:
        SplatpipeError: if one is missing, has another length, or lies outside of the file.
    """
    extension, names = primitive["extensions"][EXTENSION], primitive.get("attributes")
    if not isinstance(names, dict):
        container.refuse("a splat has no attributes")
    for key, taken in (("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")):
        if extension.get(key, taken) != taken:
            given = str(extension[key])[:40]
            raise SplatpipeError(
                f"{container.path}: splats with {key} {given} cannot be read, only {taken}.", hint=_HINT
            )
    inside = extension.get("extensions")
    packed = inside.get(SPZ_EXTENSION) if isinstance(inside, dict) else None
    if isinstance(packed, dict):
        return _SpzSplat(*container.view(packed.get("bufferView"))[:2])
    has_opacity = f"{EXTENSION}:OPACITY" in names
    opacity = (f"{EXTENSION}:OPACITY", ("SCALAR",)) if has_opacity else ("COLOR_0", ("VEC4",))
    wanted: dict[str, tuple[str, tuple[str, ...]]] = {
        "position": ("POSITION", ("VEC3",)),
        "rotation": (f"{EXTENSION}:ROTATION", ("VEC4",)),
        "scale": (f"{EXTENSION}:SCALE", ("VEC3",)),
        "opacity": opacity,
    }
    found = _harmonics(container, names)
    if not found:
        wanted["color"] = ("COLOR_0", ("VEC3", "VEC4"))
    missing = [name for name, _ in wanted.values() if name not in names]
    if missing:
        raise SplatpipeError(f"{container.path}: a splat has no {', '.join(missing)}.", hint=_HINT)
    columns = {short: container.accessor(names[name], kinds) for short, (name, kinds) in wanted.items()}
    harmonics = tuple(container.accessor(names[name], ("VEC3",)) for name in found)
    if len({accessor.count for accessor in (*columns.values(), *harmonics)}) != 1:
        container.refuse("a splat's attributes have different lengths")
    return _Splat(columns, harmonics)


def _harmonics(container: Container, names: Mapping[str, Any]) -> list[str]:
    """SH attribute names of complete degrees, from 0; none if the colour is in COLOR_0."""
    present = {name for name in names if name.startswith(f"{EXTENSION}:SH_DEGREE_")}
    for degree in range(MAX_DEGREE, -1, -1):
        wanted = harmonics_names(degree)
        if present == set(wanted):
            return wanted
    if present:
        container.refuse("its spherical harmonics are not complete to a degree of 0 to 3")
    return []


def _placed(container: Container, gaussians: Gaussians, matrix: Float64[np.ndarray, "4 4"]) -> Gaussians:
    """The Gaussians transformed to the scene's frame.

    Raises:
        SplatpipeError: if the matrix scales unevenly, shears or mirrors.
    """
    if np.array_equal(matrix, np.eye(4)):
        return gaussians
    scale = float(np.cbrt(max(np.linalg.det(matrix[:3, :3]), 0.0)))
    rotation = matrix[:3, :3] / scale if scale > 0.0 else np.zeros((3, 3))
    straight = np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0))
    if not straight or not np.abs(rotation.T @ rotation - np.eye(3)).max() < _SIMILAR:
        raise SplatpipeError(
            f"{container.path} stretches, shears or mirrors a splat, which cannot be read.",
            hint="Apply its transformation in the program that made it.",
        )
    turn, move = torch.from_numpy(rotation.copy()), torch.from_numpy(matrix[:3, 3].copy())
    pieces = (piece.transformed(scale, turn, move) for piece in gaussians.pieces())
    placed = Gaussians.gathered(pieces, gaussians)
    return replace(placed, means=multiply_rows(scale * turn, gaussians.means.double()) + move)  # not rounded to float32
