"""Checks every request before it is handled, and sets the headers of every response.

The server listens on 127.0.0.1, which every user of the machine and any page in the user's browser can reach. So a
request needs one of the server's secrets (access.py): our pages, which may write, its cookie and an Origin that is
ours, and files of the run an address that names their folder. On 127.0.0.1 the Host must name this machine as well (a
foreign name that resolves to it is DNS rebinding). None of our paths needs an escape, a leading dot or an empty
segment: paths that have them are rejected before they are decoded.
"""

from __future__ import annotations

import re
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from splatpipe.pipeline.app.serving.refusals import HOSTS, RefusedError, check_origin, only_header, same
from splatpipe.pipeline.app.view.access import Access

PATH = re.compile(rb"/(?:\w[\w.-]*(?:/\w[\w.-]*)*)?", re.ASCII)
MAX_PATH_LETTERS = 240
MAX_BODY_BYTES = 16 << 10
METHODS = ("GET", "HEAD", "POST")
FIRST_PAGE = "run"  # where an address without a path leads
NO_KEY = (
    "Open the address that splatpipe view printed in the terminal where it runs, with its ?key=. Others are not shown"
    " this run. If this is that address, allow cookies for it.\n"
)
# Leads on from within our page: a browser does not send a strict cookie after a redirect of another site's link.
ENTRANCE = (
    '<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><title>splatpipe</title>'
    '<meta http-equiv="refresh" content="0;url={to}"><a href="{to}">Continue</a>\n'
)

CSP_OURS = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src"
    " 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# The run may be somebody else's: its pages have an origin of their own each, without our cookie and storage.
SANDBOX = " base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox allow-scripts allow-downloads"
# Self-contained pages of a run: their own scripts and workers, and nothing from anywhere but this server.
CSP_OF_RUN = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; style-src 'unsafe-inline';"
    " img-src 'self' data: blob:; media-src 'self' data: blob:; font-src data:; connect-src 'self' data: blob:;"
    " worker-src blob: data:;" + SANDBOX
)
# The run's web folder: the same policy as in its own page.
CSP_OF_SITE = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' blob:; style-src 'self'; img-src 'self' data: blob:;"
    " connect-src 'self' data: blob:; worker-src blob:;" + SANDBOX
)
# What a sandboxed page loads, it loads as a stranger (its origin is "null").
OF_RUN = {
    "cache-control": "no-cache",
    "access-control-allow-origin": "null",
    "cross-origin-resource-policy": "cross-origin",
}
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    "cache-control": "no-store",
    "content-security-policy": CSP_OURS,
}


class Guard:
    """Passes only requests that have a secret of this server.

    Args:
        app: The application behind the guard.
        access: The secrets.
        any_host: Whether the Host may be any name, because the server listens beyond this machine.
    """

    def __init__(self, app: ASGIApp, access: Access, any_host: bool) -> None:
        self._app, self._access, self._any_host = app, access, any_host

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        app = self._app
        try:
            self._check(scope)
            if not self._has_secret(scope):
                app = self._entrance(scope)
            scope["splatpipe.body"] = await _body(receive) if scope["method"] == "POST" else b""
        except RefusedError as error:
            app = PlainTextResponse(f"{error}\n", error.status, {"connection": "close"})
        await app(scope, receive, guarded)

    def _check(self, scope: Scope) -> None:
        """Check a request, whoever sends it.

        Raises:
            RefusedError: if it is not allowed.
        """
        host = only_header(scope["headers"], b"host", "Host")
        if not self._any_host and HOSTS.fullmatch(host) is None:
            raise RefusedError(421, "This is splatpipe view on this machine; it answers to 127.0.0.1 and localhost.")
        if scope["method"] not in METHODS:
            raise RefusedError(405, "Only GET, HEAD and POST are accepted.")
        path: bytes = scope.get("raw_path") or b""
        if len(path) > MAX_PATH_LETTERS or PATH.fullmatch(path) is None:
            raise RefusedError(404, "Not found.")
        headers = Headers(scope=scope)
        has_body = headers.get("transfer-encoding") or headers.get("content-length", "0") != "0"
        if scope["method"] != "POST" and has_body:
            raise RefusedError(400, "A read request must not have a body.")

    def _has_secret(self, scope: Scope) -> bool:
        """Whether a request may be handled; if not, it may still carry a key.

        Raises:
            RefusedError: if it has a secret, and comes from elsewhere than our pages.
        """
        headers, path = Headers(scope=scope), bytes(scope["raw_path"])
        folder, is_post = path.split(b"/")[1], scope["method"] == "POST"
        if same(folder, self._access.files):
            return not is_post
        if not same(folder, self._access.pages) or not self._access.has_cookie(headers.get("cookie", "")):
            return False
        check_origin(headers)
        if is_post:
            _check_writing(headers)
        return True

    def _entrance(self, scope: Scope) -> Response:
        """The response to a request without cookie: it sets one, if the request has a key.

        Raises:
            RefusedError: if it has none.
        """
        if scope["method"] == "POST" or not self._access.opens(scope["query_string"], scope["client"], scope["server"]):
            raise RefusedError(403, NO_KEY)
        to = f"/{self._access.pages}/{scope['path'][1:] or FIRST_PAGE}"
        return HTMLResponse(ENTRANCE.format(to=to), headers={"set-cookie": self._access.set_cookie()})


def _check_writing(headers: Headers) -> None:
    if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise RefusedError(415, "The request must be JSON.")
    length = headers.get("content-length", "")
    if not (length.isascii() and length.isdigit()):
        raise RefusedError(411, "Content-Length is required.")
    if int(length) > MAX_BODY_BYTES:
        raise RefusedError(413, "The request is too large.")


async def _body(receive: Receive) -> bytes:
    body = bytearray()
    while True:
        message: Any = await receive()
        if message["type"] != "http.request":
            raise RefusedError(400, "The request ended too early.")
        body += message.get("body", b"")
        if len(body) > MAX_BODY_BYTES:
            raise RefusedError(413, "The request is too large.")
        if not message.get("more_body"):
            return bytes(body)
