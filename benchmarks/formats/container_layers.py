"""Unpack one layer of a container file, and repack it with valid lengths and checksums, so that damage reaches deep."""

from __future__ import annotations

import functools
import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
from PIL import Image

BOMB_BYTES = 600_000_000  # unpacked: more than a reader may take in memory
MAX_WEBP_PX = 16_384  # per side: 14 bits of a VP8L header, minus one
FIXED_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest that a ZIP can store
SPZ_4_HEADER, SPZ_4_ENTRY = struct.Struct("<IIIBBBBI12x"), struct.Struct("<QQ")

Layer = tuple[bytes, Callable[[bytes], bytes]]


def layer_of(data: bytes, generator: np.random.Generator) -> Layer | None:
    """Return the content of a random part of a container and a function that repacks it; None for other files.

    Args:
        data: A complete gzip stream, ZIP, binary glTF, WebP image or SPZ of version 4.
        generator: Chooses the part.
    """
    if data[:2] == b"\x1f\x8b":
        return gzip.decompress(data), lambda inner: gzip.compress(inner, 1, mtime=0)
    if data[:4] == b"PK\x03\x04":
        return _zip_layer(data, generator)
    if data[:4] == b"glTF":
        return _glb_layer(data, generator)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return _webp_layer(data)
    if data[:8] == b"NGSP\x04\0\0\0":
        return _spz_4_layer(data, generator)
    return None


def _zip_layer(data: bytes, generator: np.random.Generator) -> Layer:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = sorted(members)[generator.integers(len(members))]

    def packed(inner: bytes) -> bytes:
        found = io.BytesIO()
        with zipfile.ZipFile(found, "w", zipfile.ZIP_STORED) as archive:
            for name, content in members.items():
                archive.writestr(zipfile.ZipInfo(name, FIXED_TIME), inner if name == chosen else content)
        return found.getvalue()

    return members[chosen], packed


def _glb_layer(data: bytes, generator: np.random.Generator) -> Layer:
    chunks, at = [], 12
    while at < len(data):
        length, kind = struct.unpack_from("<II", data, at)
        chunks.append((kind, data[at + 8 : at + 8 + length]))
        at += 8 + length
    chosen = int(generator.integers(len(chunks)))

    def packed(inner: bytes) -> bytes:
        body = b""
        for index, (kind, content) in enumerate(chunks):
            content = inner if index == chosen else content
            content += (b" " if index == 0 else b"\0") * (-len(content) % 4)
            body += struct.pack("<II", len(content), kind) + content
        return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body

    return chunks[chosen][1], packed


def _webp_layer(data: bytes) -> Layer:
    with Image.open(io.BytesIO(data)) as picture:
        pixels = np.asarray(picture.convert("RGBA"))

    def packed(inner: bytes) -> bytes:
        width = max(1, min(len(inner) // 4, pixels.shape[1]))
        height = max(1, min(len(inner) // (4 * width), MAX_WEBP_PX - 1))
        raw = inner[: 4 * width * height].ljust(4 * width * height, b"\0")
        found = io.BytesIO()
        Image.frombytes("RGBA", (width, height), raw).save(
            found, "WEBP", lossless=True, exact=True, method=0, quality=0
        )
        return found.getvalue()

    return pixels.tobytes(), packed


def _spz_4_layer(data: bytes, generator: np.random.Generator) -> Layer | None:
    """Pick one of the streams of a nianticlabs/spz version 4 file: 32 bytes, a table of lengths, zstd streams."""
    import zstandard

    streams, table_at = data[15], struct.unpack_from("<I", data, 16)[0]
    entries = [SPZ_4_ENTRY.unpack_from(data, table_at + i * SPZ_4_ENTRY.size) for i in range(streams)]
    at, packed_streams = table_at + streams * SPZ_4_ENTRY.size, []
    head = data[:table_at]
    for packed_bytes, _ in entries:
        packed_streams.append(data[at : at + packed_bytes])
        at += packed_bytes
    chosen = int(generator.integers(streams))

    def packed(inner: bytes) -> bytes:
        changed = list(zip(packed_streams, (plain for _, plain in entries), strict=True))
        changed[chosen] = (zstandard.compress(inner, 1), len(inner))
        table = b"".join(SPZ_4_ENTRY.pack(len(stream), plain) for stream, plain in changed)
        return head + table + b"".join(stream for stream, _ in changed)

    inner = zstandard.decompress(packed_streams[chosen], entries[chosen][1])
    return inner, packed


def bomb_like(data: bytes, generator: np.random.Generator) -> bytes | None:
    """Return a small file of the same kind that unpacks to at least ``BOMB_BYTES`` or nests too deep; else None."""
    if data[:2] == b"\x1f\x8b":
        head = bytearray(gzip.decompress(data)[:16])
        head[8:12] = struct.pack("<I", BOMB_BYTES // 64)  # SPZ's count of points
        return _gzip_bomb(bytes(head))
    if data[:4] == b"PK\x03\x04":
        return _zip_bomb(data, generator)
    if data[:4] == b"RIFF":
        return blank_webp()
    if data[:1] in (b"{", b"["):
        return _json_bomb(data, generator)
    if data[:4] == b"ply\n":
        return _ply_bomb(data, generator)
    return None


@functools.cache
def deflated_zeros() -> tuple[bytes, int]:
    """Return ``BOMB_BYTES`` zeros, deflated, and their CRC-32."""
    packer, found, zeros, crc = zlib.compressobj(1, zlib.DEFLATED, -15), [], bytes(1 << 20), 0
    for start in range(0, BOMB_BYTES, len(zeros)):
        piece = zeros[: BOMB_BYTES - start]
        found.append(packer.compress(piece))
        crc = zlib.crc32(piece, crc)
    return b"".join(found) + packer.flush(), crc


def _gzip_bomb(head: bytes) -> bytes:
    """Return two gzip members, a header and zeros: to gzip readers they are one stream."""
    packed, crc = deflated_zeros()
    zeros = b"\x1f\x8b\x08\0\0\0\0\0\0\x03" + packed + struct.pack("<II", crc, BOMB_BYTES)
    return gzip.compress(head, mtime=0) + zeros


def _zip_bomb(data: bytes, generator: np.random.Generator) -> bytes:
    """Replace one member by zeros, by an image of a quarter of a billion pixels, or by deeply nested JSON."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = sorted(members)[generator.integers(len(members))]
    if generator.random() < 0.5:
        small = bomb_like(members[chosen], generator) or b""
        return _stored(members | {chosen: small})
    marker = b"\0" * 64
    found = _stored({name: content for name, content in members.items() if name != chosen} | {chosen: marker})
    packed, crc = deflated_zeros()
    name = chosen.encode()
    local = found.rindex(b"PK\x03\x04", 0, found.rindex(marker) + 1)
    central = found.rindex(b"PK\x01\x02")
    fields = struct.pack("<HHHIII", 8, 0, 33, crc, len(packed), BOMB_BYTES)
    head = found[local : local + 8] + fields + found[local + 26 : local + 30] + name
    directory = found[found.index(b"PK\x01\x02") : central]
    last = bytearray(found[central : found.rindex(b"PK\x05\x06")])
    last[10:28] = fields
    end = bytearray(found[found.rindex(b"PK\x05\x06") :])
    body = found[:local] + head + packed
    end[12:20] = struct.pack("<II", len(directory) + len(last), len(body))
    return body + directory + bytes(last) + bytes(end)


def _stored(members: dict[str, bytes]) -> bytes:
    found = io.BytesIO()
    with zipfile.ZipFile(found, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, FIXED_TIME), content)
    return found.getvalue()


def blank_webp(side_px: int = MAX_WEBP_PX) -> bytes:
    """Return a square lossless image of one colour in 40 bytes: a prefix code of one symbol needs zero bits per pixel.

    RFC 9649: 14 bits per side (minus one), alpha, 3 bits of version; no transform, no colour cache, no meta prefix
        codes; then five simple codes (1) of one symbol (0) stored in one bit (0): 0.
    """
    bits, count = 0, 0
    for value, width in (
        (side_px - 1, 14),
        (side_px - 1, 14),
        (1, 1),
        (0, 3),
        (0, 1),
        (0, 1),
        (0, 1),
        *[(0b0001, 4)] * 5,
    ):
        bits |= value << count
        count += width
    body = b"\x2f" + bits.to_bytes(-(-count // 8), "little") + b"\0\0"
    body += b"\0" * (len(body) % 2)
    return b"RIFF" + struct.pack("<I", 12 + len(body)) + b"WEBPVP8L" + struct.pack("<I", len(body)) + body


def _json_bomb(data: bytes, generator: np.random.Generator) -> bytes:
    """Return JSON that is nested too deep, a number of a million digits, or a list of ten million entries."""
    value = (b"[" * 200_000 + b"]" * 200_000, b"9" * 1_000_000, b"[" + b"0," * 10_000_000 + b"0]")[
        generator.integers(3)
    ]
    return b'{"version":2,"bomb":' + value + b"," + data.lstrip()[1:]


def _ply_bomb(data: bytes, generator: np.random.Generator) -> bytes:
    """Return a header with thousands of properties, or with absurdly large element counts."""
    many = b"".join(b"property float p%d\n" % i for i in range(3000))
    empty = b"element nothing 999999999999999\n"
    lists = b"element face 999999999999\nproperty list uchar int vertex_indices\n"
    end = data.index(b"end_header")
    return data[:end] + (many, empty, lists)[generator.integers(3)] + data[end:]
