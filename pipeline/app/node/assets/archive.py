"""Writes `all.zip`: entry by entry, in constant memory, the same bytes for the same contents."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.app.node.assets.layout import is_safe, is_stored
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.engine.files.small_file import open_regular

TIME = (1980, 1, 1, 0, 0, 0)  # the first that an archive can state
UNIX = 3
MODE = 0o100644 << 16  # a regular file
LEVEL = 6
COPY_BYTES = 1 << 20
# From this size on, an entry gets fields of 64 bits; deflated, it may come out larger than it went in.
ZIP64_BYTES = (1 << 32) - (1 << 24)


@dataclass(frozen=True)
class Entry:
    """A file of an archive.

    Attributes:
        name: Its path in the archive.
        content: The file that has its content, or the content itself.
    """

    name: str
    content: Path | bytes

    @property
    def size(self) -> int:
        """Its bytes before compression."""
        return len(self.content) if isinstance(self.content, bytes) else self.content.stat().st_size


def write_archive(path: Path, entries: Sequence[Entry]) -> None:
    """Write an archive (not atomically).

    Args:
        path: Output file.
        entries: Its entries; they are sorted by name.

    Raises:
        OSError: if a file cannot be read, or the disk is full.
        ValueError: if a name leads out of the archive, or two are equal.
    """
    ordered = sorted(entries, key=lambda entry: entry.name)
    names = {entry.name for entry in ordered}
    unsafe = [name for name in names if not is_safe(name)]
    if unsafe or len(names) < len(ordered):
        raise ValueError(f"{unsafe[0]!a} is no path" if unsafe else "two entries have one name")
    with new_file(path) as file, zipfile.ZipFile(file, "w", compresslevel=LEVEL) as archive:
        for entry in ordered:
            _write(archive, entry)


def _write(archive: zipfile.ZipFile, entry: Entry) -> None:
    info = zipfile.ZipInfo(entry.name, TIME)
    info.create_system, info.external_attr = UNIX, MODE
    info.compress_type = zipfile.ZIP_STORED if is_stored(entry.name) else zipfile.ZIP_DEFLATED
    with archive.open(info, "w", force_zip64=entry.size >= ZIP64_BYTES) as target:
        if isinstance(entry.content, bytes):
            target.write(entry.content)
            return
        with open_regular(entry.content) as source:
            shutil.copyfileobj(source, target, COPY_BYTES)
