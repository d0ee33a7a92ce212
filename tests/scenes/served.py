"""A real ``splatpipe view`` process, and raw requests to it that no ordinary client would send."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from timeouts import TIMEOUT_S

ADDRESS = re.compile(r"Open http://127\.0\.0\.1:(\d+)/(\w*)")


@dataclass(frozen=True)
class Answer:
    """A server's response.

    Attributes:
        status: 0 if the server closed the connection without a response.
        headers: Headers by lower-case name.
        body: The body, as sent.
    """

    status: int
    headers: dict[str, str]
    body: bytes


@dataclass(frozen=True)
class Served:
    """A running server.

    Attributes:
        port: Its port.
        start: The page that it opens.
        process: The server's process.
    """

    port: int
    start: str
    process: subprocess.Popen[str]

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(
        self, target: str | bytes, *lines: str, method: str = "GET", host: str | None = "", body: bytes = b""
    ) -> Answer:
        """Send one request and read the whole response.

        Args:
            target: Request target, as it goes into the first line.
            lines: Further headers.
            method: The method.
            host: Value of the Host header; empty for the right one, None for none.
            body: Body of the request.
        """
        raw = target if isinstance(target, bytes) else target.encode("latin-1")
        headers = [f"Host: {host or f'127.0.0.1:{self.port}'}"] if host is not None else []
        head = b"%s %s HTTP/1.1\r\n" % (method.encode(), raw)
        head += "".join(f"{line}\r\n" for line in [*headers, *lines, "Connection: close"]).encode("latin-1") + b"\r\n"
        return self.send(head + body)

    def send(self, raw: bytes) -> Answer:
        """Send bytes and read the whole response."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=30) as connection:
            with contextlib.suppress(OSError):  # rejected before all of it was sent
                connection.sendall(raw)
            received = b""
            with contextlib.suppress(ConnectionResetError):
                while chunk := connection.recv(1 << 16):
                    received += chunk
        head, _, body = received.partition(b"\r\n\r\n")
        first, *rest = head.decode("latin-1").split("\r\n")
        fields = (line.partition(": ") for line in rest)
        return Answer(int(first.split()[1]) if first else 0, {name.lower(): value for name, _, value in fields}, body)


def reserved_port() -> int:
    """Return a free port for a server that is restarted: below those that the system gives to other programs."""
    for port in range(20_000 + os.getpid() % 10_000, 32_000):
        with socket.socket() as attempt, contextlib.suppress(OSError):
            attempt.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no port is free")


@contextlib.contextmanager
def serving(out: Path, *options: object) -> Iterator[Served]:
    """Run ``splatpipe view OUT`` while the context lasts."""
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", "view", str(out), "--no-browser", *map(str, options)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        output = ""
        for line in process.stderr:
            output += line
            if found := ADDRESS.search(line):
                yield Served(int(found.group(1)), found.group(2), process)
                break
        else:
            raise AssertionError(output)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()  # no effect if it has ended
