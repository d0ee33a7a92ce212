"""SPZ: reads versions 1 to 3 (a gzip stream) and 4 (a header and zstd streams), writes 3 and 2.

The numbers are those of ``splat.containers.spz_encoder``. Specification: README.md and src/cc/load-spz.cc of
github.com/nianticlabs/spz. Our record is in gzip's extra field, which SPZ readers do not see.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BufferedReader
from pathlib import Path

import numpy as np
import torch
import zstandard
from jaxtyping import Float32, UInt8

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.splat.containers.bounded import (
    CheckValues,
    InflatedFile,
    check_expansion,
    check_values,
    file_bytes,
    open_file,
    read_exactly,
)
from splatpipe.pipeline.splat.containers.spz_encoder import (
    ANTIALIASED,
    ARRAYS,
    COLOUR_SCALE,
    FIRST_THREE_VERSION,
    LOG_SCALE_STEPS,
    MAGIC,
    MIN_LOG_SCALE,
    RECORD_FIELD,
    ROTATION_STEPS,
    SH_STEPS,
    VERSION,
    position_cost,
    spz_bytes,
)
from splatpipe.pipeline.splat.formats.near_origin import scene_near_origin
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.position_cost import PositionCost
from splatpipe.pipeline.splat.model.scene import Axes, Scene, SceneFacts, facts_of_record, turn_of
from splatpipe.pipeline.splat.model.sh import MAX_DEGREE, coefficient_count

AXES: Axes = "y up"
HALF_VERSION, ZSTD_VERSION = 1, 4  # positions in half floats; zstd streams
HAS_EXTENSIONS = 2
COORDINATES_EXTENSION = 0xADBE0003
"""SPZ_ADOBE_coordinate_system, which declares other axes."""
RIGHT_UP_BACK = 4
_ROWS = 1 << 16
_HEADER, _ZSTD_HEADER = struct.Struct("<IIIBBBB"), struct.Struct("<IIIBBBBI12x")
_TABLE_ENTRY = struct.Struct("<QQ")
_MAX_EXTENSION_BYTES = 1 << 16
_MAX_WINDOW_BYTES = 1 << 26
"""Largest zstd window: for streams of such size, writers' highest levels use 8 MB."""
_MAX_GZIP_HEADER_BYTES = 12 + 65_535
_HAS_EXTRA_FIELD = 4
_ALPHA_END = 0.25 / 255.0
"""Replaces an opacity coded as 0, and 1 minus this one coded as 1, whose logits would be infinite."""
_AGAIN = "Copy or export it again."


def write(path: Path, scene: Scene) -> PositionCost:
    """Write version 3, y up.

    Args:
        path: The file; replaced if it exists.
        scene: The scene.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    return _write(path, scene, VERSION)


def write_version_2(path: Path, scene: Scene) -> PositionCost:
    """Write version 2, which older readers and CesiumJS need; its rotations are coarse.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    return _write(path, scene, FIRST_THREE_VERSION)


def _write(path: Path, scene: Scene, version: int) -> PositionCost:
    facts = scene.facts.turned(AXES)
    turn = None if scene.facts.axes == AXES else turn_of(AXES, scene.facts.axes)
    write_file(path, spz_bytes(scene.gaussians, facts.antialias, turn=turn, version=version, record=facts.record()))
    return position_cost(scene.gaussians)


def read(path: Path, check: CheckValues = check_values) -> Scene:
    """Read a file; without a record of ours it is assumed to be y up, as specified, and not georeferenced.

    Raises:
        SplatpipeError: if the file is missing, truncated, damaged, not an SPZ, or of an unsupported kind.
    """
    with open_file(path) as file:
        start = file.read(_MAX_GZIP_HEADER_BYTES)
        file.seek(0)
        if start.startswith(b"NGSP"):
            packed, record = _zstd_streams(path, file), None
        elif start.startswith(b"\x1f\x8b"):
            packed, record = _gzip_stream(path, file), _record(start)
        else:
            raise SplatpipeError(f"{path} is not an SPZ file.", hint=_AGAIN)
        gaussians = _decoded(packed)
        _check_end(path, packed)
    check(path, gaussians)
    facts = facts_of_record(record, SceneFacts(AXES, antialias=bool(packed.flags & ANTIALIASED)))
    return scene_near_origin(path, gaussians, facts)


class _ZstdStream:
    """Sequential reader of a zstd stream in a file; streams are read one after another.

    Args:
        path: For error messages.
        file: The file.
        offset: Start of the stream, bytes.
    """

    def __init__(self, path: Path, file: BufferedReader, offset: int) -> None:
        self._path, self._file, self._offset = path, file, offset
        self._reader: zstandard.ZstdDecompressionReader | None = None

    def exactly(self, count: int) -> bytes:
        """The next bytes, all of them.

        Raises:
            SplatpipeError: if the stream ends before, or is damaged.
        """
        data = self.at_most(count)
        if len(data) != count:
            raise SplatpipeError(f"{self._path} is cut off: its data end early.", hint=_AGAIN)
        return data

    def at_most(self, count: int) -> bytes:
        """The next bytes; fewer at the end.

        Raises:
            SplatpipeError: if the stream is damaged.
        """
        if self._reader is None:
            self._file.seek(self._offset)
            inflate = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
            self._reader = inflate.stream_reader(self._file, closefd=False)
        parts, left = [], count
        try:
            while left and (part := self._reader.read(left)):
                parts.append(part)
                left -= len(part)
        except zstandard.ZstdError as error:
            raise SplatpipeError(f"{self._path} is damaged: a zstd stream is broken.", hint=_AGAIN) from error
        return b"".join(parts)


@dataclass(frozen=True)
class _Packed:
    """An SPZ file of any version, before its arrays are read.

    Attributes:
        version: 1 to 4.
        count: Number of Gaussians, checked against the file's size.
        degree: SH degree.
        fractional_bits: Fractional bits of the positions.
        flags: Flags of the header.
        streams: Stream of each array: the same for all, or one each.
    """

    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int
    streams: Sequence[InflatedFile | _ZstdStream] = ()

    def widths(self) -> list[int]:
        """Bytes per Gaussian in each array."""
        position = 6 if self.version == HALF_VERSION else 9
        rotation = 3 if self.version <= FIRST_THREE_VERSION else 4
        return [position, 1, 3, 3, rotation, 3 * (coefficient_count(self.degree) - 1)]


def _checked(path: Path, packed: _Packed, stored_bytes: int) -> _Packed:
    if packed.degree > MAX_DEGREE:
        raise SplatpipeError(
            f"{path}: harmonics of degree {packed.degree} cannot be read.", hint=f"Export it with at most {MAX_DEGREE}."
        )
    check_expansion(path, packed.count * sum(packed.widths()), stored_bytes)
    return packed


def _gzip_stream(path: Path, file: BufferedReader) -> _Packed:
    stream = InflatedFile(path, file)
    magic, version, count, degree, bits, flags, _ = _HEADER.unpack(stream.exactly(_HEADER.size))
    if magic != MAGIC:
        raise SplatpipeError(f"{path} is not an SPZ file.", hint=_AGAIN)
    if not HALF_VERSION <= version <= VERSION:
        raise SplatpipeError(f"{path}: version {version} of SPZ cannot be read.", hint="Export it as version 3.")
    return _checked(path, _Packed(version, count, degree, bits, flags, [stream] * ARRAYS), file_bytes(file))


def _zstd_streams(path: Path, file: BufferedReader) -> _Packed:
    head = _ZSTD_HEADER.unpack(read_exactly(path, file, _ZSTD_HEADER.size))
    _, version, count, degree, bits, flags, stream_count, table = head
    if version != ZSTD_VERSION:
        raise SplatpipeError(f"{path}: version {version} of SPZ cannot be read.", hint="Export it as version 3.")
    packed = _checked(path, _Packed(version, count, degree, bits, flags), file_bytes(file))
    expected = [width * count for width in packed.widths() if width * count]
    if not _ZSTD_HEADER.size <= table <= _ZSTD_HEADER.size + _MAX_EXTENSION_BYTES or stream_count != len(expected):
        raise SplatpipeError(f"{path} is damaged: its header is not valid.", hint=_AGAIN)
    if flags & HAS_EXTENSIONS:
        _check_coordinates(path, read_exactly(path, file, table - _ZSTD_HEADER.size))
    file.seek(table)
    entries = [_TABLE_ENTRY.unpack(read_exactly(path, file, _TABLE_ENTRY.size)) for _ in expected]
    if [size for _, size in entries] != expected:
        raise SplatpipeError(f"{path} is damaged: its streams do not hold {count} Gaussians.", hint=_AGAIN)
    offset = file.tell()
    streams = []
    for stored, _ in entries:
        streams.append(_ZstdStream(path, file, offset))
        offset += stored
    if offset != file_bytes(file):
        raise SplatpipeError(f"{path} is damaged or cut off: its streams do not end with the file.", hint=_AGAIN)
    return replace(packed, streams=streams)


def _check_end(path: Path, packed: _Packed) -> None:
    """Read up to the checksums after the last array; extensions may come before them."""
    rest = b"".join(stream.at_most(_MAX_EXTENSION_BYTES + 1) for stream in packed.streams[-1:])
    if len(rest) > _MAX_EXTENSION_BYTES:
        raise SplatpipeError(f"{path} holds more than its header says.", hint=_AGAIN)
    if packed.version < ZSTD_VERSION and packed.flags & HAS_EXTENSIONS:
        _check_coordinates(path, rest)


def _check_coordinates(path: Path, extensions: bytes) -> None:
    """Refuse a file whose extensions declare axes other than those specified."""
    at = 0
    while at + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, at)
        value = extensions[at + 8 : at + 8 + size]
        if kind == COORDINATES_EXTENSION and value[:4] not in (bytes(4), struct.pack("<I", RIGHT_UP_BACK)):
            raise SplatpipeError(f"{path} has axes other than SPZ's (y up).", hint="Export it right, up, back (RUB).")
        at += 8 + size


def _record(start: bytes) -> bytes | None:
    """Our record in a gzip file's extra field."""
    if len(start) < 12 or not start[3] & _HAS_EXTRA_FIELD:
        return None
    extra = start[12 : 12 + struct.unpack_from("<H", start, 10)[0]]
    while len(extra) >= 4:
        size = struct.unpack_from("<H", extra, 2)[0]
        if extra[:2] == RECORD_FIELD:
            return extra[4 : 4 + size]
        extra = extra[4 + size :]
    return None


def _decoded(packed: _Packed) -> Gaussians:
    """Read and decode the arrays in pieces."""
    gaussians = Gaussians.empty(packed.count, packed.degree)
    for i, (stream, width) in enumerate(zip(packed.streams, packed.widths(), strict=False)):
        for start in range(0, packed.count if width else 0, _ROWS):
            rows = min(_ROWS, packed.count - start)
            data = np.frombuffer(stream.exactly(rows * width), np.uint8).reshape(rows, width)
            _put(gaussians, slice(start, start + rows), i, data, packed)
    return gaussians


def _put(gaussians: Gaussians, part: slice, array: int, data: UInt8[np.ndarray, "n w"], packed: _Packed) -> None:
    """Decode some rows of one of the arrays."""
    values = data.astype(np.float32)
    match array:
        case 0:
            gaussians.means[part] = torch.from_numpy(_positions(data, packed))
        case 1:
            alpha = np.clip(data[:, 0] / 255.0, _ALPHA_END, 1.0 - _ALPHA_END)
            gaussians.opacity_logits[part] = torch.from_numpy(np.log(alpha / (1.0 - alpha)).astype(np.float32))
        case 2:
            gaussians.sh[part, 0] = torch.from_numpy((values / 255.0 - 0.5) / COLOUR_SCALE)
        case 3:
            gaussians.log_scales[part] = torch.from_numpy(values / LOG_SCALE_STEPS + MIN_LOG_SCALE)
        case 4:
            coarse = packed.version <= FIRST_THREE_VERSION
            gaussians.quats[part] = torch.from_numpy(_first_three(data) if coarse else _smallest_three(data))
        case _:
            gaussians.sh[part, 1:] = torch.from_numpy((values - SH_STEPS) / SH_STEPS).reshape(len(data), -1, 3)


def _positions(data: UInt8[np.ndarray, "n w"], packed: _Packed) -> Float32[np.ndarray, "n 3"]:
    """Positions from three bytes per coordinate, little-endian two's complement; version 1 has half floats."""
    if packed.version == HALF_VERSION:
        return np.asarray(np.ascontiguousarray(data).view("<f2").astype(np.float32))
    parts = data.reshape(len(data), 3, 3).astype(np.int32)
    steps = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    signed = (steps ^ 1 << 23) - (1 << 23)
    return np.asarray((signed * 2.0**-packed.fractional_bits).astype(np.float32))


def _first_three(data: UInt8[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 4"]:
    """Unit quaternions (w, x, y, z) from x, y, z in one byte each."""
    xyz = data / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - (xyz * xyz).sum(axis=1, keepdims=True), 0.0))
    return _unit(np.concatenate([w, xyz], axis=1))


def _smallest_three(data: UInt8[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
    """Unit quaternions (w, x, y, z) from the three smallest of x, y, z, w: see ``splat.containers.spz_encoder``."""
    words = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    parts = words[:, None] >> np.array([20, 10, 0])
    size = (parts & ROTATION_STEPS) * (np.sqrt(0.5) / ROTATION_STEPS)
    rest = np.where(parts >> 9 & 1, -size, size)
    largest = np.sqrt(np.maximum(1.0 - (rest * rest).sum(axis=1, keepdims=True), 0.0))
    which = words[:, None] >> 30
    xyzw = np.empty((len(data), 4))
    np.put_along_axis(xyzw, np.arange(3) + (np.arange(3) >= which), rest, axis=1)
    np.put_along_axis(xyzw, which, largest, axis=1)
    return _unit(xyzw[:, [3, 0, 1, 2]])


def _unit(quats: np.ndarray) -> Float32[np.ndarray, "n 4"]:
    return np.asarray((quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32))
