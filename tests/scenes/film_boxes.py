"""An MP4 file of boxes, as a drone writes them, without pictures that can be decoded."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

FRAME = b"frame" * 4  # the bytes of one


def box(kind: bytes, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack(">I4s", 8 + len(content), kind) + content


def full(kind: bytes, *parts: bytes) -> bytes:
    """A box with a version and flags."""
    return box(kind, bytes(4), *parts)


def table(kind: bytes, rows: list[tuple[int, ...]], count: int | None = None) -> bytes:
    return full(
        kind, struct.pack(">I", len(rows) if count is None else count), *(struct.pack(f">{len(r)}I", *r) for r in rows)
    )


@dataclass
class FilmParts:
    """What is written; a test changes what it attacks."""

    frames: int = 6
    texts: tuple[str, ...] = ("[latitude: 47.8411] [longitude: 13.5126] [rel_alt: 30.1 abs_alt: 545.2]",) * 2
    keys: list[int] | None = field(default_factory=lambda: [1, 4])
    matrix: tuple[int, ...] = (1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    location: bytes = b"+47.8411+013.5126+530.000/"
    size: tuple[int, int] = (1920, 1080)
    replaced: dict[bytes, bytes] = field(default_factory=dict)  # boxes of the film's sample table

    def written(self) -> bytes:
        head = box(b"ftyp", b"isom", bytes(4))
        samples = [FRAME] * self.frames
        cues = [struct.pack(">H", len(text.encode())) + text.encode() for text in self.texts]
        media = box(b"mdat", *samples, *cues)
        start = len(head) + 8
        text_start = start + len(FRAME) * self.frames
        return (
            head
            + media
            + box(b"moov", self._header(), self._film(start), self._subtitles(text_start, cues), self._tags())
        )

    def _header(self) -> bytes:
        return full(b"mvhd", struct.pack(">IIII", 3_869_000_000, 0, 1000, 200 * self.frames), bytes(80))

    def _tags(self) -> bytes:
        return box(b"udta", box(b"\xa9xyz", struct.pack(">HH", len(self.location), 0x15C7), self.location))

    def _film(self, start: int) -> bytes:
        entry = box(b"avc1", bytes(24), struct.pack(">HH", *self.size), bytes(50))
        tables = {
            b"stsd": full(b"stsd", struct.pack(">I", 1), entry),
            b"stts": table(b"stts", [(self.frames, 200)]),
            b"stsc": table(b"stsc", [(1, self.frames, 1)]),
            b"stsz": full(b"stsz", struct.pack(">II", 0, self.frames), struct.pack(">I", len(FRAME)) * self.frames),
            b"stco": table(b"stco", [(start,)]),
        }
        if self.keys is not None:
            tables[b"stss"] = table(b"stss", [(key,) for key in self.keys])
        tables |= self.replaced
        header = full(b"tkhd", bytes(36), struct.pack(">9i", *self.matrix), bytes(8))
        return box(b"trak", header, self._media(b"vide", tables.values(), 200 * self.frames))

    def _subtitles(self, start: int, cues: list[bytes]) -> bytes:
        tables = (
            full(b"stsd", struct.pack(">I", 1), box(b"tx3g", bytes(38))),
            table(b"stts", [(len(cues), 1000)]),
            table(b"stsc", [(1, len(cues), 1)]),
            full(b"stsz", struct.pack(">II", 0, len(cues)), *(struct.pack(">I", len(cue)) for cue in cues)),
            table(b"stco", [(start,)]),
        )
        return box(b"trak", full(b"tkhd", bytes(80)), self._media(b"sbtl", tables, 1000 * len(cues)))

    def _media(self, handler: bytes, tables: object, length: int) -> bytes:
        assert not isinstance(tables, bytes)
        return box(
            b"mdia",
            full(b"mdhd", struct.pack(">IIIII", 0, 0, 1000, length, 0)),
            full(b"hdlr", bytes(4), handler, bytes(12)),
            box(b"minf", box(b"stbl", *tables)),  # type: ignore[misc]
        )
