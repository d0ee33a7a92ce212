"""Files that a client uploads: written under a hidden name, and renamed once they are whole.

A connection may be cut at any byte, and clients then send a file again, sometimes while the first attempt is still
being received. Whichever is whole first gets the name; the same bytes again are a success, and others are refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.files.durable import sync_folder
from splatpipe.pipeline.engine.files.output_file import appended_file, new_file, token
from splatpipe.pipeline.engine.files.small_file import read_small

PART = ".part"
JOURNAL = ".digests"  # digests of whole files, one JSON object per line: at the commit, nothing is read again
MAX_JOURNAL_BYTES = 64 << 20
READ_BYTES = 1 << 20


@dataclass(frozen=True)
class FileFacts:
    """Size in bytes and SHA-256 of a file."""

    size: int
    sha256: str


class NameTakenError(ValueError):
    """A file of this name and with other content is there already; the message is a sentence."""


class ClosedUploadError(ValueError):
    """The upload is complete; the message is a sentence."""


class UploadFolder:
    """The folder of a task's files; safe to use from several threads.

    Args:
        path: The folder; part files of an earlier process are removed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._closed = False
        for part in path.glob(f".*{PART}"):
            part.unlink(missing_ok=True)
        self._facts = self._read_journal()

    def sizes(self) -> dict[str, int]:
        """Sizes of the whole files by name, in order."""
        with self._lock:
            return dict(sorted(self._present().items()))

    def names(self) -> list[str]:
        """Names of the whole files, in order."""
        return list(self.sizes())

    def count(self) -> int:
        """Number of files whose digests are known."""
        return len(self._facts)

    def size(self) -> int:
        """Bytes of these files."""
        return sum(each.size for each in tuple(self._facts.values()))

    def close(self) -> None:
        """Take no further files: only those that are there already, a second time."""
        with self._lock:
            self._closed = True

    def reopen(self) -> None:
        """Take files again."""
        with self._lock:
            self._closed = False

    def begin(self, name: str) -> PartFile:
        """Begin to receive a file.

        Args:
            name: Its plain name.

        Raises:
            OSError: if it cannot be created.
        """
        return PartFile(self, name, self.path / f".{token()}{PART}")

    def digests(self) -> dict[str, FileFacts]:
        """Size and digest of every whole file by its name; those whose digest was lost in a crash are read.

        Raises:
            OSError: if a file cannot be read.
        """
        with self._lock:
            present = self._present()
            missing = [name for name in present if self._facts.get(name, FileFacts(-1, "")).size != present[name]]
        for name in missing:
            facts = file_facts(self.path / name)
            with self._lock:
                self._facts[name] = facts
        with self._lock:
            return {name: self._facts[name] for name in sorted(present)}

    def forget(self, name: str) -> None:
        """Take note that a file was changed where it lies: its digest is read again when it is needed."""
        with self._lock:
            self._facts[name] = FileFacts(-1, "")
            self._note(name, self._facts[name])

    def replace_by(self, name: str, same: Path) -> None:
        """Replace a file by a hard link to another with the same bytes, so that they are stored once.

        Raises:
            OSError: if the file system has no links.
        """
        aside = self.path / f".{token()}{PART}"
        os.link(same, aside)
        aside.replace(self.path / name)

    def settle(self, part: PartFile, facts: FileFacts) -> None:
        """Give a whole file its name.

        Raises:
            NameTakenError: if there is another with other content.
            ClosedUploadError: if no files are taken any more.
            OSError: if it cannot be renamed.
        """
        with self._lock:
            target = self.path / part.name
            if target.exists():
                there = self._facts.get(part.name) or file_facts(target)
                self._facts[part.name] = there
                part.discard()
                if there != facts:
                    raise NameTakenError(
                        f"{part.name} was uploaded already, with other content; file names are kept, so each may occur "
                        "only once: rename one of them."
                    )
                return
            if self._closed:
                part.discard()
                raise ClosedUploadError("The upload of this task is complete: no further file is taken.")
            part.path.rename(target)
            sync_folder(self.path)
            self._facts[part.name] = facts
            self._note(part.name, facts)

    def _present(self) -> dict[str, int]:
        with os.scandir(self.path) as entries:
            shown = [each for each in entries if not each.name.startswith(".") and each.is_file(follow_symlinks=False)]
            return {each.name: each.stat().st_size for each in shown}

    def _note(self, name: str, facts: FileFacts) -> None:
        with suppress(OSError), appended_file(self.path / JOURNAL) as file:  # without it, the file is read again
            file.write(f"{json.dumps([name, facts.size, facts.sha256])}\n".encode())

    def _read_journal(self) -> dict[str, FileFacts]:
        found: dict[str, FileFacts] = {}
        try:
            lines = read_small(self.path / JOURNAL, MAX_JOURNAL_BYTES).splitlines()
        except OSError:
            return found
        for line in lines:
            with suppress(ValueError, TypeError):
                name, size, digest = json.loads(line)
                found[str(name)] = FileFacts(int(size), str(digest))
        return found


class PartFile:
    """A file while it is received. Exactly one of ``finish`` and ``discard`` ends it.

    Args:
        folder: Where it belongs.
        name: Its name once it is whole.
        path: Its path until then.
    """

    def __init__(self, folder: UploadFolder, name: str, path: Path) -> None:
        self.name, self.path = name, path
        self._folder, self._digest, self.size = folder, hashlib.sha256(), 0
        self._file: Any = new_file(path)

    def write(self, data: bytes | bytearray) -> None:
        """Append bytes.

        Raises:
            OSError: if the disk is full.
        """
        self._file.write(data)
        self._digest.update(data)
        self.size += len(data)

    def finish(self) -> FileFacts:
        """Flush the whole file to disk and give it its name.

        Raises:
            NameTakenError: if there is another of this name with other content.
            OSError: if it cannot be written or renamed.
        """
        try:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            facts = FileFacts(self.size, self._digest.hexdigest())
            self._folder.settle(self, facts)
        except BaseException:
            self.discard()
            raise
        return facts

    def discard(self) -> None:
        """Remove what was received."""
        with suppress(OSError, ValueError):
            self._file.close()
        self.path.unlink(missing_ok=True)


def file_facts(path: Path) -> FileFacts:
    """Size and digest of a file.

    Raises:
        OSError: if it cannot be read.
    """
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while block := file.read(READ_BYTES):
            digest.update(block)
            size += len(block)
    return FileFacts(size, digest.hexdigest())
