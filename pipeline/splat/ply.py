"""Splats as PLY files in the layout of 3D Gaussian splatting, read from anybody and trusted from nobody.

Layout: the reference implementation of "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (Kerbl et al.,
SIGGRAPH 2023), which every trainer and viewer follows; PLY itself: G. Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.formats.bounded import check_values, open_file
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.sh import MAX_DEGREE, coefficient_count

MIP_COMMENT = "SplatRenderMode: mip"
"""The header comment that tags a model trained with the anti-aliased rasterizer."""

_MAX_HEADER_BYTES = 65_536
"""A degree 3 splat's header has 1.5 kB; more than this is no header of a splat."""
_CHUNK_ROWS = 65_536
"""Rows converted at a time: 16 MB of a degree 3 splat, so that a large file is not in memory twice."""
_INFINITY_LOGIT = 20.0
"""Stands for an opacity of exactly 1 (or 0), which some converters store as an infinite logit; float32 agrees."""
_INFINITY_LOG_SCALE = -20.0
"""Stands for a scale of exactly 0, which flat splats are stored with: 2e-9 units."""

_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_POSITION, *_DC, "opacity", *_SCALE, *_ROTATION)

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_HINT = "Give a splat as trainers write it: a binary PLY with x, f_dc_0, opacity, scale_0, rot_0 and so on."


@dataclass(frozen=True)
class SplatHeader:
    """What a splat PLY says about itself.

    Attributes:
        count: Number of Gaussians.
        sh_degree: 0..3.
        comments: The comment lines' texts, in order.
        row: numpy's structured type of one vertex, in the file's byte order.
        offset_bytes: Where the vertices begin.
    """

    count: int
    sh_degree: int
    comments: tuple[str, ...]
    row: np.dtype[np.void]
    offset_bytes: int


def write_splat(path: Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> None:
    """Write the exact 3DGS layout: binary little-endian float32, normals of zero, f_rest channel-major.

    Args:
        path: The file; replaced if it is there.
        gaussians: What to write, parameters as they are (logits, logarithms, (w, x, y, z)).
        comments: Header comments, one line each; what is not ASCII is escaped.

    Raises:
        ValueError: if a value is not finite, or a comment has a line break.
        OSError: if the file cannot be written.
    """
    gaussians = gaussians.detach().to("cpu", torch.float32)
    _check_finite(gaussians)
    with path.open("wb") as file:
        file.write(_header(len(gaussians), property_names(gaussians.sh_degree), comments))
        _write_rows(file, gaussians)


def write_splat_parts(
    path: Path, parts: Iterable[Gaussians], count: int, sh_degree: int, comments: Sequence[str] = ()
) -> None:
    """Write the bytes that ``write_splat`` writes of all parts one after another, of which none is kept.

    Args:
        path: The file; replaced if it is there, and no splat where this fails.
        parts: Asked for one by one.
        count: Gaussians in all of them.
        sh_degree: Of all of them.
        comments: As of ``write_splat``.

    Raises:
        ValueError: as ``write_splat``, or if the parts are not of this count or degree.
        OSError: if the file cannot be written.
    """
    left = count
    with path.open("wb") as file:
        file.write(_header(count, property_names(sh_degree), comments))
        for part in parts:
            if part.sh_degree != sh_degree:
                raise ValueError(f"a part is of SH degree {part.sh_degree}, not {sh_degree}")
            gaussians = part.detach().to("cpu", torch.float32)
            _check_finite(gaussians)
            _write_rows(file, gaussians)
            left -= len(gaussians)
    if left:
        raise ValueError(f"parts of {count - left} Gaussians were to be of {count}")


def _check_finite(gaussians: Gaussians) -> None:
    bad = len(gaussians) - int(gaussians.finite().sum())
    if bad:
        raise ValueError(f"{bad} Gaussians have values that are not finite: never to be written")


def _write_rows(file: BinaryIO, gaussians: Gaussians) -> None:
    for piece in gaussians.pieces(_CHUNK_ROWS):
        columns = [
            piece.means,
            torch.zeros(len(piece), 3),
            piece.sh[:, 0],
            piece.sh[:, 1:].transpose(1, 2).flatten(1),  # channel-major: all of red, then green, blue
            piece.opacity_logits[:, None],
            piece.log_scales,
            piece.quats,
        ]
        file.write(torch.cat(columns, dim=1).numpy().astype("<f4", copy=False).tobytes())


def property_names(sh_degree: int) -> list[str]:
    """The vertex's properties in the order of the 3DGS layout."""
    rest = [f"f_rest_{i}" for i in range(3 * (coefficient_count(sh_degree) - 1))]
    return [*_POSITION, *_NORMAL, *_DC, *rest, "opacity", *_SCALE, *_ROTATION]


def read_splat(path: Path) -> Gaussians:
    """Read a splat by property name: any order, either byte order, float or double, with or without normals.

    Infinite opacity logits and scales of zero, which converters write, become large finite ones.

    Args:
        path: A binary PLY of SH degree 0..3.

    Returns:
        float32 Gaussians on the CPU.

    Raises:
        SplatpipeError: if the file is missing, cut off, no splat, or has values that are not numbers.
    """
    with open_file(path) as file:
        header = _read_header(path, file)
        gaussians = Gaussians.empty(header.count, header.sh_degree)
        start = 0
        for rows in _chunks(path, file, header):
            _fill(gaussians, start, rows)
            start += len(rows)
    check_values(path, gaussians)
    return gaussians


def read_splat_header(path: Path) -> SplatHeader:
    """Read and check only the header of a splat PLY, against the file's size too.

    Raises:
        SplatpipeError: as ``read_splat``, but for the values.
    """
    with open_file(path) as file:
        return _read_header(path, file)


def _header(count: int, names: Sequence[str], comments: Sequence[str]) -> bytes:
    if any(character in comment for comment in comments for character in "\r\n"):
        raise ValueError("a PLY comment is one line")
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}" for comment in comments]
    lines += [f"element vertex {count}"]
    lines += [f"property float {name}" for name in names]
    lines += ["end_header", ""]
    return "\n".join(lines).encode("ascii", "backslashreplace")


def _read_header(path: Path, file: BinaryIO) -> SplatHeader:
    """Parse the header; leaves the file wherever it is."""
    lines, offset = _header_lines(path, file)
    byte_order, comments, elements = _parse_lines(path, lines)
    skipped = 0
    for element in elements:
        if element.has_list and element.name != "vertex":
            raise SplatpipeError(f"{path}: lists before the vertices are not supported.", hint=_HINT)
        if element.name == "vertex":
            break
        skipped += element.count * np.dtype(element.fields).itemsize
    else:
        raise SplatpipeError(f"{path} has no vertices.", hint=_HINT)
    degree = _check_vertex(path, element, has_chunks=any(e.name == "chunk" for e in elements))
    row = np.dtype([(name, byte_order + kind) for name, kind in element.fields])
    size = file.seek(0, 2)
    if offset + skipped + element.count * row.itemsize > size:
        raise SplatpipeError(
            f"{path} is cut off: its header promises {element.count} Gaussians, "
            f"it has room for {max(0, size - offset - skipped) // row.itemsize}.",
            hint="Copy or export it again.",
        )
    return SplatHeader(element.count, degree, tuple(comments), row, offset + skipped)


def _header_lines(path: Path, file: BinaryIO) -> tuple[list[str], int]:
    """The header's lines without its first and last, and the offset of the data."""
    try:
        start = file.read(_MAX_HEADER_BYTES)
    except OSError as error:  # a folder opens on some systems and fails here
        raise SplatpipeError(f"Cannot read {path}: {error.strerror}.", hint="Check the path.") from error
    if not re.match(rb"ply[ \t]*\r?\n", start):
        raise SplatpipeError(f"{path} is not a PLY file.", hint=_HINT)
    end = re.search(rb"\nend_header[ \t]*\r?\n", start)
    if end is None:
        raise SplatpipeError(f"{path}: its PLY header does not end.", hint=_HINT)
    text = start[: end.start()].decode("utf-8", "replace")
    return [line.strip() for line in text.split("\n")[1:]], end.end()


@dataclass
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]]
    has_list: bool = False


def _parse_lines(path: Path, lines: Sequence[str]) -> tuple[str, list[str], list[_Element]]:
    """Byte order, comments and elements of a header."""
    byte_order = ""
    comments: list[str] = []
    elements: list[_Element] = []
    for line in lines:
        match line.split():
            case [] | ["obj_info", *_]:
                pass
            case ["comment", *_]:
                comments.append(line[len("comment") :].strip())
            case ["format", "ascii", _]:
                raise SplatpipeError(f"{path} is a text PLY.", hint="Export it as a binary PLY.")
            case ["format", kind, "1.0"] if kind in _BYTE_ORDERS and not byte_order:
                byte_order = _BYTE_ORDERS[kind]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count, re.ASCII):
                elements.append(_Element(name, int(count), []))
            case ["property", "list", kind, item, _] if kind in _TYPES and item in _TYPES and elements:
                elements[-1].has_list = True
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1].fields.append((name, _TYPES[kind]))
            case _:
                raise SplatpipeError(f"{path}: {line[:80]!r} is no line of a PLY header.", hint=_HINT)
    for element in elements:
        if len({name for name, _ in element.fields}) != len(element.fields):
            raise SplatpipeError(f"{path}: its PLY header names a property twice.", hint=_HINT)
    if not byte_order:
        raise SplatpipeError(f"{path}: its PLY header names no format.", hint=_HINT)
    return byte_order, comments, elements


def _check_vertex(path: Path, vertex: _Element, has_chunks: bool) -> int:
    """SH degree of a vertex element that is a splat's."""
    kinds = dict(vertex.fields)
    if has_chunks and "packed_position" in kinds:
        raise SplatpipeError(f"{path} is a compressed PLY.", hint="Convert it to a plain splat PLY first.")
    missing = [name for name in _REQUIRED if name not in kinds]
    if missing:
        what = "a point cloud or a mesh" if "f_dc_0" in missing and "x" not in missing else "incomplete"
        raise SplatpipeError(f"{path} is no splat but {what}: it lacks {', '.join(missing)}.", hint=_HINT)
    rest = [name for name in kinds if name.startswith("f_rest_")]
    degrees = {3 * (coefficient_count(degree) - 1): degree for degree in range(MAX_DEGREE + 1)}
    if len(rest) not in degrees or {f"f_rest_{i}" for i in range(len(rest))} != set(rest):
        raise SplatpipeError(
            f"{path}: {len(rest)} f_rest properties are no spherical harmonics of degree 0 to {MAX_DEGREE}.", hint=_HINT
        )
    if vertex.has_list or any(kinds[name] not in ("f4", "f8") for name in [*_REQUIRED, *rest]):
        raise SplatpipeError(f"{path}: a splat's properties are floats.", hint=_HINT)
    return degrees[len(rest)]


def _chunks(path: Path, file: BinaryIO, header: SplatHeader) -> Iterator[np.ndarray]:
    """The rows, a bounded number at a time."""
    file.seek(header.offset_bytes)
    left = header.count
    while left:
        count = min(left, _CHUNK_ROWS)
        data = file.read(count * header.row.itemsize)
        if len(data) != count * header.row.itemsize:
            raise SplatpipeError(f"{path} was cut off while it was being read.", hint="Try again.")
        yield np.frombuffer(data, dtype=header.row)
        left -= count


def _fill(gaussians: Gaussians, start: int, rows: np.ndarray) -> None:
    """Convert rows into the Gaussians from ``start`` on."""
    part = slice(start, start + len(rows))

    def columns(names: Sequence[str]) -> torch.Tensor:
        out = np.empty((len(rows), len(names)), dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # a double beyond float32 becomes an infinity: reported
            for i, name in enumerate(names):
                out[:, i] = rows[name]
        return torch.from_numpy(out)

    k = gaussians.sh.shape[1]
    rest = columns([f"f_rest_{i}" for i in range(3 * (k - 1))])
    gaussians.means[part] = columns(_POSITION)
    gaussians.sh[part, 0] = columns(_DC)
    gaussians.sh[part, 1:] = rest.reshape(len(rows), 3, k - 1).transpose(1, 2)
    logits = columns(["opacity"])[:, 0]
    infinite = torch.isinf(logits)
    gaussians.opacity_logits[part] = torch.where(infinite, torch.sign(logits) * _INFINITY_LOGIT, logits)
    log_scales = columns(_SCALE)
    log_scales[log_scales == -torch.inf] = _INFINITY_LOG_SCALE
    gaussians.log_scales[part] = log_scales
    gaussians.quats[part] = columns(_ROTATION)
