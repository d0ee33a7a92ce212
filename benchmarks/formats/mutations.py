"""Damage to files, both accidental and malicious."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from container_layers import bomb_like, layer_of

ABSURD_TEXT = (b"0", b"-1", b"2147483648", b"9223372036854775808", b"nan", b"inf", b"1e308", b"1e400", b"0.5", b"")
ABSURD_WHOLE = (0, -1, 1, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
ABSURD_REAL = (0.0, -1.0, float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 3e38, 1e30, 89.0, 1e-45)
ABSURD_JSON: tuple[Any, ...] = (
    *(0, -1, 2**31, 2**63, 10**30, 1e308, float("nan"), float("inf"), 0.5, None, True, "", "x" * 5000),
    *([], {}, [[]], [None] * 3, ["../../etc/passwd"], "../up.webp", "/dev/zero", "\0", {"a": {"b": []}}),
)
HEADER_BYTES = 96  # location of counts and lengths
TAIL_BYTES = 96  # location of a ZIP's directory
DEEPER = 0.75  # probability of damaging a container's content rather than its bytes
BOMBS = 0.006  # share of all: unpacking one takes seconds
TEXT_BYTES = 4096  # where text headers are searched

Damage = Callable[[bytes, bytes, np.random.Generator], bytes]


def _flip_bits(data: bytes, _: bytes, generator: np.random.Generator) -> bytes:
    found = bytearray(data)
    for at in generator.integers(0, max(len(data), 1), int(generator.integers(1, 33))):
        if found:
            found[at] ^= 1 << int(generator.integers(8))
    return bytes(found)


def _cut(data: bytes, _: bytes, generator: np.random.Generator) -> bytes:
    short = generator.random() < 0.3
    return data[: int(generator.integers(0, (HEADER_BYTES if short else len(data)) + 1))]


def _extend(data: bytes, _: bytes, generator: np.random.Generator) -> bytes:
    count = int(generator.integers(1, 5000))
    return data + (generator.bytes(count), bytes(count), data[:count], data)[generator.integers(4)]


def _swap_blocks(data: bytes, _: bytes, generator: np.random.Generator) -> bytes:
    a, b, c, d = sorted(int(at) for at in generator.integers(0, len(data) + 1, 4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _splice(data: bytes, other: bytes, generator: np.random.Generator) -> bytes:
    at = generator.random()
    return data[: int(at * len(data))] + other[int(at * len(other)) :]


def _put_number(data: bytes, _: bytes, generator: np.random.Generator) -> bytes:
    """Write up to four absurd binary numbers, mostly into headers."""
    found = bytearray(data)
    for _number in range(int(generator.integers(1, 5))):
        value = _absurd_bytes(generator)
        place = generator.random()
        low, high = 0, max(len(found) - len(value), 0)
        if place < 0.5:
            high = min(high, HEADER_BYTES)
        elif place < 0.65:
            low = max(0, high - TAIL_BYTES)
        at = int(generator.integers(low, high + 1))
        if generator.random() < 0.7:
            at -= at % 4
        found[at : at + len(value)] = value
    return bytes(found)


def _absurd_bytes(generator: np.random.Generator) -> bytes:
    if generator.random() < 0.5:
        size = int(generator.choice([1, 2, 4, 8]))
        value = ABSURD_WHOLE[generator.integers(len(ABSURD_WHOLE))] % (1 << 8 * size)
        return value.to_bytes(size, "little")
    value_real = ABSURD_REAL[generator.integers(len(ABSURD_REAL))]
    with np.errstate(over="ignore"):
        return np.float32(value_real).tobytes() if generator.random() < 0.7 else struct.pack("<d", value_real)


def _put_text_number(data: bytes, _: bytes, generator: np.random.Generator) -> bytes:
    """Write absurd numbers into a text header, or into JSON as text."""
    places = list(re.finditer(rb"-?[0-9][0-9.eE+-]*", data[:TEXT_BYTES]))
    if not places:
        return _put_number(data, b"", generator)
    place = places[generator.integers(len(places))]
    return data[: place.start()] + ABSURD_TEXT[generator.integers(len(ABSURD_TEXT))] + data[place.end() :]


def _drop_or_double_line(data: bytes, _: bytes, generator: np.random.Generator) -> bytes:
    head, rest = data[:TEXT_BYTES], data[TEXT_BYTES:]
    lines = head.split(b"\n")
    at = int(generator.integers(len(lines)))
    change = [[], [lines[at]] * 2, [lines[int(generator.integers(len(lines)))]]][generator.integers(3)]
    return b"\n".join([*lines[:at], *change, *lines[at + 1 :]]) + rest


def _change_json(data: bytes, _: bytes, generator: np.random.Generator) -> bytes:
    """Make one to three nodes absurd, drop them, or duplicate them."""
    try:
        value = json.loads(data.rstrip(b"\0 "))
    except ValueError:
        return _flip_bits(data, b"", generator)
    for _change in range(int(generator.integers(1, 4))):
        places = list(_nodes(value))
        if not places:
            break
        holder, key = places[generator.integers(len(places))]
        how = generator.random()
        if how < 0.7:
            holder[key] = ABSURD_JSON[generator.integers(len(ABSURD_JSON))]
        elif how < 0.85:
            del holder[key]
        elif isinstance(holder, list):
            holder.extend([holder[key]] * int(generator.integers(1, 1000)))
        else:
            other, other_key = places[generator.integers(len(places))]
            holder[key] = json.loads(json.dumps(other[other_key]))
    return json.dumps(value).encode()


def _nodes(value: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    keys = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in keys:
        found.append((value, key))
        found += _nodes(inner)
    return found


BINARY: dict[str, Damage] = {
    "bits flipped": _flip_bits,
    "cut off": _cut,
    "longer": _extend,
    "blocks swapped": _swap_blocks,
    "absurd numbers": _put_number,
    "spliced": _splice,
}
TEXT: dict[str, Damage] = {"absurd text": _put_text_number, "lines": _drop_or_double_line} | BINARY
JSON: dict[str, Damage] = {"json changed": _change_json, "absurd text": _put_text_number, "cut off": _cut}


def mutated(data: bytes, other: bytes, generator: np.random.Generator) -> tuple[str, bytes]:
    """Return a damaged copy of a file, and a description of the damage.

    Args:
        data: The complete file.
        other: Another file, for splices.
        generator: Decides everything: the same state gives the same damage.
    """
    if generator.random() < BOMBS:
        bomb = bomb_like(data, generator)
        if bomb is not None:
            return "bomb", bomb
    layer = layer_of(data, generator) if generator.random() < DEEPER else None
    if layer is not None:
        inner, packed = layer
        other_layer = layer_of(other, generator)
        what, changed = mutated(inner, other if other_layer is None else other_layer[0], generator)
        return what if what == "bomb" or what.endswith("inside") else f"{what} inside", packed(changed)
    kinds = JSON if data[:1] in (b"{", b"[") else TEXT if data[:4] == b"ply\n" else BINARY
    what = sorted(kinds)[generator.integers(len(kinds))]
    return what, kinds[what](data, other, generator)
