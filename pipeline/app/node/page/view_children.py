"""The processes that show runs and mark their points: started when they are asked for, ended when they are not."""

from __future__ import annotations

import http.client
import json
import shutil
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from splatpipe.pipeline.app.node.tasks.child import Child
from splatpipe.pipeline.engine.errors import MachineError

MODULE = "splatpipe.pipeline.app.node.page.view_process"  # started, not imported: it loads what is large
MOST = 3  # processes; each has some hundred megabytes
IDLE_S = 900.0
START_S = 60.0  # on a busy machine; it imports for seconds
TIMEOUT_S = 120.0  # a photo of a hundred megapixels is converted in less
POLL_S = 0.05
CHUNK_BYTES = 1 << 18
SOCKET = "view"
PASSED_ON = ("content-type", "content-length", "etag", "cache-control", "content-security-policy",
             "access-control-allow-origin", "cross-origin-resource-policy", "cross-origin-opener-policy")  # fmt: skip


@dataclass
class _Shown:
    child: Child
    what: str
    folder: Path
    used_s: float


@dataclass(frozen=True)
class Answered:
    """What a process answered.

    Attributes:
        status: HTTP status.
        headers: Those that are passed on.
        body: The body, in chunks.
    """

    status: int
    headers: Mapping[str, str]
    body: Iterator[bytes]


class ViewChildren:
    """The processes, by task."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shown: dict[str, _Shown] = {}

    def start(self, uuid: str, what: Mapping[str, Any], log: Path) -> None:
        """Start a task's process, unless there is one; called by the thread that lives as long as the node.

        Args:
            uuid: The task.
            what: As ``view_process`` takes it; if it has changed, the process is started anew.
            log: File that receives what it prints.

        Raises:
            OSError: if it cannot be started.
        """
        text = json.dumps(what)
        with self._lock:
            there = self._shown.get(uuid)
            if there is not None and there.what == text and there.child.poll() is None:
                there.used_s = time.monotonic()
                return
            self._end(uuid)
            while len(self._shown) >= MOST:
                self._end(min(self._shown, key=lambda each: self._shown[each].used_s))
            folder = Path(mkdtemp(prefix="splatpipe-view-"))  # short: a socket's path has at most 107 bytes
            child = Child(MODULE, [str(folder / SOCKET), text], log)
            self._shown[uuid] = _Shown(child, text, folder, time.monotonic())

    def ask(self, uuid: str, method: str, target: str, headers: Mapping[str, str], body: bytes) -> Answered:
        """Pass a request on to a task's process; blocks until it answers.

        Raises:
            MachineError: if the process has ended.
            OSError: if the connection is cut.
        """
        with self._lock:
            shown = self._shown.get(uuid)
            if shown is not None:
                shown.used_s = time.monotonic()
        if shown is None:
            raise MachineError("This view was closed.", hint="Open it again.")
        connection = _Connection(shown.folder / SOCKET)
        deadline = time.monotonic() + START_S
        while True:
            try:
                connection.request(method, target, body or None, dict(headers))
                break
            except (FileNotFoundError, ConnectionRefusedError) as error:
                connection.close()
                if shown.child.poll() is not None or time.monotonic() > deadline:
                    raise MachineError(
                        "This view cannot be opened; the node's machine may be out of memory."
                    ) from error
                time.sleep(POLL_S)
        answer = connection.getresponse()
        kept = {name: value for name in PASSED_ON if (value := answer.headers.get(name)) is not None}
        return Answered(answer.status, kept, _chunks(connection, answer))

    def advance(self) -> None:
        """End the processes that nobody uses any more."""
        with self._lock:
            now = time.monotonic()
            for uuid in [each for each, shown in self._shown.items() if now - shown.used_s > IDLE_S]:
                self._end(uuid)

    def stop(self, uuid: str) -> None:
        """End a task's process, if there is one."""
        with self._lock:
            self._end(uuid)

    def close(self) -> None:
        """End all."""
        with self._lock:
            ending = [thread for uuid in list(self._shown) if (thread := self._end(uuid)) is not None]
        for thread in ending:
            thread.join()

    def _end(self, uuid: str) -> threading.Thread | None:
        """End a process without waiting for it: its page may be making a picture."""
        shown = self._shown.pop(uuid, None)
        if shown is None:
            return None
        thread = threading.Thread(target=_finish, args=(shown,))
        thread.start()
        return thread


def _finish(shown: _Shown) -> None:
    shown.child.end()
    shutil.rmtree(shown.folder, ignore_errors=True)


class _Connection(http.client.HTTPConnection):
    """An HTTP connection to a socket of this machine."""

    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=TIMEOUT_S)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(TIMEOUT_S)
        self.sock.connect(str(self._path))


def _chunks(connection: _Connection, answer: http.client.HTTPResponse) -> Iterator[bytes]:
    with closing(connection):
        while chunk := answer.read(CHUNK_BYTES):
            yield chunk
