"""Unpacks a zip of photos into a task's upload: names without folders, sizes as they come, not as they are stated."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

from splatpipe.pipeline.app.node.tasks.names import BadNameError, kind_of, plain_name
from splatpipe.pipeline.app.node.tasks.settings import MAX_FILES, MAX_TASK_BYTES
from splatpipe.pipeline.app.node.tasks.uploads import NameTakenError, UploadFolder

BLOCK_BYTES = 1 << 20
MAX_RATIO = 200  # bytes for each byte in the zip: photos are compressed already, and text by a factor of 50 at most
RATIO_FROM_BYTES = 10 << 20
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
        with zipfile.ZipFile(path) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            if len(entries) > MAX_FILES:
                raise BadZipError(f"The zip has {len(entries):,} files; {MAX_FILES:,} are allowed.")
            total = 0
            for entry in entries:
                name = _name_of(entry)
                if name is None or kind_of(name) == "other":
                    left_out.append(entry.filename[:60])
                    continue
                total += _unpack_one(archive, entry, name, upload, limit(name), reserve)
                if total > MAX_TASK_BYTES:
                    raise BadZipError("The zip unpacks to more than a task may have.")
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, UnicodeError) as error:
        raise BadZipError("The zip cannot be read: it is broken, encrypted, or no zip.") from error
    return left_out


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
