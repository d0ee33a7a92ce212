"""Serves files over HTTP: opened without following links, whole or by range."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from anyio import to_thread
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

CHUNK_BYTES = 1 << 18
RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".gz": "application/gzip",
    ".json": "application/json",
    ".ply": "application/octet-stream",
    ".spz": "application/octet-stream",
    ".glb": "model/gltf-binary",
    ".mp4": "video/mp4",
    ".webm": "video/webm",
    ".png": "image/png",
    ".jpg": "image/jpeg",
}


class FileNotServedError(Exception):
    """A path is not a file inside its folder; the reason is not disclosed."""


@dataclass(frozen=True)
class OpenFile:
    """An open file to send; the sender closes its descriptor."""

    descriptor: int
    size: int
    tag: str

    def read(self, length: int, at: int) -> bytes:
        """Bytes from an offset on, at most so many; none at the end of the file only."""
        return os.pread(self.descriptor, length, at)


def open_inside(folder: Path, relative: str) -> OpenFile:
    """Open a regular file below a folder; symbolic links anywhere in the path are rejected.

    Args:
        folder: The folder that must contain it; trusted.
        relative: POSIX path below it.

    Raises:
        FileNotServedError: if it does not exist, or only outside the folder.
    """
    parts = PurePosixPath(relative).parts
    if not parts or any(part in ("..", "/") or "\0" in part for part in parts):
        raise FileNotServedError
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK  # does not block on a pipe
    descriptor = -1
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        for part in parts:
            above = descriptor
            descriptor = os.open(part, flags | (os.O_DIRECTORY if part is not parts[-1] else 0), dir_fd=above)
            os.close(above)
        facts = os.fstat(descriptor)
        if not stat.S_ISREG(facts.st_mode):
            raise FileNotServedError
    except (OSError, FileNotServedError, ValueError) as error:
        if descriptor >= 0:
            os.close(descriptor)
        raise FileNotServedError from error
    return OpenFile(descriptor, facts.st_size, f'"{facts.st_ino:x}-{facts.st_size:x}-{facts.st_mtime_ns:x}"')


def is_inside(folder: Path, relative: str) -> bool:
    """Whether ``open_inside`` can open it."""
    try:
        os.close(open_inside(folder, relative).descriptor)
    except FileNotServedError:
        return False
    return True


def parse_range(header: str | None, size: int) -> tuple[int, int] | None:
    """Parse a Range header: the first byte and the one after the last; None for the whole file.

    Multiple ranges and units other than bytes are answered with the whole file (RFC 9110, 14.2).

    Raises:
        IndexError: if the file has no such bytes.
    """
    found = None if header is None else RANGE.fullmatch(header.strip())
    if found is None or found.groups() == ("", ""):
        return None
    first, last = found.groups()
    if first == "":  # a suffix range: the last bytes
        if int(last) == 0 or size == 0:
            raise IndexError
        return max(0, size - int(last)), size
    begin, end = int(first), min(int(last) + 1, size) if last else size
    if last and int(last) < begin:
        return None
    if begin >= size:
        raise IndexError
    return begin, end


class FileAnswer(Response):
    """Sends a file, or the requested range of it, and closes it."""

    def __init__(self, file: OpenFile, kind: str, headers: Mapping[str, str]) -> None:
        super().__init__(headers=dict(headers), media_type=kind)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._answer(Request(scope, receive), send)
        finally:
            os.close(self._file.descriptor)

    async def _answer(self, request: Request, send: Send) -> None:
        headers, size, tag = request.headers, self._file.size, self._file.tag
        self.headers["etag"], self.headers["accept-ranges"] = tag, "bytes"
        begin, end, status = 0, size, 200
        if tag in [each.strip() for each in headers.get("if-none-match", "").split(",")]:
            end, status = 0, 304
        elif headers.get("if-range", tag) == tag:
            try:
                found = parse_range(headers.get("range"), size)
            except IndexError:
                end, status = 0, 416
                self.headers["content-range"] = f"bytes */{size}"
            else:
                if found is not None:
                    (begin, end), status = found, 206
                    self.headers["content-range"] = f"bytes {begin}-{end - 1}/{size}"
        if status != 304:
            self.headers["content-length"] = str(end - begin)
        else:
            del self.headers["content-length"]
        await send({"type": "http.response.start", "status": status, "headers": self.raw_headers})
        if request.method != "HEAD":
            while begin < end:
                chunk = await to_thread.run_sync(self._file.read, min(CHUNK_BYTES, end - begin), begin)
                if not chunk:
                    raise OSError("the file became shorter while it was sent")
                begin += len(chunk)
                await send({"type": "http.response.body", "body": chunk, "more_body": True})
        await send({"type": "http.response.body", "body": b""})
