"""Requests that the node sends for a client: zips that it fetches, and ends of tasks that it reports.

Whoever may create tasks could otherwise use the node to reach what only the node can, such as a router or a cloud's
metadata. So it talks to hosts that its owner named on the command line, and follows no redirects.
"""

from __future__ import annotations

import http.client
import json
import time
from collections.abc import Callable, Collection
from typing import Any
from urllib.parse import SplitResult, urlsplit

from splatpipe.pipeline.engine.errors import UsageError

TIMEOUT_S = 30.0  # of each read or write
FETCH_S = 6 * 3600.0  # for a whole zip
BLOCK_BYTES = 1 << 20
MAX_URL_LETTERS = 2000
WEBHOOK_TRIES = 6
WEBHOOK_DELAY_S = 5.0  # times the number of the try, as NodeODM waits


class OutgoingError(ValueError):
    """An address that may not be used, or did not answer as it has to; the message is a sentence."""


class AllowedHosts:
    """The hosts that may be contacted.

    Args:
        hosts: ``NAME`` for its usual ports, or ``NAME:PORT``.

    Raises:
        UsageError: if one is neither.
    """

    def __init__(self, hosts: Collection[str]) -> None:
        self._hosts = set()
        for each in hosts:
            name, _, port = each.strip().lower().rpartition(":") if ":" in each else (each.strip().lower(), "", "")
            if not name or "/" in name or "@" in name or (port and not port.isdecimal()):
                raise UsageError(f'"{each}" is no host.', hint="Give --allow-host NAME or NAME:PORT.")
            self._hosts.add((name, int(port) if port else None))

    def check(self, url: str) -> SplitResult:
        """The parts of an address that may be contacted.

        Raises:
            OutgoingError: if it is not one.
        """
        try:
            parts = urlsplit(url)
            port, host = parts.port, parts.hostname
        except ValueError as error:
            raise OutgoingError("This is not an address: http://HOST/PATH or https://HOST/PATH.") from error
        if len(url) > MAX_URL_LETTERS or not url.isascii() or any(letter <= " " for letter in url):
            raise OutgoingError("The address is too long, or has characters that an address has not.")
        if parts.scheme not in ("http", "https") or not host or parts.username is not None:
            raise OutgoingError("This is not an address: http://HOST/PATH or https://HOST/PATH.")
        if (host, port) not in self._hosts:
            raise OutgoingError(f"This node does not contact {host}: its owner allows hosts with --allow-host.")
        return parts


def _connection(parts: SplitResult) -> http.client.HTTPConnection:
    kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
    return kind(parts.hostname or "", parts.port, timeout=TIMEOUT_S)


def _target(parts: SplitResult) -> str:
    return (parts.path or "/") + (f"?{parts.query}" if parts.query else "")


def fetch(parts: SplitResult, write: Callable[[bytes], None], max_bytes: int) -> int:
    """Load a file.

    Args:
        parts: Its address, checked.
        write: Takes its bytes.
        max_bytes: The most it may have.

    Returns:
        Its size.

    Raises:
        OutgoingError: if it is not there, or too large, or ends too early.
        OSError: if the host does not answer.
    """
    connection, began_s, size = _connection(parts), time.monotonic(), 0
    try:
        connection.request("GET", _target(parts), headers={"User-Agent": "splatpipe", "Accept-Encoding": "identity"})
        response = connection.getresponse()
        if response.status != 200:
            raise OutgoingError(f"{parts.hostname} answered with status {response.status}.")
        while block := response.read(BLOCK_BYTES):
            size += len(block)
            if size > max_bytes or time.monotonic() - began_s > FETCH_S:
                raise OutgoingError(f"The file from {parts.hostname} is too large, or takes too long.")
            write(block)
        if response.length:
            raise OutgoingError(f"The file from {parts.hostname} ended too early.")
    except http.client.HTTPException as error:
        raise OutgoingError(f"{parts.hostname} answered with what is not HTTP.") from error
    finally:
        connection.close()
    return size


def post_json(parts: SplitResult, value: Any) -> bool:
    """Post a value as JSON; returns whether the answer was 200."""
    connection = _connection(parts)
    try:
        body = json.dumps(value).encode()
        headers = {"Content-Type": "application/json", "User-Agent": "splatpipe"}
        connection.request("POST", _target(parts), body, headers)
        return connection.getresponse().status == 200
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()
