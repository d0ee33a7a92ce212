"""Requests that a server refuses: those of other sites' pages, and those that name another host.

A page of any site that the user has open can send requests to a server on 127.0.0.1; browsers tell its origin. A
foreign name that resolves to 127.0.0.1 (DNS rebinding) makes the origin the server's own, but not the Host.
"""

from __future__ import annotations

import hmac
import re
from collections.abc import Iterable

from starlette.datastructures import Headers

# Any port: a tunnel may use a different one. A foreign name can resolve to these addresses, but not be them.
HOSTS = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?")
FOREIGN = ("cross-site", "same-site")  # values of Sec-Fetch-Site: another site, or another port of this machine


class RefusedError(Exception):
    """A rejected request.

    Args:
        status: The HTTP status of the answer.
        text: The reason, a sentence.
    """

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


def only_header(headers: Iterable[tuple[bytes, bytes]], name: bytes, title: str) -> str:
    """The value of a header that a request must have exactly once.

    Raises:
        RefusedError: if it has none, or several.
    """
    found = [value for key, value in headers if key == name]
    if len(found) != 1:
        raise RefusedError(400, f"Exactly one {title} header is required.")
    return found[0].decode("latin-1")


def check_origin(headers: Headers) -> None:
    """Check that a request is not sent by another site's page; programs send neither header.

    Raises:
        RefusedError: if it is.
    """
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{headers['host']}":
        raise RefusedError(403, "Request from another page refused.")
    if headers.get("sec-fetch-site") in FOREIGN and headers.get("sec-fetch-mode") != "navigate":
        raise RefusedError(403, "Request from another site refused.")


def same(given: bytes, secret: str) -> bool:
    """Compare in a time that does not depend on how much agrees."""
    return hmac.compare_digest(given, secret.encode())
