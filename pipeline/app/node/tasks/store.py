"""The tasks of a node: one folder and one atomic record each, all of them in memory.

    FOLDER/tasks/UUID/task.json    the record
    FOLDER/tasks/UUID/upload/NAME  what was uploaded, under its own name once it is whole
    FOLDER/trash/                  what is being removed

Polls read memory only. A change is written before it is answered; where that fails because the disk is full, changes
that nobody may lose are refused, and others are written later.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.node.tasks.record import Task
from splatpipe.pipeline.app.node.tasks.uploads import UploadFolder
from splatpipe.pipeline.engine.files.durable import remove_unfinished, sync_folder, write_durably
from splatpipe.pipeline.engine.files.json_file import json_text, read_json
from splatpipe.pipeline.engine.files.output_file import own_folder, token

RECORD_FILE = "task.json"
UPLOAD_FOLDER = "upload"
MAX_RECORD_BYTES = 4 << 20  # a boundary of 1 MB is the largest part of one


class UnknownTaskError(KeyError):
    """There is no such task."""


class TaskStore:
    """Reads, changes and removes tasks; safe to use from several threads.

    Args:
        folder: The node's folder.
        tell: Receives lines about records that cannot be read.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None] = lambda _line: None) -> None:
        self.folder = folder
        self._tasks_folder, self._trash = own_folder(folder, "tasks"), own_folder(folder, "trash")
        self._lock = threading.RLock()
        self._tasks: dict[str, Task] = {}
        self._uploads: dict[str, UploadFolder] = {}
        self._unwritten: set[str] = set()
        for path in sorted(self._tasks_folder.iterdir()):
            self._load(path, tell)

    def _load(self, path: Path, tell: Callable[[str], None]) -> None:
        with suppress(OSError):
            remove_unfinished(path)
        try:
            task = Task.from_json(read_json(path / RECORD_FILE, MAX_RECORD_BYTES))
        except FileNotFoundError:  # it was never answered
            self._discard(path)
        except (OSError, ValueError) as error:
            tell(f"{path / RECORD_FILE} cannot be read, so this task is left out: {error}")
        else:
            self._tasks[path.name] = replace(task, uuid=path.name)

    def get(self, uuid: str) -> Task:
        """A task.

        Raises:
            UnknownTaskError: if there is none.
        """
        try:
            return self._tasks[uuid]
        except KeyError as error:
            raise UnknownTaskError(uuid) from error

    def all(self) -> list[Task]:
        """All tasks, the earliest first."""
        return sorted(self._tasks.values(), key=lambda task: (task.created_ms, task.uuid))

    def create(self, task: Task) -> bool:
        """Add a task; returns whether its UUID was free.

        Raises:
            OSError: if the disk is full or not writable.
        """
        with self._lock:
            if task.uuid in self._tasks:
                return False
            folder = own_folder(self.folder, "tasks", task.uuid)
            try:
                (folder / UPLOAD_FOLDER).mkdir(exist_ok=True)
                write_durably(folder / RECORD_FILE, json_text(task.as_json()))
                sync_folder(self._tasks_folder)
            except BaseException:
                self._discard(folder)
                raise
            self._tasks[task.uuid] = task
            return True

    def change(self, uuid: str, *, later: bool = False, **values: Any) -> Task:
        """Change fields of a task and write its record.

        Args:
            uuid: The task.
            later: If the disk is full, change it in memory and write it later.
            values: The fields.

        Raises:
            UnknownTaskError: if there is none.
            OSError: if the record cannot be written; the task is as before.
        """
        with self._lock:
            return self.replace(replace(self.get(uuid), **values), later=later)

    def replace(self, task: Task, *, later: bool = False) -> Task:
        """Replace a task and write its record; as ``change``."""
        with self._lock:
            self.get(task.uuid)
            try:
                self._write(task)
            except OSError:
                if not later:
                    raise
                self._unwritten.add(task.uuid)
            self._tasks[task.uuid] = task
            return task

    def write_late(self) -> None:
        """Write the records that could not be written, as far as the disk allows."""
        with self._lock:
            for uuid in tuple(self._unwritten):
                task = self._tasks.get(uuid)
                with suppress(OSError):
                    if task is not None:
                        self._write(task)
                    self._unwritten.discard(uuid)

    def _write(self, task: Task) -> None:
        write_durably(self.path(task.uuid) / RECORD_FILE, json_text(task.as_json()))
        self._unwritten.discard(task.uuid)

    def remove(self, uuid: str) -> None:
        """Remove a task; its files are deleted by ``empty_trash``.

        Raises:
            UnknownTaskError: if there is none.
            OSError: if its folder cannot be moved.
        """
        with self._lock:
            self.get(uuid)
            self.path(uuid).rename(self._trash / f"{uuid}.{token()}")
            del self._tasks[uuid]
            self._uploads.pop(uuid, None)
            self._unwritten.discard(uuid)

    def note(self, uuid: str, line: str, most: int) -> None:
        """Add a line to the notes of a task, once; no more than ``most``.

        Raises:
            UnknownTaskError: if there is none.
        """
        with self._lock:
            notes = self.get(uuid).notes
            if line not in notes and len(notes) < most:
                self.change(uuid, later=True, notes=(*notes, line))

    def keep_open(self, uuid: str) -> None:
        """Note that a client works on a task, in memory only."""
        with self._lock:
            if uuid in self._tasks:
                self._tasks[uuid] = replace(self._tasks[uuid], touched_ms=now_ms())

    def uploads(self, uuid: str) -> UploadFolder:
        """The files that were uploaded to a task.

        Raises:
            UnknownTaskError: if there is none.
        """
        with self._lock:
            self.get(uuid)
            if uuid not in self._uploads:
                self._uploads[uuid] = UploadFolder(self.path(uuid) / UPLOAD_FOLDER)
                if self.get(uuid).state not in ("uploading", "fetching"):
                    self._uploads[uuid].close()
            return self._uploads[uuid]

    def path(self, uuid: str) -> Path:
        """A task's folder."""
        return self._tasks_folder / uuid

    def _discard(self, folder: Path) -> None:
        with suppress(OSError):
            folder.rename(self._trash / f"{folder.name}.{token()}")

    def discard(self, folder: Path) -> None:
        """Move a folder of the node to the trash.

        Raises:
            OSError: if it cannot be moved.
        """
        folder.rename(self._trash / f"{folder.name}.{token()}")

    def empty_trash(self) -> None:
        """Delete what has been removed; takes as long as that takes."""
        for path in self._trash.iterdir():
            shutil.rmtree(path, ignore_errors=True)


def now_ms() -> int:
    """Milliseconds since the epoch."""
    return time.time_ns() // 1_000_000
