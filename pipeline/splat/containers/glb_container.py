"""GLB, the container of binary glTF: a JSON document and one binary chunk; writes our own, reads anybody's.

Specification: Khronos, "glTF 2.0", section 4 (the GLB file format) and 3.6 (buffers, buffer views and accessors).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import Any, NoReturn, TypeGuard

import numpy as np
from jaxtyping import Float32

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.bounded import file_bytes, read_exactly

MAGIC, VERSION = 0x46546C67, 2  # "glTF"
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942  # "JSON", "BIN\0"
MAX_BYTES = 2**32 - 1
"""Largest file: its length is stored in 32 bits."""
MAX_JSON_BYTES = 1 << 22
"""A splat's document has a few kB; parsed into Python objects, it takes twenty times its size."""
BYTE, UNSIGNED_BYTE, SHORT, UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5120, 5121, 5122, 5123, 5125, 5126
_NUMBERS = {BYTE: "<i1", UNSIGNED_BYTE: "<u1", SHORT: "<i2", UNSIGNED_SHORT: "<u2", UNSIGNED_INT: "<u4", FLOAT: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_MIN_STRIDE, _MAX_STRIDE = 4, 252
_HEADER, _CHUNK_HEADER = struct.Struct("<III"), struct.Struct("<II")
_AGAIN = "Export it again."


def padded(count: int) -> int:
    """A byte count rounded up to a multiple of 4, the alignment of chunks and their contents."""
    return -(-count // 4) * 4


def write_head(file: BufferedIOBase, document: Mapping[str, Any], binary_bytes: int) -> None:
    """Write a GLB up to the start of its binary chunk's data.

    Args:
        file: Positioned at its beginning.
        document: The glTF JSON document.
        binary_bytes: Size of the binary chunk; a multiple of 4.

    Raises:
        SplatpipeError: if the file would be larger than a GLB can be.
        ValueError: if the document has a non-finite number, or the chunk's size is not a multiple of 4.
    """
    if binary_bytes % 4:
        raise ValueError(f"a chunk of {binary_bytes} bytes does not end at a multiple of 4")
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")
    text += b" " * (padded(len(text)) - len(text))
    total = _HEADER.size + 2 * _CHUNK_HEADER.size + len(text) + binary_bytes
    if total > MAX_BYTES:
        raise SplatpipeError(
            f"A GLB cannot have {total / 1e9:.1f} GB: its length is a 32-bit number, at most 4.3 GB.",
            hint="Reduce the splat, crop it, or choose another format: ply, spz or 3dtiles.",
        )
    file.write(_HEADER.pack(MAGIC, VERSION, total))
    file.write(_CHUNK_HEADER.pack(len(text), JSON_CHUNK) + text)
    file.write(_CHUNK_HEADER.pack(binary_bytes, BINARY_CHUNK))


@dataclass(frozen=True)
class Accessor:
    """Location of an attribute's rows in a file, checked to be inside it.

    Attributes:
        count: Number of rows.
        components: Components per row.
        number: Type of a component.
        normalized: Whether integers stand for 0..1, or −1..1.
        offset: Offset of the first row from the file's beginning, bytes.
        stride: Distance from row to row, bytes.
    """

    count: int
    components: int
    number: np.dtype[Any]
    normalized: bool
    offset: int
    stride: int

    def rows(self, path: Path, file: BufferedIOBase, start: int, count: int) -> Float32[np.ndarray, "n c"]:
        """Read some of the rows.

        Args:
            path: For the error message.
            file: The file that contains the rows.
            start: The first row.
            count: Number of rows, at least one; few enough to fit in memory.

        Raises:
            SplatpipeError: if the file cannot be read.
        """
        size = self.components * self.number.itemsize
        file.seek(self.offset + start * self.stride)
        data = read_exactly(path, file, (count - 1) * self.stride + size)
        shape, strides = (count, self.components), (self.stride, self.number.itemsize)
        values = np.ndarray(shape, self.number, data, 0, strides).astype(np.float32)
        if self.normalized and self.number.kind in "iu":
            values = np.maximum(values / np.float32(np.iinfo(self.number).max), np.float32(-1.0))
        return np.ascontiguousarray(values)


@dataclass(frozen=True)
class Container:
    """An open GLB.

    Attributes:
        path: Its path.
        file: The open file.
        document: The glTF JSON document, with unchecked values.
        start: Offset of the binary chunk's data from the file's beginning, bytes.
        length: Length of that data, bytes.
    """

    path: Path
    file: BufferedIOBase
    document: Mapping[str, Any]
    start: int
    length: int

    def refuse(self, what: str) -> NoReturn:
        """Report the file as damaged.

        Raises:
            SplatpipeError: always.
        """
        raise SplatpipeError(f"{self.path} is damaged: {what}.", hint=_AGAIN)

    def entry(self, name: str, index: Any) -> Mapping[str, Any]:
        """One of the document's objects.

        Args:
            name: Name of the list that contains it.
            index: Its index in the list, as the file states it.

        Raises:
            SplatpipeError: if it does not exist.
        """
        entries = self.document.get(name)
        if not isinstance(entries, list) or not _is_whole(index) or index >= len(entries):
            self.refuse(f"its {name} have no number {str(index)[:40]}")
        entry = entries[index]
        if not isinstance(entry, dict):
            self.refuse(f"one of its {name} is not an object")
        return entry

    def view(self, index: Any) -> tuple[int, int, int | None]:
        """A buffer view: its offset from the file's beginning, its length and its stride, bytes.

        Raises:
            SplatpipeError: if it is not inside the file.
        """
        view = self.entry("bufferViews", index)
        buffer = self.entry("buffers", view.get("buffer"))
        if "uri" in buffer or view["buffer"] != 0:
            raise SplatpipeError(
                f"{self.path} keeps its data in other files, which cannot be read.",
                hint="Export it as one GLB file that holds everything.",
            )
        extensions = view.get("extensions")
        if isinstance(extensions, dict) and "EXT_meshopt_compression" in extensions:
            raise SplatpipeError(
                f"{self.path} is in meshopt's compression, which cannot be read.", hint="Export it without."
            )
        offset, length, stride = view.get("byteOffset", 0), view.get("byteLength"), view.get("byteStride")
        if not _is_whole(offset) or not _is_whole(length) or offset + length > self.length:
            self.refuse("a buffer view lies outside its data")
        if stride is not None and not (_is_whole(stride) and _MIN_STRIDE <= stride <= _MAX_STRIDE):
            self.refuse("a buffer view's stride is not valid")
        return self.start + offset, length, stride

    def accessor(self, index: Any, kinds: tuple[str, ...]) -> Accessor:
        """An accessor whose rows lie inside the file.

        Args:
            index: Its index, as the file states it.
            kinds: Accepted types: ``SCALAR``, ``VEC3``, ``VEC4``.

        Raises:
            SplatpipeError: if it does not exist, has another type, is sparse, or lies outside of its data.
        """
        found = self.entry("accessors", index)
        if "bufferView" not in found or "sparse" in found:
            raise SplatpipeError(f"{self.path} has sparse or missing data, which cannot be read.", hint=_AGAIN)
        kind, component = found.get("type"), found.get("componentType")
        if kind not in kinds or not _is_whole(component) or component not in _NUMBERS:
            self.refuse(f"an accessor has the type {str(kind)[:20]} of {str(component)[:20]}, which is not valid")
        number, components = np.dtype(_NUMBERS[component]), _COMPONENTS[kind]
        start, length, stride = self.view(found["bufferView"])
        offset, count, size = found.get("byteOffset", 0), found.get("count"), components * number.itemsize
        stride = size if stride is None else stride
        if not _is_whole(count) or count < 1 or not _is_whole(offset) or stride < size:
            self.refuse("an accessor's rows are not valid")
        if offset + (count - 1) * stride + size > length:
            self.refuse(f"an accessor of {str(count)[:20]} rows lies outside its data")
        return Accessor(count, components, number, found.get("normalized") is True, start + offset, stride)


def open_container(path: Path, file: BufferedIOBase) -> Container:
    """Read a GLB's document and the location of its data.

    Args:
        path: For the error messages.
        file: Positioned at its beginning.

    Raises:
        SplatpipeError: if it is not a GLB, or its lengths do not match the file.
    """
    magic, version, total = _HEADER.unpack(read_exactly(path, file, _HEADER.size))
    if magic != MAGIC:
        raise SplatpipeError(f"{path} is not a GLB.", hint="Convert a .gltf and its files to one .glb first.")
    if version != VERSION:
        raise SplatpipeError(f"{path} is a GLB of version {version}, not {VERSION}.", hint=_AGAIN)
    if total > file_bytes(file):
        raise SplatpipeError(f"{path} is cut off: it has {file_bytes(file):,} of {total:,} bytes.", hint=_AGAIN)
    length, kind = _CHUNK_HEADER.unpack(read_exactly(path, file, _CHUNK_HEADER.size))
    start = _HEADER.size + _CHUNK_HEADER.size
    if kind != JSON_CHUNK or start + length > total:
        raise SplatpipeError(f"{path} is damaged: its first chunk is not JSON within the file.", hint=_AGAIN)
    if length > MAX_JSON_BYTES:
        raise SplatpipeError(f"{path} has {length:,} bytes of JSON, more than any splat needs.", hint=_AGAIN)
    document = _parsed(path, read_exactly(path, file, length))
    start, length = start + length, 0
    if start + _CHUNK_HEADER.size <= total:
        length, kind = _CHUNK_HEADER.unpack(read_exactly(path, file, _CHUNK_HEADER.size))
        start += _CHUNK_HEADER.size
        if kind != BINARY_CHUNK or start + length > total:
            raise SplatpipeError(f"{path} is damaged: its second chunk is not data within the file.", hint=_AGAIN)
    return Container(path, file, document, start, length)


def _parsed(path: Path, text: bytes) -> Mapping[str, Any]:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError, and integers of thousands of digits, too
        raise SplatpipeError(f"{path} is damaged: its JSON cannot be read.", hint=_AGAIN) from error
    if not isinstance(document, dict):
        raise SplatpipeError(f"{path} is damaged: its JSON is not an object.", hint=_AGAIN)
    return document


def _is_whole(value: Any) -> TypeGuard[int]:
    """Whether a value is a non-negative integer: to Python, JSON's true is an int, and 1e400 a float."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0
