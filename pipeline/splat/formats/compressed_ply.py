"""The compressed PLY of PlayCanvas and SuperSplat: 16 bytes per Gaussian, and 45 more for SH of degree 3.

Layout: the readers of github.com/playcanvas/engine and splat-transform. ``chunk`` has the least and largest positions,
log scales and colours of every 256 rows of ``vertex``, which are coded relative to these; positions and scales have 11,
10 and 11 bits, rotations 10 for each of their smallest three components, colours and opacities 8, and SH (``sh``)
within ±4 has 8. Viewers assume y down, as for a PLY.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8, UInt32

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.splat.containers.bounded import CheckValues, all_finite, check_values, open_file, read_exactly
from splatpipe.pipeline.splat.containers.ply_header import (
    PLY_HINT,
    PlyElement,
    PlyHeader,
    ply_header_bytes,
    read_ply_header,
)
from splatpipe.pipeline.splat.formats.near_origin import scene_near_origin
from splatpipe.pipeline.splat.formats.plain_ply import facts_of_comments, header_comments
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.neighbourhoods import in_neighbourhoods, reordered
from splatpipe.pipeline.splat.model.position_cost import PositionCost, sizes_of
from splatpipe.pipeline.splat.model.scene import Scene, turn_of
from splatpipe.pipeline.splat.model.sh import C0, MAX_DEGREE, coefficient_count

CHUNK = 256
_ROWS = 256 * CHUNK  # at a time
_AXES_NAMES = ("x", "y", "z")
_RANGES = tuple(
    f"{end}_{name}"
    for names in (_AXES_NAMES, [f"scale_{axis}" for axis in _AXES_NAMES], ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
_WITHOUT_COLOURS = _RANGES[:12]
"""Older files' ranges: their colours are coded between 0 and 1."""
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_VECTOR_BITS = (11, 10, 11)
_COARSE_AXIS = (1.0, 2.0, 1.0)
"""How much coarser an axis of a position is coded than the first."""
_SH_REACH = 4.0
_MAX_LOG_SCALE = 20.0
"""Beyond which writers cut off, so that one broken Gaussian does not spoil the other 255's scales."""
_ALPHA_END = 0.25 / 255.0
"""Stands for an opacity coded as 0, and this below 1 for one coded as 1, of which there are no logits."""


def write(path: Path, scene: Scene) -> PositionCost:
    """Write a scene y down, as viewers assume, reordered for precision.

    Args:
        path: The file; replaced if it exists.
        scene: The scene.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    if not all_finite(scene.gaussians):
        raise ValueError("Gaussians have values that are not finite: never to be written")
    gaussians = scene.gaussians.detach()
    elements = _elements(len(gaussians), gaussians.sh_degree)
    header = ply_header_bytes(elements, header_comments(scene.facts.turned("y down")))
    turn = turn_of("y down", scene.facts.axes)
    order = in_neighbourhoods((gaussians.means.double() @ turn.T).float(), CHUNK, _COARSE_AXIS)
    sizes = [element.count * np.dtype(list(element.fields)).itemsize for element in elements]
    offsets = list(accumulate(sizes[:-1], initial=len(header)))
    steps, of_gaussians = [np.zeros(0)], [np.zeros((0, 2))]
    with new_file(path) as file:
        file.write(header)
        for piece in reordered(gaussians, order, _ROWS, None if scene.facts.axes == "y down" else turn):
            steps.append(_position_steps(piece.means.numpy()))
            of_gaussians.append(sizes_of(piece.log_scales))
            for i, data in enumerate(_coded(piece)):
                file.seek(offsets[i])
                file.write(data)
                offsets[i] += len(data)
    return PositionCost.of(np.concatenate(steps), np.concatenate(of_gaussians))


def read(path: Path, check: CheckValues = check_values) -> Scene:
    """Read a file; without a record of ours it is assumed to be y down and not georeferenced.

    Raises:
        SplatpipeError: if the file is missing, truncated, not a compressed PLY, or has values that are not numbers.
    """
    with open_file(path) as file:
        layout = _layout(path, read_ply_header(path, file))
        gaussians = Gaussians.empty(layout.count, layout.degree)
        gaussians.means = torch.zeros(layout.count, 3, dtype=torch.float64)  # between two float32
        for start in range(0, layout.count, _ROWS):
            count = min(_ROWS, layout.count - start)
            rows = []
            for part, part_start, part_count in layout.parts_of(start, count):
                file.seek(part.offset_bytes + part_start * part.row.itemsize)
                data = read_exactly(path, file, part_count * part.row.itemsize)
                rows.append(np.frombuffer(data, part.row))
            _fill(gaussians, start, rows)
    check(path, gaussians)
    return scene_near_origin(path, gaussians, facts_of_comments(layout.comments))


def _elements(count: int, degree: int) -> list[PlyElement]:
    """The file's elements, in order."""
    elements = [
        PlyElement("chunk", -(-count // CHUNK), tuple((name, "f4") for name in _RANGES)),
        PlyElement("vertex", count, tuple((name, "u4") for name in _PACKED)),
    ]
    rest = _rest_names(degree)
    return [*elements, PlyElement("sh", count, tuple((name, "u1") for name in rest))] if rest else elements


def _rest_names(degree: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(3 * (coefficient_count(degree) - 1))]


@dataclass(frozen=True)
class _Part:
    """Rows of a fixed length.

    Attributes:
        row: numpy's structured type of one row.
        offset_bytes: Offset of the first row.
    """

    row: np.dtype[np.void]
    offset_bytes: int


@dataclass(frozen=True)
class _Layout:
    """Layout of a file, checked against its size.

    Attributes:
        count: Number of Gaussians.
        degree: SH degree.
        parts: Chunks, vertices, and SH if there is any.
        comments: Comments of the header.
    """

    count: int
    degree: int
    parts: tuple[_Part, ...]
    comments: tuple[str, ...]

    def parts_of(self, start: int, count: int) -> Iterator[tuple[_Part, int, int]]:
        """Each part with the first row and the number of rows of some Gaussians, which start a chunk."""
        for part in self.parts:
            if part is self.parts[0]:
                yield part, start // CHUNK, -(-count // CHUNK)
            else:
                yield part, start, count


def _layout(path: Path, header: PlyHeader) -> _Layout:
    found = {element.name: element for element in header.elements}
    chunk, vertex, sh = (found.get(name) for name in ("chunk", "vertex", "sh"))
    if chunk is None or vertex is None:
        raise SplatpipeError(f"{path} is not a compressed PLY: it has no chunks of vertices.", hint=PLY_HINT)
    ranges = _RANGES if ("min_r", "f4") in chunk.fields else _WITHOUT_COLOURS
    for element, names, kind in ((chunk, ranges, "f4"), (vertex, _PACKED, "u4")):
        if element.has_list or not {(name, kind) for name in names} <= set(element.fields):
            raise SplatpipeError(f"{path} is not a compressed PLY: its {element.name} is incomplete.", hint=PLY_HINT)
    if chunk.count != -(-vertex.count // CHUNK):
        raise SplatpipeError(f"{path}: {chunk.count} chunks do not match {vertex.count} Gaussians.", hint=PLY_HINT)
    degree = 0 if sh is None else _degree_of(path, sh, vertex.count)
    parts = (chunk, vertex) if sh is None else (chunk, vertex, sh)
    return _Layout(
        vertex.count,
        degree,
        tuple(_Part(header.row_of(each), header.offset_of(path, each)) for each in parts),
        header.comments,
    )


def _degree_of(path: Path, sh: PlyElement, count: int) -> int:
    names = {name for name, kind in sh.fields if kind == "u1"}
    degree = next((d for d in range(1, MAX_DEGREE + 1) if names == set(_rest_names(d))), None)
    if degree is None or sh.has_list or len(sh.fields) != len(names) or sh.count != count:
        raise SplatpipeError(
            f"{path}: its sh does not hold degrees 1 to {MAX_DEGREE} of {count} Gaussians.", hint=PLY_HINT
        )
    return degree


def _coded(piece: Gaussians) -> tuple[bytes, ...]:
    """Encoded rows of chunks, vertices and SH for some Gaussians, the first of which starts a chunk."""
    colours = piece.sh[:, 0] * C0 + 0.5
    log_scales = piece.log_scales.clamp(-_MAX_LOG_SCALE, _MAX_LOG_SCALE)
    ranges, unit = [], []
    for values in (piece.means, log_scales, colours):
        least, most, scaled = _within_chunks(values.numpy())
        ranges += [least, most]
        unit.append(scaled)
    alpha = torch.sigmoid(piece.opacity_logits.double()).numpy()[:, None]
    words = (
        _packed(unit[0], _VECTOR_BITS),
        _smallest_three(piece.quats.numpy()),
        _packed(unit[1], _VECTOR_BITS),
        _packed(np.concatenate([unit[2], alpha], axis=1), (8, 8, 8, 8)),
    )
    rest = piece.sh[:, 1:].transpose(1, 2).flatten(1).numpy()  # channel-major
    steps = (rest * (128.0 / _SH_REACH) + 128.0).clip(0.0, 255.0).astype(np.uint8)
    return (
        np.concatenate(ranges, axis=1).astype("<f4").tobytes(),
        np.stack(words, axis=1).astype("<u4").tobytes(),
        *([steps.tobytes()] if steps.size else []),
    )


def _within_chunks(
    values: Float32[np.ndarray, "n 3"],
) -> tuple[Float32[np.ndarray, "c 3"], Float32[np.ndarray, "c 3"], Float64[np.ndarray, "n 3"]]:
    """Each chunk's least and largest values, and all values scaled between them to 0..1."""
    count = len(values)
    columns = np.pad(values.T, ((0, 0), (0, -count % CHUNK)), mode="edge").reshape(3, -1, CHUNK)
    least, most = columns.min(axis=2), columns.max(axis=2)
    extent = most.astype(np.float64) - least
    scaled = (columns - least[..., None].astype(np.float64)) / np.where(extent > 0.0, extent, 1.0)[..., None]
    return least.T, most.T, scaled.reshape(3, -1)[:, :count].T


def _position_steps(means: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Each Gaussian's coarsest step of a coordinate; the first starts a chunk."""
    least, most, _ = _within_chunks(means)
    levels = [(1 << count) - 1 for count in _VECTOR_BITS]
    steps = ((most.astype(np.float64) - least) / levels).max(axis=1)
    return np.asarray(np.repeat(steps, CHUNK)[: len(means)])


def _packed(unit: Float64[np.ndarray, "n c"], bits: tuple[int, ...]) -> UInt32[np.ndarray, " n"]:
    """Numbers of 0..1 in one word, the first in its upper bits."""
    word = np.zeros(len(unit), np.uint32)
    for column, count in enumerate(bits):
        step = np.rint(unit[:, column] * ((1 << count) - 1)).astype(np.uint32)
        word = word << np.uint32(count) | step
    return word


def _smallest_three(quats: Float32[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    """Index of the largest of w, x, y, z in the upper 2 bits, then the others in order, 10 bits each."""
    unit = quats.astype(np.float64)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-30)
    largest = np.abs(unit).argmax(axis=1)
    unit *= np.where(unit[np.arange(len(unit)), largest] < 0.0, -1.0, 1.0)[:, None]
    others = np.arange(3) + (np.arange(3) >= largest[:, None])
    rest = np.take_along_axis(unit, others, axis=1) * math.sqrt(0.5) + 0.5
    return np.asarray(largest.astype(np.uint32) << np.uint32(30) | _packed(rest.clip(0.0, 1.0), (10, 10, 10)))


def _fill(gaussians: Gaussians, start: int, rows: list[np.ndarray]) -> None:
    """Decode the chunks, vertices and SH of some Gaussians into those from ``start`` on."""
    chunks, vertices = rows[0], rows[1]
    part = slice(start, start + len(vertices))
    with np.errstate(invalid="ignore"):  # a signalling NaN in a cast: reported in the end
        ranges = {name: chunks[name].astype(np.float64) for name in _RANGES if name in (chunks.dtype.names or ())}
    chunk_of = np.arange(len(vertices)) // CHUNK

    def between(words: np.ndarray, bits: tuple[int, ...], names: tuple[str, ...]) -> Float64[np.ndarray, "n c"]:
        values = _unpacked(words, bits)
        for column, name in enumerate(names):
            if f"min_{name}" in ranges:
                least, most = ranges[f"min_{name}"], ranges[f"max_{name}"]
                with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is reported in the end
                    values[:, column] = least[chunk_of] + values[:, column] * (most - least)[chunk_of]
        return values

    scales = between(vertices["packed_scale"], _VECTOR_BITS, ("scale_x", "scale_y", "scale_z"))
    means = between(vertices["packed_position"], _VECTOR_BITS, _AXES_NAMES)
    colours = between(vertices["packed_color"], (8, 8, 8, 8), ("r", "g", "b"))
    alpha = colours[:, 3].clip(_ALPHA_END, 1.0 - _ALPHA_END)
    with np.errstate(over="ignore"):
        _put(gaussians.means[part], means)
        _put(gaussians.log_scales[part], scales)
        _put(gaussians.sh[part, 0], (colours[:, :3] - 0.5) / C0)
    _put(gaussians.opacity_logits[part], np.log(alpha / (1.0 - alpha)))
    _put(gaussians.quats[part], _from_smallest_three(vertices["packed_rotation"]))
    if len(rows) > 2:
        names = _rest_names(gaussians.sh_degree)
        steps = np.stack([rows[2][name] for name in names], axis=1)
        rest = torch.from_numpy(_harmonics(steps)).reshape(len(vertices), 3, -1)
        gaussians.sh[part, 1:] = rest.transpose(1, 2)


def _put(target: torch.Tensor, values: Float64[np.ndarray, "*shape"]) -> None:
    target.copy_(torch.from_numpy(np.ascontiguousarray(values)))


def _unpacked(words: np.ndarray, bits: tuple[int, ...]) -> Float64[np.ndarray, "n c"]:
    """The inverse of ``_packed``."""
    values = np.empty((len(words), len(bits)))
    shift = sum(bits)
    for column, count in enumerate(bits):
        shift -= count
        most = (1 << count) - 1
        values[:, column] = (words >> shift & most) / most
    return values


def _from_smallest_three(words: np.ndarray) -> Float64[np.ndarray, "n 4"]:
    """Unit quaternions (w, x, y, z)."""
    rest = (_unpacked(words, (10, 10, 10)) - 0.5) * math.sqrt(2.0)
    square = (rest * rest).sum(axis=1, keepdims=True)
    largest = np.sqrt(np.maximum(1.0 - square, 0.0))
    rest /= np.sqrt(np.maximum(square, 1.0))  # three that are longer than 1 leave nothing for the fourth
    which = (words >> 30).astype(np.int64)[:, None]
    quats = np.empty((len(words), 4))
    np.put_along_axis(quats, np.arange(3) + (np.arange(3) >= which), rest, axis=1)
    np.put_along_axis(quats, which, largest, axis=1)
    return quats


def _harmonics(steps: UInt8[np.ndarray, "n c"]) -> Float32[np.ndarray, "n c"]:
    """SH values: the middle of each step, except for the first and the last."""
    table = (np.arange(256) + 0.5) / 256.0
    table[[0, -1]] = 0.0, 1.0
    return np.asarray(((table - 0.5) * (2.0 * _SH_REACH)).astype(np.float32)[steps])
