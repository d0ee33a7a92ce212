"""Requests to an ASGI application without a server: one at a time, in the test's own thread."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote

from starlette.types import ASGIApp, Message


@dataclass(frozen=True)
class Reply:
    """An application's response.

    Attributes:
        status: HTTP status.
        headers: Headers by lower-case name.
        body: The whole body.
    """

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        """The body as JSON."""
        return json.loads(self.body)


def ask(
    app: ASGIApp,
    target: str,
    *,
    method: str = "GET",
    headers: Iterable[tuple[str, str]] = (),
    body: bytes = b"",
    value: Any = None,
    host: str = "127.0.0.1:3000",
) -> Reply:
    """Send one request.

    Args:
        app: The application.
        target: Path and query.
        method: The method; a body makes it POST.
        headers: Further headers.
        body: The body.
        value: A JSON value as body.
        host: The Host header.
    """
    given = [(name.lower(), text) for name, text in headers]
    if value is not None:
        body = json.dumps(value).encode()
        given.append(("content-type", "application/json"))
    if body and method == "GET":
        method = "POST"
    if method == "POST" and not any(name == "content-length" for name, _ in given):
        given.append(("content-length", str(len(body))))
    path, _, query = target.partition("?")
    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "path": unquote(path),
        "raw_path": path.encode("latin-1"),
        "query_string": query.encode("latin-1"),
        "root_path": "",
        "headers": [(name.encode(), text.encode("latin-1")) for name, text in [("host", host), *given]],
        "client": ("127.0.0.1", 50_000),
        "server": ("127.0.0.1", 3000),
    }
    return asyncio.run(_asked(app, scope, body))


async def _asked(app: ASGIApp, scope: dict[str, Any], body: bytes) -> Reply:
    sent: list[Message] = []
    waiting = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive() -> Message:
        return waiting.pop(0) if waiting else {"type": "http.disconnect"}

    async def send(message: Message) -> None:
        sent.append(message)

    await app(scope, receive, send)
    headers = {name.decode().lower(): text.decode("latin-1") for name, text in sent[0]["headers"]}
    return Reply(sent[0]["status"], headers, b"".join(message.get("body", b"") for message in sent[1:]))
