"""Stand in for WebODM: hand a job to a node, watch it, and import what it hands back.

    python benchmarks webodm_import all.zip                         # only the import
    python benchmarks webodm_import http://127.0.0.1:3000 --task UUID
    python benchmarks webodm_import http://127.0.0.1:3000 --photos FOLDER [--options JSON]

It asks for /info and /options within 5 seconds, polls a task every 5 seconds with the number of lines that it has, and
gives the task up at an error or a status of 400 or more, but not when a connection is refused, as WebODM does.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from webodm_assets import BrokenArchive, Check, ImportFailure, import_archive

POLL_S = 5.0
LIMIT_S = 5.0  # of /info, /options and polls
TRANSFER_LIMIT_S = 30.0  # PyODM's
RETRIES = 5
UPLOADS_AT_ONCE = 10
RANGE_BYTES = 10 << 20
OPTION_KEYS = {"name", "type", "value", "domain", "help"}
OPTION_TYPES = {"int", "float", "string", "bool", "enum"}
FAILED, COMPLETED, CANCELED = 30, 40, 50
Answer = TypeVar("Answer")


class TaskFailure(Exception):
    """WebODM has given the task up for good; its text is the reason."""


@dataclass
class WebOdm:
    """A client that does what WebODM does.

    Attributes:
        url: Address of the node.
        token: Its token; empty for none.
        poll_s: Seconds between two polls.
        lines: The task's output so far.
    """

    url: str
    token: str = ""
    poll_s: float = POLL_S
    lines: list[str] = field(default_factory=list)

    def update_node(self) -> dict[str, Any]:
        """Ask for /info and /options, and check that WebODM can use them.

        Raises:
            TaskFailure: if it could not.
        """
        info, options = self._json("/info", LIMIT_S), self._json("/options", LIMIT_S)
        if not all(isinstance(info.get(name), int) for name in ("taskQueueCount", "maxParallelTasks")):
            raise TaskFailure(f"/info lacks numbers: {info}")
        for name in ("version", "engine", "engineVersion"):
            if not isinstance(info.get(name), str) or len(info[name]) > 32:
                raise TaskFailure(f"/info has a {name} that does not fit: {info.get(name)}")
        for option in options:
            enum = option.get("type") == "enum"
            fits = set(option) == OPTION_KEYS and option["type"] in OPTION_TYPES and isinstance(option["value"], str)
            if not fits or isinstance(option["domain"], list) != enum:
                raise TaskFailure(f"/options has an item that stops the refresh of nodes: {option}")
        return dict(info)

    def create(self, photos: Sequence[Path], options: Sequence[Mapping[str, Any]] = (), name: str = "") -> str:
        """Create a task: init, each file in a POST of its own, commit; return its uuid."""
        fields = {"name": name, "options": json.dumps(list(options)), "skipPostProcessing": "true"}
        task = str(self._post("/task/new/init", _multipart(fields, ()))["uuid"])
        with ThreadPoolExecutor(UPLOADS_AT_ONCE) as pool:
            list(pool.map(lambda path: self._upload(task, path), photos))
        self._post(f"/task/new/commit/{task}", _multipart({}, ()))
        return task

    def _upload(self, task: str, path: Path) -> None:
        def post() -> None:
            answer = self._post(f"/task/new/upload/{task}", _multipart({}, (path,)))
            if answer.get("success") is not True:
                raise TaskFailure(f"{path.name} was not taken: {answer}")

        _retried(post, (TaskFailure, OSError))

    def watch(self, task: str, limit_s: float) -> dict[str, Any]:
        """Poll a task until it has ended; returns its last info.

        Raises:
            TaskFailure: if it fails, is cancelled, or an answer makes WebODM give it up.
            TimeoutError: if it has not ended within the limit.
        """
        ends = time.monotonic() + limit_s
        while time.monotonic() < ends:
            try:
                info = self._json(f"/task/{task}/info?with_output={len(self.lines)}", LIMIT_S)
            except ConnectionRefusedError:
                time.sleep(self.poll_s)
                continue
            self.lines += info.get("output", [])
            code = info["status"]["code"]
            if code in (FAILED, CANCELED):
                raise TaskFailure(f"{code}: {info['status'].get('errorMessage')}")
            if code == COMPLETED:
                return dict(info)
            time.sleep(self.poll_s)
        raise TimeoutError(f"{task} has not ended after {limit_s:.0f} s")

    def download(self, task: str, path: Path) -> None:
        """Download all.zip as PyODM does: in ranges by 16 threads where the node offers them and it is large."""
        _retried(lambda: self._download(task, path), (OSError, TaskFailure))

    def _download(self, task: str, path: Path) -> None:
        address = self._address(f"/task/{task}/download/all.zip")
        with urllib.request.urlopen(address, timeout=TRANSFER_LIMIT_S) as answer:
            size, kind = int(answer.headers["Content-Length"]), answer.headers["Content-Type"]
            ranges = answer.headers.get("Accept-Ranges") == "bytes" and size > RANGE_BYTES
            if kind.startswith("application/json"):
                raise TaskFailure(answer.read().decode())
            if not ranges:
                path.write_bytes(answer.read())
        if ranges:
            with path.open("wb") as file:
                file.truncate(size)
            with ThreadPoolExecutor(16) as pool:
                list(pool.map(lambda start: _fetch(address, path, start, size), range(0, size, RANGE_BYTES)))
        if path.stat().st_size != size:
            raise TaskFailure(f"all.zip has {path.stat().st_size:,} of {size:,} bytes")

    def _json(self, path: str, limit_s: float) -> Any:
        """The JSON that the node answers with.

        Raises:
            TaskFailure: if it has an `error`, or its status is 400 or more.
            ConnectionRefusedError: if nobody listens.
        """
        return self._open(urllib.request.Request(self._address(path)), limit_s)

    def _post(self, path: str, content: tuple[bytes, str]) -> dict[str, Any]:
        body, kind = content
        request = urllib.request.Request(self._address(path), data=body, headers={"Content-Type": kind})
        return dict(self._open(request, TRANSFER_LIMIT_S))

    def _open(self, request: urllib.request.Request, limit_s: float) -> Any:
        try:
            with urllib.request.urlopen(request, timeout=limit_s) as answer:
                if not answer.headers["Content-Type"].startswith("application/json"):
                    raise TaskFailure(f"{request.full_url} answers with {answer.headers['Content-Type']}")
                value = json.loads(answer.read())
        except urllib.error.HTTPError as error:
            raise TaskFailure(f"{request.full_url}: {error.code}") from error
        except urllib.error.URLError as error:
            if isinstance(error.reason, ConnectionRefusedError | ConnectionResetError):
                raise ConnectionRefusedError(f"{request.full_url}: nobody listens") from error
            raise TaskFailure(f"{request.full_url}: {error.reason}") from error
        except TimeoutError as error:
            raise TaskFailure(f"{request.full_url}: no answer within {limit_s:.0f} s") from error
        if isinstance(value, dict) and value.get("error"):
            raise TaskFailure(f"{request.full_url}: {value['error']}")
        return value

    def _address(self, path: str) -> str:
        token = urllib.parse.urlencode({"token": self.token}) if self.token else ""
        return self.url.rstrip("/") + path + (("&" if "?" in path else "?") + token if token else "")


def _retried(work: Callable[[], Answer], errors: tuple[type[Exception], ...]) -> Answer:
    """Do something up to six times, after n times 5 seconds, whatever the error, as PyODM does."""
    for attempt in range(RETRIES + 1):
        try:
            return work()
        except errors:
            if attempt == RETRIES:
                raise
            time.sleep(POLL_S * (attempt + 1))
    raise AssertionError


def _fetch(address: str, path: Path, start: int, size: int) -> None:
    stop = min(start + RANGE_BYTES, size)
    request = urllib.request.Request(address, headers={"Range": f"bytes={start}-{stop - 1}"})
    with urllib.request.urlopen(request, timeout=TRANSFER_LIMIT_S) as answer, path.open("r+b") as file:
        data = answer.read()
        if answer.status != 206 or len(data) != stop - start:
            raise TaskFailure(f"a range of {len(data):,} instead of {stop - start:,} bytes, which hangs PyODM")
        file.seek(start)
        file.write(data)


def _multipart(fields: Mapping[str, str], files: Sequence[Path]) -> tuple[bytes, str]:
    """The body of a form and its media type (RFC 7578)."""
    border = uuid.uuid4().hex
    body = b""
    for name, value in fields.items():
        body += f'--{border}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{value}\r\n'.encode()
    for path in files:
        head = f'Content-Disposition: form-data; name="images"; filename="{path.name}"'
        body += f"--{border}\r\n{head}\r\nContent-Type: application/octet-stream\r\n\r\n".encode()
        body += path.read_bytes() + b"\r\n"
    return body + f"--{border}--\r\n".encode(), f"multipart/form-data; boundary={border}"


def import_task(client: WebOdm, task: str, folder: Path) -> list[Check]:
    """Download a completed task's all.zip and import it; a broken archive is downloaded again, up to five times.

    Raises:
        ImportFailure: if WebODM could not import it.
    """
    for attempt in range(RETRIES + 1):
        path, contents = folder / "all.zip", folder / f"contents-{attempt}"
        client.download(task, path)
        contents.mkdir()
        try:
            return import_archive(path, contents)
        except BrokenArchive:
            if attempt == RETRIES:
                raise
    raise AssertionError


def told(checks: Sequence[Check]) -> Iterator[str]:
    """The checks as lines."""
    width = max(len(check.what) for check in checks)
    for check in checks:
        yield f"{'ok ' if check.met else 'NOT'} {check.what:{width}}  {check.figure}"


def main() -> str | None:
    """Import, and return what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="an all.zip, or the address of a node")
    parser.add_argument("--token", default="")
    parser.add_argument("--task", help="uuid of a task that is there already")
    parser.add_argument("--photos", type=Path, help="folder whose files are a new task's")
    parser.add_argument("--options", default="[]", help='of a new task, as [{"name": ..., "value": ...}]')
    parser.add_argument("--hours", type=float, default=2.0, help="how long a task may take")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="webodm-") as name:
        folder = Path(name)
        try:
            checks = _checks(arguments, folder)
        except (ImportFailure, TaskFailure, OSError) as error:
            return f"WebODM gives up: {error}"
    for line in told(checks):
        print(line)
    return None if all(check.met for check in checks) else "Not everything is right."


def _checks(arguments: argparse.Namespace, folder: Path) -> list[Check]:
    if not arguments.source.startswith(("http://", "https://")):
        (folder / "contents").mkdir()
        return import_archive(Path(arguments.source), folder / "contents")
    client = WebOdm(arguments.source, arguments.token)
    print(client.update_node())
    task = arguments.task
    if task is None:
        photos = sorted(path for path in arguments.photos.iterdir() if path.is_file())
        task = client.create(photos, json.loads(arguments.options))
        print(f"task {task}: {len(photos)} files")
    client.watch(task, 3600.0 * arguments.hours)
    return import_task(client, task, folder)


if __name__ == "__main__":
    sys.exit(main())
