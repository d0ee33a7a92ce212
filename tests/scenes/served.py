"""A real ``splatpipe view`` process, and raw requests to it that no ordinary client would send."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from announced import announced
from timeouts import TIMEOUT_S

OPEN = re.compile(r"Open http://127\.0\.0\.1:(\d+)/(\w*)\?key=(\w+)")
LEADS_ON = re.compile(rb"url=/(\w+)/")
OF_THE_RUN = re.compile(rb'data-folder="/(\w+)"')


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
        key: The key in the address that it prints.
        process: The server's process.
    """

    port: int
    start: str
    key: str
    process: subprocess.Popen[str]

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def page(self, name: str = "run") -> str:
        """The address of one of our pages for a browser that has no cookie yet."""
        return f"{self.address}/{name}?key={self.key}"

    def file(self, name: str) -> str:
        """The address of a file of the run."""
        return f"{self.address}{self.files}/{name}"

    @cached_property
    def pages(self) -> str:
        """The folder of our pages."""
        found = LEADS_ON.search(self._entrance.body)
        assert found is not None, self._entrance
        return f"/{found.group(1).decode()}"

    @cached_property
    def files(self) -> str:
        """The folder of the run's files."""
        found = OF_THE_RUN.search(self.ask(f"{self.pages}/live").body)
        assert found is not None
        return f"/{found.group(1).decode()}"

    @cached_property
    def cookie(self) -> str:
        """What a browser sends back."""
        return self._entrance.headers["set-cookie"].partition(";")[0]

    @cached_property
    def _entrance(self) -> Answer:
        return self.ask(f"/?key={self.key}", cookie=False)

    def ask(
        self,
        target: str | bytes,
        *lines: str,
        method: str = "GET",
        host: str | None = "",
        body: bytes = b"",
        cookie: bool = True,
    ) -> Answer:
        """Send one request and read the whole response.

        Args:
            target: Request target, as it goes into the first line.
            lines: Further headers.
            method: The method.
            host: Value of the Host header; empty for the right one, None for none.
            body: Body of the request.
            cookie: Whether to send the server's cookie.
        """
        raw = target if isinstance(target, bytes) else target.encode("latin-1")
        headers = [f"Host: {host or f'127.0.0.1:{self.port}'}"] if host is not None else []
        headers += [f"Cookie: {self.cookie}"] if cookie else []
        head = b"%s %s HTTP/1.1\r\n" % (method.encode(), raw)
        head += "".join(f"{line}\r\n" for line in [*headers, *lines, "Connection: close"]).encode("latin-1") + b"\r\n"
        return self.send(head + body)

    def send(self, raw: bytes) -> Answer:
        """Send bytes and read the whole response."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=TIMEOUT_S) as connection:
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
def serving(out: Path, *options: object, environment: Mapping[str, str] | None = None) -> Iterator[Served]:
    """Run ``splatpipe view OUT`` while the context lasts, with some more environment variables."""
    arguments = ("view", out, "--no-browser", *options)
    with announced(OPEN, *arguments, environment=environment) as (found, process):
        yield Served(int(found.group(1)), found.group(2), found.group(3), process)
