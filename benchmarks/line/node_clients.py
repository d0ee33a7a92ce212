"""Clients of a node: uploads over sockets that are cut, commands, and polls; the standard library only."""

from __future__ import annotations

import http.client
import json
import random
import re
import socket
import time
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import urlencode

HOST = "127.0.0.1"
TIMEOUT_S = 40.0
PATIENCE_S = 600.0  # for a node that is being killed and started again
BOUNDARY = "splatpipe-stress"


def call(port: int, method: str, path: str, body: bytes = b"", headers: Mapping[str, str] | None = None) -> Any:
    """The JSON answer of one call.

    Raises:
        OSError, http.client.HTTPException, ValueError: if there is none.
    """
    connection = http.client.HTTPConnection(HOST, port, timeout=TIMEOUT_S)
    try:
        connection.request(method, path, body, dict(headers or {}))
        response = connection.getresponse()
        data = response.read()
        if response.status != 200:
            raise http.client.HTTPException(f"{method} {path} answered {response.status}")
        return json.loads(data)
    finally:
        connection.close()


def patient(port: int, method: str, path: str, body: bytes = b"", headers: Mapping[str, str] | None = None) -> Any:
    """As ``call``; refused and lost connections are tried again, as clients do while a node is started again."""
    until_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return call(port, method, path, body, headers)
        except (OSError, http.client.HTTPException, ValueError):
            if time.monotonic() > until_s:
                raise
            time.sleep(random.uniform(0.05, 0.5))


def form(files: Sequence[tuple[str, bytes]] = (), **fields: str) -> tuple[bytes, dict[str, str]]:
    """A multipart body and its headers."""
    head = f"--{BOUNDARY}\r\nContent-Disposition: form-data"
    body = "".join(f'{head}; name="{name}"\r\n\r\n{text}\r\n' for name, text in fields.items()).encode()
    for name, content in files:
        body += f'{head}; name="images"; filename="{name}"\r\n\r\n'.encode() + content + b"\r\n"
    body += f"--{BOUNDARY}--\r\n".encode()
    return body, {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}


def cut_upload(port: int, path: str, body: bytes, headers: Mapping[str, str], share: float) -> None:
    """Send the beginning of a request, and cut the connection."""
    lines = [f"POST {path} HTTP/1.1", f"Host: {HOST}:{port}", f"Content-Length: {len(body)}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    data = "\r\n".join(lines).encode() + b"\r\n\r\n" + body
    try:
        with socket.create_connection((HOST, port), TIMEOUT_S) as connection:
            connection.sendall(data[: int(share * len(data))])
    except OSError:
        pass  # the node is just being started again


def raw(port: int, data: bytes, wait_s: float = 0.7) -> bytes:
    """Send bytes, and return what comes back until the connection ends or nothing comes any more."""
    found = b""
    try:
        with socket.create_connection((HOST, port), wait_s) as connection:
            connection.sendall(data)
            connection.settimeout(wait_s)
            while block := connection.recv(1 << 16):
                found += block
                if is_whole(found):
                    break
    except OSError:
        pass
    return found


def is_whole(answer: bytes) -> bool:
    """Whether an answer has as many bytes as its head states."""
    head, end, body = answer.partition(b"\r\n\r\n")
    length = re.search(rb"content-length: (\d+)", head.lower())
    return bool(end) and length is not None and len(body) >= int(length[1])


class Client:
    """A client with a number of tasks, as PyODM and ClusterODM do it: parallel files, cuts, and everything again.

    Args:
        port: The node's port.
        seed: Of its random decisions.
    """

    def __init__(self, port: int, seed: int) -> None:
        self._port, self._random = port, random.Random(seed)

    def upload(self, photos: Sequence[tuple[str, bytes]], options: Mapping[str, Any], name: str) -> str:
        """Create a task, upload its photos over connections of which some are cut, and commit it once or twice."""
        given = json.dumps([{"name": key, "value": value} for key, value in options.items()])
        uuid = str(patient(self._port, "POST", "/task/new/init", *form(name=name, options=given))["uuid"])
        path, rest = f"/task/new/upload/{uuid}", list(photos)
        while rest:
            count = self._random.choice((1, 1, 5, len(rest)))
            sent, rest = rest[:count], rest[count:]
            body, headers = form(sent)
            while self._random.random() < 0.3:
                cut_upload(self._port, path, body, headers, self._random.random())
            self._until_success(path, body, headers)
            if self._random.random() < 0.1:  # the answer was lost, and it is sent again
                self._until_success(path, body, headers)
        for _ in range(self._random.choice((1, 1, 2))):
            answer = patient(self._port, "POST", f"/task/new/commit/{uuid}")
            assert answer == {"uuid": uuid}, answer
        return uuid

    def _until_success(self, path: str, body: bytes, headers: Mapping[str, str]) -> None:
        until_s = time.monotonic() + PATIENCE_S
        while True:
            answer = patient(self._port, "POST", path, body, headers)
            if answer.get("success") is True:
                return
            assert time.monotonic() < until_s, answer
            assert "disk is" in answer["error"] or "ended too early" in answer["error"], answer
            time.sleep(self._random.uniform(0.1, 1.0))

    def command(self, name: str, uuid: str) -> dict[str, Any]:
        """Cancel, remove or restart a task."""
        headers = {"Content-Type": "application/x-www-form-urlencoded"}
        found: dict[str, Any] = patient(
            self._port, "POST", f"/task/{name}", urlencode({"uuid": uuid}).encode(), headers
        )
        return found
