"""A GLB's document and data, split and joined by its specification (glTF 2.0, section 4.4)."""

import json
import struct
from typing import Any


def parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return both of a file's chunks."""
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and length % 4 == 0
    binary_length, binary_kind = struct.unpack_from("<I4s", data, 20 + length)
    assert binary_kind == b"BIN\0" and 28 + length + binary_length == len(data) and binary_length % 4 == 0
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def packed(document: dict[str, Any], binary: bytes) -> bytes:
    """Return a file with both chunks."""
    text = json.dumps(document).encode()
    text, binary = text + b" " * (-len(text) % 4), binary + b"\0" * (-len(binary) % 4)
    total = 28 + len(text) + len(binary)
    head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON") + text
    return head + struct.pack("<I4s", len(binary), b"BIN\0") + binary
