"""Single files of `all.zip`, and archives of single folders, as ranges of it: nothing is copied or unpacked.

Single files are stored in `all.zip` without compression. An archive of a folder is put together of new headers and the
compressed data as it is (PKWARE's APPNOTE 6.3.10, sections 4.3 to 4.5). Light to import.
"""

from __future__ import annotations

import os
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.app.node.assets.layout import ALL, FOLDERS, MEDIA_TYPES, SINGLE
from splatpipe.pipeline.app.serving.files import FileNotServedError, OpenFile, open_inside

MOST_16, MOST_32 = (1 << 16) - 1, (1 << 32) - 1  # in a field, they mean that the number is in one of 64 bits
LONG_FROM = MOST_32  # the least number that needs a field of 64 bits
LOCAL = struct.Struct("<4s5H3L2H")
CENTRAL = struct.Struct("<4s6H3L5H2L")
END = struct.Struct("<4s4H2LH")
END_64 = struct.Struct("<4sQ2H2L4Q")
LOCATOR_64 = struct.Struct("<4sLQL")
ZIP64_EXTRA = 1
VERSION_64 = 45  # 4.5: fields of 64 bits
UNIX = 3
KEPT_FLAGS = 1 << 11  # the name is UTF-8; the other bits would speak of fields that are written anew

Segment = bytes | tuple[int, int]
"""Bytes, or the offset and length of a range of `all.zip`."""


@dataclass(frozen=True)
class OpenAsset(OpenFile):
    """A part of an open `all.zip`, to be sent like a file.

    Attributes:
        segments: What it consists of, in order.
    """

    segments: tuple[Segment, ...]

    def read(self, length: int, at: int) -> bytes:
        """Bytes from an offset on, at most so many; none at the end only, or where `all.zip` ends too early."""
        for segment in self.segments:
            size = _length(segment)
            if at < size:
                if isinstance(segment, bytes):
                    return segment[at : at + length]
                return os.pread(self.descriptor, min(length, size - at), segment[0] + at)
            at -= size
        return b""


def _length(segment: Segment) -> int:
    return len(segment) if isinstance(segment, bytes) else segment[1]


def is_asset(name: str) -> bool:
    """Whether there can be a download of this name."""
    return name == ALL or name in SINGLE or name in FOLDERS


def media_type(name: str) -> str:
    """The media type of a download."""
    return MEDIA_TYPES.get(f".{name.rpartition('.')[2]}", "application/octet-stream")


def open_asset(folder: Path, name: str) -> OpenFile:
    """Open a download of a finished task; whoever sends it closes its descriptor.

    Args:
        folder: The folder with `all.zip`.
        name: ``all.zip``, or a name of ``SINGLE`` or ``FOLDERS``.

    Raises:
        FileNotServedError: if there is no such download.
    """
    if not is_asset(name):
        raise FileNotServedError
    whole = open_inside(folder, ALL)
    if name == ALL:
        return whole
    try:
        with _directory(whole) as archive:
            segments = _segments(archive, name)
    except (zipfile.BadZipFile, OSError) as error:
        os.close(whole.descriptor)
        raise FileNotServedError from error
    if segments is None:
        os.close(whole.descriptor)
        raise FileNotServedError
    tag = f'{whole.tag[:-1]}-{name}"'
    return OpenAsset(whole.descriptor, sum(map(_length, segments)), tag, segments)


def list_assets(folder: Path) -> dict[str, int]:
    """The names of all downloads of a finished task, and their bytes.

    Raises:
        FileNotServedError: if there is no `all.zip`.
        zipfile.BadZipFile: if it is broken.
    """
    whole = open_inside(folder, ALL)
    try:
        with _directory(whole) as archive:
            found = {name: _segments(archive, name) for name in (*SINGLE, *FOLDERS)}
    finally:
        os.close(whole.descriptor)
    sizes = {name: sum(map(_length, segments)) for name, segments in found.items() if segments is not None}
    return {ALL: whole.size, **sizes}


def _directory(whole: OpenFile) -> zipfile.ZipFile:
    """The archive's directory; closing it leaves the descriptor open."""
    return zipfile.ZipFile(os.fdopen(whole.descriptor, "rb", closefd=False))


def _segments(archive: zipfile.ZipFile, name: str) -> tuple[Segment, ...] | None:
    """What a download consists of; None if it was not made."""
    if name in SINGLE:
        info = archive.NameToInfo.get(SINGLE[name])
        if info is None or info.compress_type != zipfile.ZIP_STORED:
            return None
        return ((_data_offset(archive, info), info.file_size),)
    below = [info for info in archive.infolist() if info.filename.startswith(FOLDERS[name])]
    return _folder(archive, below, len(FOLDERS[name])) if below else None


def _data_offset(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> int:
    """Where an entry's data begins: behind its local header, whose extra fields are not those of the directory."""
    assert archive.fp is not None
    archive.fp.seek(info.header_offset)
    *_, name, extra = LOCAL.unpack(archive.fp.read(LOCAL.size))
    return info.header_offset + LOCAL.size + int(name) + int(extra)


def _folder(archive: zipfile.ZipFile, infos: list[zipfile.ZipInfo], cut: int) -> tuple[Segment, ...]:
    """An archive of entries, whose names lose their first letters."""
    segments: list[Segment] = []
    directory, at = b"", 0
    for info in infos:
        name = info.filename[cut:].encode()
        header = _local_header(info, name)
        directory += _central_header(info, name, at)
        segments += [header, (_data_offset(archive, info), info.compress_size)]
        at += len(header) + info.compress_size
    return (*segments, directory + _end(len(infos), len(directory), at))


def _local_header(info: zipfile.ZipInfo, name: bytes) -> bytes:
    large = max(info.file_size, info.compress_size) >= LONG_FROM
    extra = struct.pack("<2H2Q", ZIP64_EXTRA, 16, info.file_size, info.compress_size) if large else b""
    sizes = (MOST_32, MOST_32) if large else (info.compress_size, info.file_size)
    head = (VERSION_64, info.flag_bits & KEPT_FLAGS, info.compress_type, *_moment(info), info.CRC, *sizes)
    return LOCAL.pack(b"PK\3\4", *head, len(name), len(extra)) + name + extra


def _central_header(info: zipfile.ZipInfo, name: bytes, at: int) -> bytes:
    values = (info.file_size, info.compress_size, at)
    large = [value for value in values if value >= LONG_FROM]
    extra = struct.pack(f"<2H{len(large)}Q", ZIP64_EXTRA, 8 * len(large), *large) if large else b""
    size, packed, offset = map(_short, values)
    head = (info.flag_bits & KEPT_FLAGS, info.compress_type, *_moment(info), info.CRC, packed, size)
    versions = (VERSION_64 | UNIX << 8, VERSION_64)
    tail = (len(name), len(extra), 0, 0, 0, info.external_attr, offset)
    return CENTRAL.pack(b"PK\1\2", *versions, *head, *tail) + name + extra


def _moment(info: zipfile.ZipInfo) -> tuple[int, int]:
    """Time and date in the format of MS-DOS."""
    year, month, day, hour, minute, second = info.date_time
    return hour << 11 | minute << 5 | second // 2, (year - 1980) << 9 | month << 5 | day


def _end(count: int, size: int, at: int) -> bytes:
    """The records behind a directory of ``size`` bytes at ``at``."""
    end = END.pack(b"PK\5\6", 0, 0, *[min(count, MOST_16)] * 2, _short(size), _short(at), 0)
    if count < MOST_16 and max(size, at) < LONG_FROM:
        return end
    record = END_64.pack(b"PK\6\6", END_64.size - 12, VERSION_64, VERSION_64, 0, 0, count, count, size, at)
    return record + LOCATOR_64.pack(b"PK\6\7", 0, at + size, 1) + end


def _short(value: int) -> int:
    return value if value < LONG_FROM else MOST_32
