"""Splats as PLY files in the layout of 3D Gaussian splatting; input is never trusted.

Layout: the reference implementation of "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (Kerbl et al.,
SIGGRAPH 2023), which every trainer and viewer follows; PLY itself: G. Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.splat.containers.bounded import check_values, open_file
from splatpipe.pipeline.splat.containers.ply_dialects import (
    BYTE_COLOURS,
    DC,
    FILTER,
    SCALE,
    PlyDialect,
    convolved,
    dialect_of,
)
from splatpipe.pipeline.splat.containers.ply_header import PLY_HINT, PlyElement, ply_header_bytes, read_ply_header
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import NO_OFFSET
from splatpipe.pipeline.splat.model.sh import C0, MAX_DEGREE, coefficient_count

MIP_COMMENT = "SplatRenderMode: mip"
"""The header comment that tags a model trained with the anti-aliased rasterizer."""

_CHUNK_ROWS = 65_536
"""Rows converted at a time: 16 MB of a degree 3 splat, so that a large file is not in memory twice."""
_INFINITY_LOGIT = 20.0
"""Stands for an opacity of exactly 1 (or 0), which some converters store as an infinite logit; equal in float32."""
_INFINITY_LOG_SCALE = -20.0
"""Stands for a scale of exactly 0, as stored in flat splats: 2e-9 units."""

_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_POSITION, *DC, "opacity", *SCALE, *_ROTATION)


@dataclass(frozen=True)
class SplatHeader:
    """The header of a splat PLY.

    Attributes:
        count: Number of Gaussians.
        sh_degree: 0..3.
        comments: The comment lines' texts, in order.
        row: numpy's structured type of one vertex, in the file's byte order.
        offset_bytes: Where the vertices begin.
        dialect: How its properties differ from those of 3DGS.
    """

    count: int
    sh_degree: int
    comments: tuple[str, ...]
    row: np.dtype[np.void]
    offset_bytes: int
    dialect: PlyDialect


def write_splat(
    path: Path, gaussians: Gaussians, comments: Sequence[str] = (), offset: tuple[float, float, float] = NO_OFFSET
) -> None:
    """Write the exact 3DGS layout: binary little-endian float32, normals of zero, f_rest channel-major.

    Args:
        path: The file; replaced if it exists.
        gaussians: Gaussians to write, as raw parameters (logits, logarithms, (w, x, y, z)).
        comments: Header comments, one line each; non-ASCII characters are escaped.
        offset: Added to the positions, which are then float64; zero for float32.

    Raises:
        ValueError: if a value is not finite, or a comment has a line break.
        OSError: if the file cannot be written.
    """
    gaussians = gaussians.detach().to("cpu", torch.float32)
    _check_finite(gaussians)
    with new_file(path) as file:
        file.write(_header(len(gaussians), gaussians.sh_degree, comments, "f4" if offset == NO_OFFSET else "f8"))
        _write_rows(file, gaussians, offset)


def write_splat_parts(
    path: Path, parts: Iterable[Gaussians], count: int, sh_degree: int, comments: Sequence[str] = ()
) -> None:
    """Write the same bytes as ``write_splat`` for the concatenated parts, without keeping any of them in memory.

    Args:
        path: The file; replaced if it exists, and not a valid splat if this fails.
        parts: Consumed one by one.
        count: Number of Gaussians in all parts.
        sh_degree: SH degree of all parts.
        comments: As for ``write_splat``.

    Raises:
        ValueError: as ``write_splat``, or if the parts do not have this count or degree.
        OSError: if the file cannot be written.
    """
    left = count
    with new_file(path) as file:
        file.write(_header(count, sh_degree, comments))
        for part in parts:
            if part.sh_degree != sh_degree:
                raise ValueError(f"a part is of SH degree {part.sh_degree}, not {sh_degree}")
            gaussians = part.detach().to("cpu", torch.float32)
            _check_finite(gaussians)
            _write_rows(file, gaussians)
            left -= len(gaussians)
    if left:
        raise ValueError(f"parts of {count - left} Gaussians were to be of {count}")


def _header(count: int, sh_degree: int, comments: Sequence[str], position: str = "f4") -> bytes:
    fields = tuple((name, position if name in _POSITION else "f4") for name in property_names(sh_degree))
    return ply_header_bytes([PlyElement("vertex", count, fields)], comments)


def _check_finite(gaussians: Gaussians) -> None:
    bad = len(gaussians) - int(gaussians.finite().sum())
    if bad:
        raise ValueError(f"{bad} Gaussians have values that are not finite: never to be written")


def _write_rows(file: BinaryIO, gaussians: Gaussians, offset: tuple[float, float, float] = NO_OFFSET) -> None:
    far = torch.tensor(offset, dtype=torch.float64)
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
        if offset == NO_OFFSET:
            file.write(torch.cat(columns, dim=1).numpy().astype("<f4", copy=False).tobytes())
            continue
        rest = torch.cat(columns[1:], dim=1).numpy()
        rows = np.empty(len(piece), [("position", "<f8", 3), ("rest", "<f4", rest.shape[1])])
        rows["position"], rows["rest"] = (piece.means.double() + far).numpy(), rest
        file.write(rows.tobytes())


def property_names(sh_degree: int) -> list[str]:
    """The vertex's properties in the order of the 3DGS layout."""
    rest = [f"f_rest_{i}" for i in range(3 * (coefficient_count(sh_degree) - 1))]
    return [*_POSITION, *_NORMAL, *DC, *rest, "opacity", *SCALE, *_ROTATION]


def read_splat(path: Path) -> Gaussians:
    """Read a splat by property name: any order, either byte order, float or double, with or without normals.

    Infinite opacity logits and log scales (scales of zero), which some converters write, become large finite values.

    Args:
        path: A binary PLY of SH degree 0..3.

    Returns:
        float32 Gaussians on the CPU.

    Raises:
        SplatpipeError: if the file is missing, truncated, not a splat, or has values that are not numbers.
    """
    gaussians, _ = read_stored_splat(path)
    check_values(path, gaussians)
    gaussians.means = gaussians.means.float()
    return gaussians


def read_stored_splat(path: Path) -> tuple[Gaussians, SplatHeader]:
    """As ``read_splat``, with positions of float64 if the file has any, and values that nobody has checked.

    Raises:
        SplatpipeError: as ``read_splat``, except for the values.
    """
    with open_file(path) as file:
        header = _read_header(path, file)
        gaussians = Gaussians.empty(header.count, header.sh_degree)
        if any(header.row[name].itemsize == 8 for name in _POSITION):
            gaussians.means = torch.zeros(header.count, 3, dtype=torch.float64)
        start = 0
        for rows in _chunks(path, file, header):
            _fill(gaussians, start, rows, header.dialect)
            start += len(rows)
    return gaussians, header


def read_splat_header(path: Path) -> SplatHeader:
    """Read only the header of a splat PLY, and check it, also against the file's size.

    Raises:
        SplatpipeError: as ``read_splat``, except for the values.
    """
    with open_file(path) as file:
        return _read_header(path, file)


def _read_header(path: Path, file: BinaryIO) -> SplatHeader:
    """Parse the header; the file position afterwards is unspecified."""
    header = read_ply_header(path, file)
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    if vertex is None:
        raise SplatpipeError(f"{path} has no vertices.", hint=PLY_HINT)
    dialect = dialect_of(dict(vertex.fields))
    degree = _check_vertex(path, vertex, dialect, has_chunks=any(e.name == "chunk" for e in header.elements))
    offset = header.offset_of(path, vertex)
    return SplatHeader(vertex.count, degree, header.comments, header.row_of(vertex), offset, dialect)


def _check_vertex(path: Path, vertex: PlyElement, dialect: PlyDialect, has_chunks: bool) -> int:
    """Check that a vertex element is a splat's; returns its SH degree."""
    kinds = dict(vertex.fields)
    if has_chunks and "packed_position" in kinds:
        raise SplatpipeError(
            f"{path} is a compressed PLY.", hint="Convert it to a plain PLY first: splatpipe convert IN OUT.ply."
        )
    required = [name for name in _REQUIRED if name not in dialect.replaced]
    missing = [name for name in required if name not in kinds]
    if missing:
        bare = "f_dc_0" in missing or (dialect.byte_colours and "opacity" in missing)
        what = "a point cloud or a mesh" if bare and "x" not in missing else "incomplete"
        raise SplatpipeError(f"{path} is not a splat but {what}: it has no {', '.join(missing)}.", hint=PLY_HINT)
    rest = [name for name in kinds if name.startswith("f_rest_")]
    degrees = {3 * (coefficient_count(degree) - 1): degree for degree in range(MAX_DEGREE + 1)}
    if len(rest) not in degrees or {f"f_rest_{i}" for i in range(len(rest))} != set(rest):
        raise SplatpipeError(
            f"{path}: {len(rest)} f_rest properties are not spherical harmonics of degree 0 to {MAX_DEGREE}.",
            hint=PLY_HINT,
        )
    if vertex.has_list or any(kinds[name] not in ("f4", "f8") for name in [*required, *rest]):
        raise SplatpipeError(f"{path}: a splat's properties must be floats.", hint=PLY_HINT)
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


def _fill(gaussians: Gaussians, start: int, rows: np.ndarray, dialect: PlyDialect) -> None:
    """Convert rows into the Gaussians from ``start`` on."""
    part = slice(start, start + len(rows))

    def columns(names: Sequence[str], kind: str = "f4") -> torch.Tensor:
        out = np.empty((len(rows), len(names)), dtype=kind)
        with np.errstate(over="ignore", invalid="ignore"):  # a double beyond float32 becomes an infinity: reported
            for i, name in enumerate(names):
                out[:, i] = rows[name]
        return torch.from_numpy(out)

    k = gaussians.sh.shape[1]
    rest = columns([f"f_rest_{i}" for i in range(3 * (k - 1))])
    gaussians.means[part] = columns(_POSITION, "f4" if gaussians.means.dtype == torch.float32 else "f8")
    gaussians.sh[part, 0] = (columns(BYTE_COLOURS) / 255.0 - 0.5) / C0 if dialect.byte_colours else columns(DC)
    gaussians.sh[part, 1:] = rest.reshape(len(rows), 3, k - 1).transpose(1, 2)
    logits = columns(["opacity"])[:, 0]
    infinite = torch.isinf(logits)
    logits = torch.where(infinite, torch.sign(logits) * _INFINITY_LOGIT, logits)
    log_scales = columns([name for name in SCALE if name not in dialect.replaced])
    if dialect.flat:
        log_scales = torch.cat([log_scales, torch.full((len(rows), 1), _INFINITY_LOG_SCALE)], dim=1)
    log_scales[log_scales == -torch.inf] = _INFINITY_LOG_SCALE
    if dialect.filtered:
        log_scales, logits = convolved(log_scales, logits, columns([FILTER])[:, 0])
    gaussians.log_scales[part], gaussians.opacity_logits[part] = log_scales, logits
    gaussians.quats[part] = columns(_ROTATION)
