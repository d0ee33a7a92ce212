"""The header of a PLY file: its elements and their offsets, checked against the file's size.

G. Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError

PLY_HINT = "Give a splat as trainers write it: a binary PLY with x, f_dc_0, opacity, scale_0, rot_0 and so on."
_MAX_HEADER_BYTES = 65_536
"""A degree 3 splat's header has 1.5 kB, and a record of ours less than 60,000 bytes: no splat's header has more."""
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
_NAMES = {"u1": "uchar", "u4": "uint", "f4": "float", "f8": "double"}  # the types that we write
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class PlyElement:
    """An element of a PLY file.

    Attributes:
        name: ``vertex`` and so on.
        count: Number of rows.
        fields: Names and numpy types of its properties, except lists.
        has_list: Whether a property is a list, so that rows have no fixed length.
    """

    name: str
    count: int
    fields: tuple[tuple[str, str], ...]
    has_list: bool = False


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file.

    Attributes:
        byte_order: In numpy's notation.
        comments: The comment lines' texts, in order.
        elements: In the file's order, with unique names.
        offset_bytes: Offset of the first element.
        size_bytes: Size of the file.
    """

    byte_order: str
    comments: tuple[str, ...]
    elements: tuple[PlyElement, ...]
    offset_bytes: int
    size_bytes: int

    def row_of(self, element: PlyElement) -> np.dtype[np.void]:
        """numpy's structured type of one row, in the file's byte order."""
        return np.dtype([(name, self.byte_order + kind) for name, kind in element.fields])

    def offset_of(self, path: Path, element: PlyElement) -> int:
        """Offset of an element in bytes, checked that all its rows are in the file.

        Args:
            path: The file, for the error message.
            element: One of the header's elements, without lists.

        Raises:
            SplatpipeError: if the file is too short, or has lists before the element.
        """
        offset = self.offset_bytes
        for each in self.elements[: self.elements.index(element)]:
            if each.has_list:
                raise SplatpipeError(f"{path}: lists before the vertices are not supported.", hint=PLY_HINT)
            offset += each.count * self.row_of(each).itemsize
        row_bytes = self.row_of(element).itemsize
        if offset + element.count * row_bytes > self.size_bytes:
            what = {"vertex": "Gaussians"}.get(element.name, f"rows of {element.name[:40]}")
            room = max(0, self.size_bytes - offset) // max(row_bytes, 1)
            raise SplatpipeError(
                f"{path} is cut off: its header declares {element.count} {what}, but it has room for {room}.",
                hint="Copy or export it again.",
            )
        return offset


def ply_header_bytes(elements: Sequence[PlyElement], comments: Sequence[str]) -> bytes:
    """The header of a binary little-endian file.

    Args:
        elements: In order, with uint8, uint32, float32 and float64 properties.
        comments: One line each; non-ASCII characters are escaped.

    Raises:
        ValueError: if a comment has a line break.
    """
    if any(character in comment for comment in comments for character in "\r\n"):
        raise ValueError("a PLY comment is one line")
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}" for comment in comments]
    for element in elements:
        lines += [f"element {element.name} {element.count}"]
        lines += [f"property {_NAMES[kind]} {name}" for name, kind in element.fields]
    lines += ["end_header", ""]
    return "\n".join(lines).encode("ascii", "backslashreplace")


def read_ply_header(path: Path, file: BinaryIO) -> PlyHeader:
    """Parse the header; the file position afterwards is unspecified.

    Raises:
        SplatpipeError: if the file is not a PLY, or a text PLY.
    """
    lines, offset = _header_lines(path, file)
    byte_order, comments, elements = _parse_lines(path, lines)
    return PlyHeader(byte_order, tuple(comments), elements, offset, file.seek(0, 2))


def _header_lines(path: Path, file: BinaryIO) -> tuple[list[str], int]:
    """The header's lines without its first and last, and the offset of the data."""
    try:
        start = file.read(_MAX_HEADER_BYTES)
    except OSError as error:  # on some systems a folder can be opened and fails here
        raise SplatpipeError(f"Cannot read {path}: {error.strerror}.", hint="Check the path.") from error
    if not re.match(rb"ply[ \t]*\r?\n", start):
        raise SplatpipeError(f"{path} is not a PLY file.", hint=PLY_HINT)
    end = re.search(rb"\nend_header[ \t]*\r?\n", start)
    if end is None:
        raise SplatpipeError(f"{path}: its PLY header does not end.", hint=PLY_HINT)
    text = start[: end.start()].decode("utf-8", "replace")
    return [line.strip() for line in text.split("\n")[1:]], end.end()


def _parse_lines(path: Path, lines: Sequence[str]) -> tuple[str, list[str], tuple[PlyElement, ...]]:
    """Byte order, comments and elements of a header."""
    byte_order = ""
    comments: list[str] = []
    elements: list[tuple[str, int, list[tuple[str, str] | None]]] = []  # None for a list
    for line in lines:
        match line.split():
            case [] | ["obj_info", *_]:
                pass
            case ["comment", *_]:
                comments.append(line[len("comment") :].strip())
            case ["format", "ascii", _]:
                raise SplatpipeError(
                    f"{path} is a text PLY.",
                    hint="Export it as a binary PLY; coordinates of UTM and the like need 64 bits (property double).",
                )
            case ["format", kind, "1.0"] if kind in _BYTE_ORDERS and not byte_order:
                byte_order = _BYTE_ORDERS[kind]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count, re.ASCII):
                elements.append((name, int(count), []))
            case ["property", "list", kind, item, _] if kind in _TYPES and item in _TYPES and elements:
                elements[-1][2].append(None)
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1][2].append((name, _TYPES[kind]))
            case _:
                raise SplatpipeError(f"{path}: {line[:80]!r} is not a valid line of a PLY header.", hint=PLY_HINT)
    if not byte_order:
        raise SplatpipeError(f"{path}: its PLY header does not name a format.", hint=PLY_HINT)
    found = tuple(
        PlyElement(name, count, tuple(field for field in fields if field is not None), None in fields)
        for name, count, fields in elements
    )
    for named in ([each.name for each in found], *([name for name, _ in each.fields] for each in found)):
        if len(set(named)) != len(named):
            raise SplatpipeError(f"{path}: its PLY header declares a name twice.", hint=PLY_HINT)
    return byte_order, comments, found
