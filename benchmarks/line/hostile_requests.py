"""Requests that nobody honest sends: paths, heads, bodies, zips, tokens, sizes. Each has to be refused."""

from __future__ import annotations

import io
import json
import random
import stat
import zipfile
from collections.abc import Iterator
from uuid import uuid4

from node_clients import BOUNDARY, form

PATHS = (
    *("/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/task/../../etc/passwd", "/.git/config"),
    *(
        "/task/{uuid}/download/..%2f..%2ftask.json",
        "/task/{uuid}/download/task.json",
        "/task/{uuid}/download/../task.json",
    ),
    *("/task/%00/info", "/task/{uuid}%0d%0aX: y/info", "/task/{uuid}/download/all.zip/../../x", "\\windows\\win.ini"),
    *("/task/{uuid}/output/../info", "/" + "a/" * 300, "/" + "%41" * 200, "/~root/", "/task/'; rm -rf /;'/info"),
    *("/results/x/y/../../etc/passwd", "/page/x/api/state", "/page/x/api/new", "/page/../info"),
)
HEADS = (
    "GET /info HTTP/1.1\r\nHost: rebound.example\r\n\r\n",
    "GET /info HTTP/1.1\r\n\r\n",
    "GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n",
    "GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://evil.example\r\n\r\n",
    "GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: null\r\n\r\n",
    "GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\nSec-Fetch-Site: cross-site\r\n\r\n",
    "GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 5\r\n\r\nhello",
    "GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + "a" * 100_000 + "\r\n\r\n",
    "GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\n" + "X: y\r\n" * 20_000 + "\r\n",
    "GET /info HTTP/9.9\r\nHost: 127.0.0.1\r\n\r\n",
    "PUT /info HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\n\r\n",
    "DELETE /task/list HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    "TRACE / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    "CONNECT evil.example:80 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    "GET http://evil.example/ HTTP/1.1\r\nHost: evil.example\r\n\r\n",
    "POST /task/cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    "POST /task/cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\nab",
    "POST /task/cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n",
    "POST /task/cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffffffff\r\n",
    "POST /task/cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://evil.example\r\nContent-Length: 0\r\n\r\n",
    "POST /task/new/init HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999999999999999\r\n\r\n",
    "GET /info?" + "a" * 8000 + " HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    "\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
    "\0" * 1000,
    "SSH-2.0-OpenSSH_9.2\r\n",
)
NAMES = ("../../a.jpg/", "..", ".ssh", "a\0.jpg", "a" * 300 + ".jpg", "ä" * 150, "/", "photos/.")
OPTIONS = (
    *("{", "[3]", "null", '[{"name": "preset", "value": "x; rm -rf /"}]', '[{"name": "mesh-size", "value": "1e999"}]'),
    *("[" * 50_000, '[{"name": "boundary", "value": "$(id)"}]', '[{"name": "crs", "value": "' + "x" * 600 + '"}]'),
    *('[{"name": "time-budget", "value": "-1h"}]', '[{"name": "orthophoto-resolution", "value": -1}]'),
    *('[{"name": "check-points", "value": "a\\u0000b"}]', '[{"name": "mesh-size", "value": 1' + "0" * 400 + "}]"),
)
FIELDS = (
    {"zipurl": "http://169.254.169.254/latest/meta-data"},
    {"zipurl": "file:///etc/passwd"},
    {"zipurl": "http://127.0.0.1:22/"},
    {"webhook": "http://localhost/admin"},
    {"webhook": "gopher://evil.example/"},
    {"outputs": '["../../../../etc/passwd"]'},
    {"outputs": '["/etc/passwd"]'},
    {"outputs": "[" * 10_000},
    *({f"field{number}": "x" for number in range(count)} for count in (33, 500)),
    {"name": "x" * (4 << 20)},
)
BODIES = (
    b"",
    b"not multipart",
    b"--" + BOUNDARY.encode(),
    b"--" + BOUNDARY.encode() + b"\r\n" + b"a: b\r\n" * 1000,
    b"--" + BOUNDARY.encode() + b"\r\nContent-Disposition: " + b"x" * 100_000,
    b"\r\n--" * 50_000,
)


def requests(count: int, uuid: str, seed: int) -> Iterator[bytes]:
    """Yield hostile requests, each of every kind before any kind is repeated with other random parts.

    Args:
        count: How many.
        uuid: A task that is there, and must be as before afterwards.
        seed: Of the random parts.
    """
    chance = random.Random(seed)
    made = 0
    while made < count:
        for data in (*_plain(uuid), *_forms(uuid, chance), *_commands(uuid, chance), *_noise(chance)):
            yield data
            made += 1
            if made == count:
                return


def _plain(uuid: str) -> Iterator[bytes]:
    for path in PATHS:
        yield f"GET {path.replace('{uuid}', uuid)} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
    for head in HEADS:
        yield head.encode("latin-1")


def _forms(uuid: str, chance: random.Random) -> Iterator[bytes]:
    for name in NAMES:
        yield _post(f"/task/new/upload/{uuid}", *form([(name, chance.randbytes(100))]))
    for options in OPTIONS:
        yield _post("/task/new/init", *form(options=options))
        yield _post("/task/new", *form([("a.jpg", b"x")], options=options))
    for fields in FIELDS:
        yield _post("/task/new/init", *form(**fields))
    for body in BODIES:
        kind = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
        yield _post(f"/task/new/upload/{uuid}", body, kind)
        yield _post("/task/new", body, {"Content-Type": "multipart/form-data"})
    for wrong in ("../../x", "x", str(uuid4()) + "0", uuid):
        yield _post("/task/new/init", *form(), **{"Set-Uuid": wrong})
    yield _post(f"/task/new/upload/{uuid4()}", *form([("a.jpg", b"x")]))


def _commands(uuid: str, chance: random.Random) -> Iterator[bytes]:
    for name in ("cancel", "remove", "restart"):
        for value in ("", "x", "../" + uuid, uuid + "/", "\u0000", "a" * 10_000, str(chance.random())):
            yield _post(f"/task/{name}", json.dumps({"uuid": value}).encode(), {"Content-Type": "application/json"})
        for body in (b"{", b"[]", b"\xff\xfe", b"uuid[]=1&" * 100, b"[" * 100_000, b'{"uuid": {"a": 1}}'):
            yield _post(f"/task/{name}", body, {"Content-Type": "application/json"})


def _noise(chance: random.Random) -> Iterator[bytes]:
    for _ in range(5):
        yield chance.randbytes(chance.randrange(1, 2000))


def _post(path: str, body: bytes, headers: dict[str, str], **more: str) -> bytes:
    lines = [f"POST {path} HTTP/1.1", "Host: 127.0.0.1", f"Content-Length: {len(body)}"]
    lines += [f"{name}: {value}" for name, value in {**headers, **more}.items()]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


def hostile_zips() -> Iterator[tuple[str, bytes]]:
    """Yield zips that must not be unpacked, with what is wrong with each."""

    def made(*entries: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", method) as archive:
            for name, content in entries:
                archive.writestr(name, content)
        return file.getvalue()

    link = zipfile.ZipInfo("a.jpg")
    link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    yield "no photos", made(("../../escape.txt", b"x"))
    yield "a bomb", made(("a.jpg", bytes(50_000_000)))
    yield "a link", made((link, b"/etc/passwd"))
    yield "another method", made(("a.jpg", b"x"), method=zipfile.ZIP_LZMA)
    yield "cut", made(("a.jpg", b"x" * 1000))[:-30]
    yield "no zip", b"<html>"
    yield "one name twice", made(("a/x.jpg", b"1"), ("b/x.jpg", b"2"))
