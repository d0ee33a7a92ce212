"""Unpacks a zip of photos into a task's upload: names without folders, sizes as they come, not as they are stated."""

from __future__ import annotations

import errno
import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import cast

from splatpipe.pipeline.app.node.tasks.names import BadNameError, kind_of, plain_name
from splatpipe.pipeline.app.node.tasks.settings import MAX_FILES, MAX_TASK_BYTES
from splatpipe.pipeline.app.node.tasks.uploads import NameTakenError, UploadFolder

BLOCK_BYTES = 1 << 20
MAX_RATIO = 200  # bytes for each byte in the zip: photos are compressed already, and text by a factor of 50 at most
RATIO_FROM_BYTES = 10 << 20
MAX_READ_BYTES = 8 << 20  # at once: of 20,000 entries, the directory has 6 MB with names of 240 bytes
MAX_END_BYTES = (1 << 16) + 22  # the end record with the longest comment
MALFORMED = (struct.error, ValueError, OverflowError)  # fields that fit neither each other nor the file
BROKEN = "The zip cannot be read: it is broken, encrypted, or no zip."
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
UNIX = 3  # the system whose file modes an entry may have
LINK = 0o120000


class BadZipError(ValueError):
    """A zip that is not unpacked; the message is a sentence."""


def unpack(path: Path, upload: UploadFolder, limit: Callable[[str], int], reserve: Callable[[int], None]) -> list[str]:
    """Unpack the files that a run has a use for.

    Args:
        path: The zip.
        upload: Where they go.
        limit: The most bytes that a file of a name may have.
        reserve: Called before bytes are written; raises OSError if the disk has no room for them.

    Returns:
        Names of the files that were left out.

    Raises:
        BadZipError: if the zip is broken, encrypted, or has links, too many or too large files.
        OSError: if the disk is full.
    """
    left_out = []
    try:
        with _CarefulFile(path) as file, zipfile.ZipFile(cast("io.BufferedReader", file)) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            if len(entries) > MAX_FILES:
                raise BadZipError(f"The zip has {len(entries):,} files; {MAX_FILES:,} are allowed.")
            total, most = 0, min(MAX_TASK_BYTES, max(RATIO_FROM_BYTES, MAX_RATIO * path.stat().st_size))
            for entry in entries:
                name = _name_of(entry)
                if name is None or kind_of(name) == "other":
                    left_out.append(entry.filename[:60])
                    continue
                total += _unpack_one(archive, entry, name, upload, limit(name), reserve)
                if total > most:  # also of entries that share their bytes
                    raise BadZipError("The zip unpacks to more than a task may have, or than it can hold.")
    except BadZipError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, *MALFORMED) as error:
        raise BadZipError(BROKEN) from error
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        raise BadZipError(BROKEN) from error  # an entry that begins before the file does
    return left_out


class _CarefulFile(io.FileIO):
    """A file that is not read into memory as a whole: zipfile reads a directory of any size at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes.

        Raises:
            BadZipFile: if more are asked for than an honest zip has in one piece.
        """
        if size is None or size < 0:
            size = MAX_END_BYTES  # zipfile asks so for the end of the file
        if size > MAX_READ_BYTES:
            raise zipfile.BadZipFile("it has a directory that is too large")
        return super().read(size) or b""


def _name_of(entry: zipfile.ZipInfo) -> str | None:
    """The name under which an entry is kept; None for those that systems add, such as ``__MACOSX/._A.JPG``."""
    if "__MACOSX" in entry.filename or entry.filename.rpartition("/")[2].startswith("."):
        return None
    if entry.create_system == UNIX and (entry.external_attr >> 16) & 0o170000 == LINK:
        raise BadZipError("The zip has a link, which is not unpacked.")
    if entry.flag_bits & 1 or entry.compress_type not in METHODS:
        raise BadZipError("The zip is encrypted, or compressed by another method than deflate.")
    try:
        return plain_name(entry.filename)
    except BadNameError as error:
        raise BadZipError(str(error)) from error


def _unpack_one(
    archive: zipfile.ZipFile,
    entry: zipfile.ZipInfo,
    name: str,
    upload: UploadFolder,
    limit: int,
    reserve: Callable[[int], None],
) -> int:
    part = upload.begin(name)
    try:
        with archive.open(entry) as source:
            while block := source.read(BLOCK_BYTES):
                reserve(len(block))
                part.write(block)
                if part.size > limit or part.size > max(RATIO_FROM_BYTES, MAX_RATIO * entry.compress_size):
                    raise BadZipError(f'The file "{name}" in the zip unpacks to too much.')
    except BaseException:
        part.discard()
        raise
    try:
        part.finish()
    except NameTakenError as error:
        raise BadZipError(str(error)) from error
    return part.size
