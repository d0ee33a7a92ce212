"""Checks of uploads before their runs start: one at a time, each in a process of its own, results kept beside them."""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.node.page.check_process import MODULE, SCRATCH
from splatpipe.pipeline.app.node.tasks.child import Child
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import json_text, parse_json, read_json
from splatpipe.pipeline.engine.files.small_file import read_end

RESULT, PAGE, ANSWER, LOG = "check.json", "check.html", "progress.txt", "log.txt"
MAX_RESULT_BYTES = 1 << 20
TAIL_BYTES = 1 << 20  # the last line of the answer is the result
TIME_LIMIT_S = 3600.0  # of one check; thousands of photos take minutes


@dataclass(frozen=True)
class Upload:
    """What a check reads.

    Attributes:
        folder: The folder of the files.
        sizes: Size of each file by name; a check of other files no longer counts.
        options: Tables over the presets' options.
    """

    folder: Path
    sizes: Mapping[str, int]
    options: Mapping[str, Any]

    @property
    def key(self) -> str:
        """Digest of what the check depends on."""
        what = {"sizes": dict(self.sizes), "options": self.options}
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode("utf-8", "surrogateescape")).hexdigest()


class Checks:
    """The checks of a node. One thread calls ``advance`` regularly: a process dies with the thread that made it.

    Args:
        threads: Threads of a check.
    """

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._lock = threading.Lock()
        self._waiting: deque[tuple[str, Upload, Path]] = deque()
        self._running: tuple[str, Upload, Path, Child] | None = None

    def ask(self, uuid: str, upload: Upload, folder: Path) -> None:
        """Ask for a check, unless there is one of the same files already.

        Args:
            uuid: The task.
            upload: What to check.
            folder: Where its results are kept.
        """
        if self.result(upload, folder) is not None:
            return
        with self._lock:
            known = {each[0]: each[1].key for each in self._waiting}
            known |= {} if self._running is None else {self._running[0]: self._running[1].key}
            if known.get(uuid) == upload.key:
                return
            self._waiting = deque(each for each in self._waiting if each[0] != uuid)
            self._waiting.append((uuid, upload, folder))

    def state(self, uuid: str, upload: Upload, folder: Path) -> dict[str, Any]:
        """How far the check of a task is: ``state`` and, of a running one, ``done``, ``total`` and ``what``."""
        with self._lock:
            if self._running is not None and self._running[0] == uuid and self._running[1].key == upload.key:
                return {"state": "running", **_last_line(folder)}
            if any(each[0] == uuid for each in self._waiting):
                return {"state": "waiting"}
        return self.result(upload, folder) or {"state": "none"}

    def result(self, upload: Upload, folder: Path) -> dict[str, Any] | None:
        """The result of a check of exactly these files; None if there is none."""
        with suppress(OSError, ValueError):
            found = read_json(folder / RESULT, MAX_RESULT_BYTES)
            if isinstance(found, dict) and found.get("key") == upload.key:
                return found
        return None

    def advance(self) -> None:
        """Take note of a check that has ended, and start the next."""
        with self._lock:
            if self._running is not None:
                uuid, upload, folder, child = self._running
                code = child.poll()
                if code is None and time.monotonic() - child.began_s < TIME_LIMIT_S and folder.parent.is_dir():
                    return
                self._end_running()
                with suppress(OSError):  # the disk is full, or the task was removed: the check counts as not made
                    write_durably(folder / RESULT, json_text({"key": upload.key, **_outcome(folder)}))
            while self._waiting and self._running is None:
                uuid, upload, folder = self._waiting.popleft()
                with suppress(OSError):
                    shutil.rmtree(folder, ignore_errors=True)
                    folder.mkdir()
                    arguments = [str(upload.folder), str(folder / PAGE), str(self._threads), json.dumps(upload.options)]
                    child = Child(MODULE, arguments, folder / LOG, folder / ANSWER)
                    self._running = uuid, upload, folder, child

    def stop(self, uuid: str) -> None:
        """End the check of a task that is started or removed; waits for the process's end."""
        with self._lock:
            self._waiting = deque(each for each in self._waiting if each[0] != uuid)
            if self._running is not None and self._running[0] == uuid:
                self._end_running()

    def close(self) -> None:
        """End all checks."""
        with self._lock:
            self._waiting.clear()
            self._end_running()

    def _end_running(self) -> None:
        """End the running check, if there is one, or take note of its end; nothing is left but its results."""
        if self._running is not None:
            _, _, folder, child = self._running
            child.end()
            shutil.rmtree(folder / SCRATCH, ignore_errors=True)
            self._running = None


def _last_line(folder: Path) -> dict[str, Any]:
    """The last whole line that the process printed, as far as it is one."""
    with suppress(OSError, ValueError):
        lines = read_end(folder / ANSWER, TAIL_BYTES).rpartition(b"\n")[0].rsplit(b"\n", 1)
        found = parse_json(lines[-1])
        if isinstance(found, dict):
            return found
    return {}


def _outcome(folder: Path) -> dict[str, Any]:
    last = _last_line(folder)
    if isinstance(last.get("check"), dict):
        return {"state": "done", **last["check"]}
    if "error" in last:
        return {"state": "failed", "message": str(last["error"])}
    return {"state": "failed", "message": "It ended before it was done; the photos may need more memory than there is."}
