"""Checks every request before it is handled, and sets the headers of every response.

The server listens on 127.0.0.1, which any page in the user's browser can reach. So the Host must name this machine (a
foreign name that resolves to it is DNS rebinding), requests from another origin are rejected, and writing requests must
carry the secret of this server, which only its own page knows. None of our paths needs an escape, a leading dot or an
empty segment: paths that have them are rejected before they are decoded.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterable
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HOSTS = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")  # any port: a tunnel may use a different one
PATH = re.compile(rb"/(?:\w[\w.-]*(?:/\w[\w.-]*)*)?", re.ASCII)
LONGEST_PATH = 200
LARGEST_BODY = 16 << 10
METHODS = ("GET", "HEAD", "POST")
TOKEN_HEADER = "x-splatpipe-token"
FOREIGN = ("cross-site", "same-site")  # of Sec-Fetch-Site: another site, or another port of this machine

CSP_OURS = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src"
    " 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Self-contained pages of a run: their own scripts and workers, and nothing from anywhere but this server.
CSP_OF_RUN = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; style-src 'unsafe-inline';"
    " img-src 'self' data: blob:; media-src 'self' data: blob:; font-src data:; connect-src 'self' data: blob:;"
    " worker-src blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
# The run's web folder: the same policy as in its own page.
CSP_OF_SITE = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' blob:; style-src 'self'; img-src 'self' data: blob:;"
    " connect-src 'self' data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}


class RefusedError(Exception):
    """A rejected request."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


class Guard:
    """Passes only requests from our own pages.

    Args:
        app: The application behind the guard.
        token: The secret of this server.
    """

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("cache-control", "no-store")
                headers.setdefault("content-security-policy", CSP_OURS)
            await send(message)

        try:
            self._check(scope)
            body = await _body(receive) if scope["method"] == "POST" else b""
        except RefusedError as error:
            answer = PlainTextResponse(f"{error}\n", error.status, {"connection": "close"})
            await answer(scope, receive, guarded)
            return
        scope["splatpipe.body"] = body
        await self._app(scope, receive, guarded)

    def _check(self, scope: Scope) -> None:
        """Check a request.

        Raises:
            RefusedError: if it is not allowed.
        """
        host = _only(scope["headers"], b"host", "Host")
        if HOSTS.fullmatch(host) is None:
            raise RefusedError(421, "This is splatpipe view on this machine; it answers to 127.0.0.1 and localhost.")
        if scope["method"] not in METHODS:
            raise RefusedError(405, "Only GET, HEAD and POST are accepted.")
        path: bytes = scope.get("raw_path") or b""
        if len(path) > LONGEST_PATH or PATH.fullmatch(path) is None:
            raise RefusedError(404, "Not found.")
        headers = Headers(scope=scope)
        origin = headers.get("origin")
        if origin is not None and origin != f"http://{host}":
            raise RefusedError(403, "Request from another page refused.")
        if headers.get("sec-fetch-site") in FOREIGN and headers.get("sec-fetch-mode") != "navigate":
            raise RefusedError(403, "Request from another site refused.")
        if scope["method"] == "POST":
            _check_writing(headers, self._token)
        elif headers.get("transfer-encoding") or headers.get("content-length", "0") != "0":
            raise RefusedError(400, "A read request must not have a body.")


def _check_writing(headers: Headers, token: str) -> None:
    if not secrets.compare_digest(headers.get(TOKEN_HEADER, "").encode(), token.encode()):
        raise RefusedError(403, "Only the page of this server may write. Load it again.")
    if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise RefusedError(415, "The request must be JSON.")
    length = headers.get("content-length", "")
    if not (length.isascii() and length.isdigit()):
        raise RefusedError(411, "Content-Length is required.")
    if int(length) > LARGEST_BODY:
        raise RefusedError(413, "The request is too large.")


def _only(headers: Iterable[tuple[bytes, bytes]], name: bytes, title: str) -> str:
    found = [value for key, value in headers if key == name]
    if len(found) != 1:
        raise RefusedError(400, f"Exactly one {title} header is required.")
    return found[0].decode("latin-1")


async def _body(receive: Receive) -> bytes:
    body = bytearray()
    while True:
        message: Any = await receive()
        body += message.get("body", b"")
        if len(body) > LARGEST_BODY:
            raise RefusedError(413, "The request is too large.")
        if message["type"] != "http.request" or not message.get("more_body"):
            return bytes(body)
