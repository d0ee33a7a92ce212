"""Content digests of a file, of a folder and of the user's photos (hashed once, then cached)."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.product_folders import program_of
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.engine.machine import pseudo_devices
from splatpipe.pipeline.engine.stage import JSON

BLOCK_BYTES = 1 << 20
UNREADABLE = "unreadable"  # the digest of a file that cannot be read; ingest will exclude it and give the reason
CACHED_ATTRIBUTES = 4  # file attributes by which a cached digest is recognised as current
MAX_SOURCE_FILES = 1_000_000  # a folder with more is somebody's home folder, not a capture


def canonical(value: JSON) -> bytes:
    """JSON with sorted keys and no spaces: the same bytes for the same value."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def digest(value: JSON) -> str:
    """sha256 (hex) of a JSON value's canonical form."""
    return hashlib.sha256(canonical(value)).hexdigest()


def file_digest(path: Path) -> str:
    """sha256 (hex) of a file's bytes."""
    sha = hashlib.sha256()
    with open_regular(path) as file:
        while block := file.read(BLOCK_BYTES):
            sha.update(block)
    return sha.hexdigest()


def walk_files(root: Path) -> Iterator[Path]:
    """Yield every regular file below ``root`` in sorted order.

    Hidden names, symlinked folders, folders of a program's products and the kernel's pseudo files are skipped.
    """
    pseudo = pseudo_devices()
    for folder, folders, files in os.walk(root):
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") and not program_of(Path(folder) / name)
        )
        for name in sorted(files):
            path = Path(folder) / name
            if not name.startswith(".") and is_real_file(path, pseudo):
                yield path


def is_real_file(path: Path, pseudo: Container[int]) -> bool:
    """Whether a path, which may be a link, leads to a regular file on a disk.

    Args:
        path: The path.
        pseudo: ``pseudo_devices()``.
    """
    try:
        status = path.stat()
    except OSError:
        return False
    return stat.S_ISREG(status.st_mode) and status.st_dev not in pseudo


@dataclass(frozen=True)
class FileEntry:
    """A file of an artifact: POSIX path relative to the artifact, size in bytes, sha256."""

    path: str
    size: int
    sha256: str


def tree_entries(path: Path, relative_to: Path) -> list[FileEntry]:
    """Entries of a file, or of every file below a folder, sorted by path; dangling links are skipped."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return [
        FileEntry(file.relative_to(relative_to).as_posix(), file.stat().st_size, file_digest(file)) for file in files
    ]


def part_digest(entries: Iterable[FileEntry], root: str) -> str:
    """Digest of a part, independent of its location: equal content has equal digests.

    Args:
        entries: Its files, paths relative to the artifact.
        root: The part's own path relative to the artifact.
    """
    return digest(sorted([entry.path.removeprefix(root).lstrip("/"), entry.sha256] for entry in entries))


def _digest_or_unreadable(path: Path) -> str:
    try:
        return file_digest(path)
    except OSError:
        return UNREADABLE


class HashTable:
    """A cache of files' sha256 by path, size, times and inode, so that gigabytes are read only once.

    The times include the inode's ctime, which no program can set, unlike the mtime.

    Args:
        path: The table's file (JSON); a corrupt one is replaced.
        remember: Save new digests; only the holder of the lock may.
    """

    def __init__(self, path: Path, *, remember: bool) -> None:
        self._path = path
        self._remember = remember
        self._known: dict[str, list[JSON]] = {}
        try:
            table = read_json(path)
            self._known = {str(key): list(value) for key, value in table.items() if len(value) == CACHED_ATTRIBUTES + 1}
        except (OSError, ValueError, AttributeError, TypeError):
            pass  # a missing or corrupt table only costs reading the photos again

    def digest_of(
        self, files: Mapping[str, Path], threads: int, progress: Callable[[int, int], None] | None = None
    ) -> str:
        """Digest of named files.

        Args:
            files: Name to path; the names are part of the digest, the paths are not.
            threads: Number of files read at once.
            progress: Called with (done, total) files that had to be read.
        """
        wanted: dict[str, list[JSON]] = {}
        unread: list[str] = []
        for name, path in files.items():
            try:
                status = path.stat()
                wanted[name] = [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]
            except OSError:
                wanted[name] = [-1] * CACHED_ATTRIBUTES
            known = self._known.get(str(path))
            if known is None or known[:CACHED_ATTRIBUTES] != wanted[name]:
                unread.append(name)
        with ThreadPoolExecutor(max(1, threads)) as pool:
            for done, (name, sha) in enumerate(
                zip(unread, pool.map(lambda name: _digest_or_unreadable(files[name]), unread), strict=True), start=1
            ):
                self._known[str(files[name])] = [*wanted[name], sha]
                if progress:
                    progress(done, len(unread))
        found = digest(sorted([name, self._known[str(path)][CACHED_ATTRIBUTES]] for name, path in files.items()))
        if unread and self._remember:
            self._known = {path: known for path, known in self._known.items() if known[CACHED_ATTRIBUTES] != UNREADABLE}
            self._save()
        return found

    def _save(self) -> None:
        write_durably(self._path, json.dumps(self._known))
