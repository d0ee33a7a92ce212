"""Multipart bodies as clients, browsers and attackers send them."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpipe.pipeline.app.node.api import multipart
from splatpipe.pipeline.app.node.api.multipart import BadBodyError, Form, block_bytes, disposition, read_form

KIND = "multipart/form-data; boundary=xyz"


class Kept:
    """Receives a file into memory."""

    def __init__(self, files: dict[str, bytes | None], name: str) -> None:
        self.files, self.name, self.content = files, name, b""

    def write(self, data: bytes) -> None:
        self.content += data

    def finish(self) -> None:
        self.files[self.name] = self.content

    def discard(self) -> None:
        self.files[self.name] = None


def _read(body: bytes, kind: str = KIND, pieces: int = 0, block: int = 10) -> tuple[Form, dict[str, bytes | None]]:
    files: dict[str, bytes | None] = {}

    async def chunks() -> AsyncIterator[bytes]:
        step = pieces or len(body) or 1
        for at in range(0, len(body), step):
            yield body[at : at + step]

    async def run(function: Any, *arguments: Any) -> Any:
        return function(*arguments)

    def open_file(name: str, _fields: Mapping[str, str]) -> Kept:
        return Kept(files, name)

    return asyncio.run(read_form(kind, chunks(), open_file, run, block)), files


def _part(head: str, content: bytes) -> bytes:
    return f"--xyz\r\nContent-Disposition: form-data; {head}\r\n\r\n".encode() + content + b"\r\n"


BODY = (
    _part('name="name"', "Straße 5".encode())
    + _part('name="images"; filename="a.jpg"', b"\xff\xd8 \r\n--xy\r\n" * 20)
    + _part('name="images"; filename="b.jpg"', b"")
    + b"--xyz--\r\n"
)


@pytest.mark.parametrize("pieces", [0, 1, 2, 7, 64])
def test_a_body_is_read_the_same_however_it_is_cut(pieces: int) -> None:
    form, files = _read(BODY, pieces=pieces)
    assert form == Form({"name": "Straße 5"}, 2)
    assert files == {"a.jpg": b"\xff\xd8 \r\n--xy\r\n" * 20, "b.jpg": b""}


@pytest.mark.parametrize("kept", [5, 60, 150, len(BODY) - 12])
def test_a_body_that_ends_too_early_leaves_no_file_that_is_not_whole(kept: int) -> None:
    files: dict[str, bytes | None] = {}
    with pytest.raises(BadBodyError):
        _, files = _read(BODY[:kept])
    assert None not in files.values()


@pytest.mark.parametrize(
    ("header", "name"),
    [
        ('form-data; name="images"; filename="a b.jpg"', "a b.jpg"),
        ("form-data; name=images; filename=a.jpg", "a.jpg"),
        ('form-data; filename="a;b.jpg"; name="images"', "a;b.jpg"),
        ('form-data; name="images"; filename="a\\"b.jpg"', 'a"b.jpg'),
        ('form-data; name="images"; filename="a%22b.jpg"', 'a"b.jpg'),
        ('form-data; name="images"; filename="C:\\photos\\a.jpg"', "C:\\photos\\a.jpg"),
        ('form-data; name="images"; filename="a.jpg"; filename*=UTF-8\'\'%C3%A4.jpg', "ä.jpg"),
        ('form-data; name="images"', None),
        ("form-data", None),
        ("", None),
    ],
)
def test_names_of_files_are_read_as_clients_write_them(header: str, name: str | None) -> None:
    assert disposition(header)[1] == name


@pytest.mark.parametrize(
    "kind", ["", "multipart/form-data", "multipart/form-data; boundary=", "text/plain; boundary=xyz", "x" * 5000]
)
def test_a_body_of_another_kind_is_refused(kind: str) -> None:
    with pytest.raises(BadBodyError):
        _read(BODY, kind)


def test_fields_and_headers_have_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadBodyError):
        _read(_part('name="a"', b"x") * (multipart.MAX_FIELDS + 1) + b"--xyz--\r\n")
    with pytest.raises(BadBodyError):
        _read(_part(f'name="{"a" * 10_000}"', b"x") + b"--xyz--\r\n")
    with pytest.raises(BadBodyError):
        _read(b"--xyz\r\n" + b"x-a: 1\r\n" * 50 + b"\r\nx\r\n--xyz--\r\n")
    monkeypatch.setattr(multipart, "MAX_FIELD_BYTES", 100)
    with pytest.raises(BadBodyError):
        _read(_part('name="a"', b"x" * 101) + b"--xyz--\r\n")


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300), st.integers(1, 50))
def test_no_body_does_anything_but_be_read_or_refused(body: bytes, pieces: int) -> None:
    for prefix in (b"", b"--xyz\r\n", b"--xyz\r\nContent-Disposition: form-data; name=a; filename=b\r\n\r\n"):
        with suppress(BadBodyError):
            _read(prefix + body, pieces=pieces)


def test_memory_of_many_uploads_is_bounded() -> None:
    assert block_bytes(1) == multipart.BLOCK_BYTES
    assert 500 * block_bytes(500) <= 32 << 20
