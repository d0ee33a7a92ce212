"""Bodies of requests as they arrive, and the small ones whole."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any
from urllib.parse import parse_qsl

from anyio import move_on_after
from starlette.requests import Request

from splatpipe.pipeline.app.node.api.multipart import BadBodyError
from splatpipe.pipeline.engine.files.json_file import parse_json

MAX_SMALL_BYTES = 4 << 20  # options with a boundary, urlencoded
MAX_FIELDS = 32
MAX_REST_BYTES = 32 << 20  # read of a refused body, so that its client gets to read why
IGNORED_S = 30.0  # for a body that is not used: strangers send them, and a connection is one of few
WHOLE = "splatpipe.whole"  # whether a request's body has been read to its end


async def limited(request: Request, max_bytes: int) -> AsyncIterator[bytes]:
    """The body in pieces.

    Raises:
        BadBodyError: if it has more bytes, or ends too early.
    """
    size = 0
    while True:
        message = await request.receive()
        if message["type"] != "http.request":
            raise BadBodyError("The request ended too early.")
        request.scope[WHOLE] = not message.get("more_body", False)
        chunk = message.get("body", b"")
        size += len(chunk)
        if size > max_bytes:
            raise BadBodyError("The request is too large.")
        if chunk:
            yield chunk
        if request.scope[WHOLE]:
            return


async def small_body(request: Request) -> dict[str, Any]:
    """The fields of a urlencoded or JSON body.

    Raises:
        BadBodyError: if it is neither, or too large.
    """
    data = b"".join([chunk async for chunk in limited(request, MAX_SMALL_BYTES)])
    if not data.strip():
        return {}
    try:
        if "json" in request.headers.get("content-type", "").lower():
            found = parse_json(data)
            if not isinstance(found, dict):
                raise ValueError("it is no object")
            return found
        return dict(parse_qsl(data.decode(), keep_blank_values=True, max_num_fields=MAX_FIELDS))
    except (ValueError, UnicodeError) as error:
        raise BadBodyError("The request is neither JSON nor urlencoded.") from error


async def drain_rest(request: Request) -> None:
    """Read what is left of a refused body, within limits; beyond, its connection is closed."""
    has_body = "transfer-encoding" in request.headers or request.headers.get("content-length", "0") != "0"
    if has_body and not request.scope.get(WHOLE):
        with suppress(BadBodyError):
            await drain(request, MAX_REST_BYTES)


async def drain(request: Request, max_bytes: int) -> None:
    """Read a body that is of no interest, so that its client can read the answer; one that takes long is left.

    Raises:
        BadBodyError: if it has more bytes, or ends too early.
    """
    with move_on_after(IGNORED_S):
        async for _ in limited(request, max_bytes):
            pass
