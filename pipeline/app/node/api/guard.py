"""Who may send a request, and what one may look like, before anything of it is handled.

Without a token the node listens on this machine only. Every page in a browser here can send it requests, so that the
Host must name this machine and the Origin, if there is one, be the node's own; other pages may not read answers. With a
token the node is called by its name from anywhere: any Host is right, any page may read what the token opens, and no
cookie exists that a page could misuse.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from splatpipe.pipeline.app.node.api.answers import BAD_TOKEN
from splatpipe.pipeline.app.serving.refusals import HOSTS, RefusedError, check_origin, only_header, same

PATH = re.compile(rb"/(?:\w[\w.~-]*(?:/\w[\w.~-]*)*/?)?", re.ASCII)  # no escapes, no dots first
MAX_PATH_LETTERS = 400
MAX_QUERY_LETTERS = 4096
MAX_HEADER_BYTES = 16 << 10  # of all headers: cookies of other servers on 127.0.0.1 come along
MAX_PARAMETERS = 32
VERSIONS = ("1.0", "1.1")
METHODS = ("GET", "HEAD", "POST", "OPTIONS")
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    "cache-control": "no-store",
    "content-security-policy": "default-src 'none'; frame-ancestors 'none'",
}
CORS = {
    "access-control-allow-origin": "*",
    "access-control-allow-methods": "GET, HEAD, POST, OPTIONS",
    "access-control-allow-headers": "Content-Type, Range, Set-Uuid",
    "access-control-expose-headers": "Content-Length, Content-Range, Accept-Ranges",
    "access-control-max-age": "600",
}
PAGES = ("/page/", "/results/")  # of the page, which looks after them itself (page/gate.py)
SANDBOXED = "/results/"  # a run's own pages have no origin
OPEN_CALLS = ("/auth/info", "/auth/login", "/auth/register")


class Guard:
    """Passes only requests that may be handled.

    Args:
        app: The application behind it.
        token: The token; empty for none.
        open_paths: Beginnings of paths whose requests are checked by who handles them: no token, no Origin, no CORS.
        escaped: Beginnings of paths in which names of files may be escaped.
        local: Whether only this machine calls it, even with a token, so that Host and Origin are checked.
    """

    def __init__(
        self,
        app: ASGIApp,
        token: str,
        open_paths: Sequence[str] = (),
        escaped: Sequence[bytes] = (),
        *,
        local: bool = False,
    ) -> None:
        self._app, self._token, self._local = app, token, local or not token
        self._open, self._escaped = tuple(open_paths), tuple(escaped)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        has_cors = not self._local and not self._is_open(scope)
        answered = _with_headers(send, HEADERS | (CORS if has_cors else {}))
        try:
            self._check(scope)
        except RefusedError as error:
            await PlainTextResponse(f"{error}\n", error.status, {"connection": "close"})(scope, receive, answered)
            return
        if scope["method"] == "OPTIONS":
            await Response(status_code=204 if has_cors else 405)(scope, receive, answered)
        elif not self._opens(scope):
            await JSONResponse({"error": BAD_TOKEN}, headers={"connection": "close"})(scope, receive, answered)
        else:
            await self._app(scope, receive, answered)

    def _check(self, scope: Scope) -> None:
        """Check a request, whoever sends it.

        Raises:
            RefusedError: if it is not allowed.
        """
        if scope["http_version"] not in VERSIONS:
            raise RefusedError(505, "Only HTTP/1.0 and HTTP/1.1 are spoken here.")
        if sum(len(name) + len(value) for name, value in scope["headers"]) > MAX_HEADER_BYTES:
            raise RefusedError(431, "The headers are too long.")
        host = only_header(scope["headers"], b"host", "Host")
        headers = Headers(scope=scope)
        if self._local:
            if HOSTS.fullmatch(host) is None:
                raise RefusedError(421, "This node is for this machine; it answers to 127.0.0.1, [::1] and localhost.")
            if not scope["path"].startswith(SANDBOXED):
                check_origin(headers)
        if scope["method"] not in METHODS:
            raise RefusedError(405, "Only GET, HEAD and POST are accepted.")
        path: bytes = scope.get("raw_path") or b""
        plain = not path.startswith(self._escaped) if self._escaped else True
        if len(path) > MAX_PATH_LETTERS or (plain and PATH.fullmatch(path) is None):
            raise RefusedError(404, "Not found.")
        if len(scope["query_string"]) > MAX_QUERY_LETTERS:
            raise RefusedError(414, "The address is too long.")
        has_body = headers.get("transfer-encoding") or headers.get("content-length", "0") != "0"
        if scope["method"] != "POST" and has_body:
            raise RefusedError(400, "A read request must not have a body.")

    def _is_open(self, scope: Scope) -> bool:
        """Whether a request is for the page, which checks on its own who sends it."""
        return scope["path"] == "/" or str(scope["path"]).startswith(self._open)

    def _opens(self, scope: Scope) -> bool:
        """Whether a request carries the token, or needs none."""
        if not self._token or scope["path"] in OPEN_CALLS or self._is_open(scope):
            return True
        try:
            given = parse_qs(scope["query_string"].decode("latin-1"), max_num_fields=MAX_PARAMETERS)
        except ValueError:
            return False
        return same(given.get("token", [""])[0].encode("utf-8", "surrogateescape"), self._token)


def _with_headers(send: Send, headers: dict[str, str]) -> Send:
    async def answered(message: Message) -> None:
        if message["type"] == "http.response.start":
            mutable = MutableHeaders(scope=message)
            for name, value in headers.items():
                mutable.setdefault(name, value)
        await send(message)

    return answered
