"""Reads multipart bodies as they arrive: fields are small, and files go to disk under names that are not final.

Starlette's own parser keeps files in a temporary folder and copies them afterwards. Here a part goes where it belongs,
is hashed on the way, and memory holds at most one block for each connection, whatever is sent.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from email.message import EmailMessage
from typing import Protocol

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser

MAX_FIELD_BYTES = 3 << 20  # options with a boundary
MAX_FIELDS = 32
MAX_HEADERS = 8
MAX_HEADER_BYTES = 4096
BLOCK_BYTES = 1 << 20  # collected before it is written, so that a thread is woken once a megabyte
LEAST_BLOCK_BYTES = 64 << 10
BLOCKS_BYTES = 32 << 20  # of all bodies that are received at once


class BadBodyError(ValueError):
    """A body that is not what it says, or too large; the message is a sentence."""


class Receiver(Protocol):
    """Receives one file: exactly one of ``finish`` and ``discard`` ends it; they and ``write`` run in a thread."""

    def write(self, data: bytes) -> None:
        """Take the next bytes."""

    def finish(self) -> None:
        """Take note that the file is whole."""

    def discard(self) -> None:
        """Forget what was received."""


@dataclass
class Form:
    """The fields of a body, and the number of its files."""

    fields: dict[str, str] = field(default_factory=dict)
    files: int = 0


@dataclass
class _Part:
    """The part of the body that is being read."""

    headers: dict[str, str] = field(default_factory=dict)
    name: str = ""
    file_name: str | None = None
    size: int = 0


Run = Callable[..., Awaitable[object]]
Opener = Callable[[str, Mapping[str, str]], Receiver]


def boundary_of(content_type: str) -> str:
    """The boundary that separates the parts.

    Raises:
        BadBodyError: if the body is not multipart/form-data.
    """
    message = EmailMessage()
    try:
        message["content-type"] = content_type
        boundary = message.get_param("boundary")
        kind = message.get_content_type()
    except (ValueError, IndexError) as error:
        raise BadBodyError("The request's Content-Type cannot be read.") from error
    if kind != "multipart/form-data" or not isinstance(boundary, str) or not 0 < len(boundary) <= 200:
        raise BadBodyError("The request is not multipart/form-data.")
    return boundary


def block_bytes(bodies: int) -> int:
    """How much of each body is collected before it is written, if so many are received at once."""
    return max(LEAST_BLOCK_BYTES, min(BLOCK_BYTES, BLOCKS_BYTES // max(1, bodies)))


async def read_form(
    content_type: str, body: AsyncIterator[bytes], open_file: Opener, run: Run, block_size: int = BLOCK_BYTES
) -> Form:
    """Read a body.

    Args:
        content_type: Its Content-Type header.
        body: Its bytes.
        open_file: Called with a file's name and the fields before it; runs in a thread.
        run: Runs a function in a thread.
        block_size: How much of a file is collected before it is written.

    Raises:
        BadBodyError: if it cannot be parsed, ends too early, or has too many or too large fields.
        Exception: what a receiver raises; files that are not whole are discarded.
    """
    reader = _Reader(boundary_of(content_type))
    form, receiver, block = Form(), None, bytearray()
    try:
        async for chunk in body:
            for kind, part, data in reader.feed(chunk):
                if kind == "begin" and part.file_name is not None:
                    receiver = await run(open_file, part.file_name, form.fields)
                elif kind == "data" and receiver is not None:
                    block += data
                    if len(block) >= block_size:
                        full, block = bytes(block), bytearray()
                        await run(receiver.write, full)  # type: ignore[attr-defined]
                elif kind == "data":
                    block += data
                elif kind == "end" and receiver is not None:
                    whole, receiver, last, block = receiver, None, bytes(block), bytearray()
                    await run(_finish, whole, last)
                    form.files += 1
                elif kind == "end":
                    form.fields[part.name] = block.decode("utf-8", "replace")
                    block = bytearray()
        if not reader.is_complete:
            raise BadBodyError("The request ended too early.")
    finally:
        if receiver is not None:
            await run(receiver.discard)  # type: ignore[attr-defined]
    return form


def _finish(receiver: Receiver, last: bytes) -> None:
    try:
        if last:
            receiver.write(last)
    except BaseException:
        receiver.discard()
        raise
    receiver.finish()


class _Reader:
    """Turns the parser's callbacks into a list of what each chunk contained."""

    def __init__(self, boundary: str) -> None:
        self._found: list[tuple[str, _Part, bytes]] = []
        self._part = _Part()
        self._header, self._value = bytearray(), bytearray()
        self._fields = 0
        self.is_complete = False
        callbacks = {
            "on_part_begin": self._begin,
            "on_part_data": self._data,
            "on_part_end": self._end,
            "on_header_field": lambda data, start, end: self._header.extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._value.extend(data[start:end]),
            "on_header_end": self._header_end,
            "on_headers_finished": self._headers_end,
            "on_end": self._complete,
        }
        self._parser = MultipartParser(
            boundary,
            callbacks,  # type: ignore[arg-type]
            max_header_count=MAX_HEADERS,
            max_header_size=MAX_HEADER_BYTES,
        )

    def feed(self, chunk: bytes) -> list[tuple[str, _Part, bytes]]:
        """What a chunk of the body contains."""
        self._found = []
        try:
            self._parser.write(chunk)
        except (FormParserError, UnicodeError, ValueError) as error:
            if isinstance(error, BadBodyError):
                raise
            raise BadBodyError("The request's multipart body cannot be read.") from error
        return self._found

    def _begin(self) -> None:
        self._part = _Part()

    def _header_end(self) -> None:
        name = self._header.decode("latin-1").strip().lower()
        self._part.headers[name] = self._value.decode("utf-8", "replace")
        self._header, self._value = bytearray(), bytearray()

    def _headers_end(self) -> None:
        self._part.name, self._part.file_name = disposition(self._part.headers.get("content-disposition", ""))
        if self._part.file_name is None:
            self._fields += 1
            if self._fields > MAX_FIELDS:
                raise BadBodyError(f"The request has more than {MAX_FIELDS} fields.")
        self._found.append(("begin", self._part, b""))

    def _data(self, data: bytes, start: int, end: int) -> None:
        self._part.size += end - start
        if self._part.file_name is None and self._part.size > MAX_FIELD_BYTES:
            raise BadBodyError(f'The field "{self._part.name[:40]}" is too long.')
        self._found.append(("data", self._part, data[start:end]))

    def _end(self) -> None:
        self._found.append(("end", self._part, b""))

    def _complete(self) -> None:
        self.is_complete = True


def disposition(header: str) -> tuple[str, str | None]:
    """The name of a part's field, and of its file; None for a part that is no file.

    Browsers write ``%22`` for a quote within a name, and other clients a backslash before it (WHATWG; RFC 7578, 4.2);
    ``filename*`` has the name in UTF-8 (RFC 5987). A backslash before another character is one: Windows wrote paths.
    """
    values: dict[str, str] = {}
    rest = header.partition(";")[2]
    while rest:
        key, sign, rest = rest.partition("=")
        if not sign:
            break
        rest = rest.lstrip()
        if rest.startswith('"'):
            value, rest = _quoted(rest[1:])
        else:
            value, _, rest = rest.partition(";")
            values.setdefault(key.strip(" ;\t").lower(), value.strip())
            continue
        values.setdefault(key.strip(" ;\t").lower(), value)
        rest = rest.partition(";")[2]
    name = values.get("name", "")
    if "filename*" in values:
        from urllib.parse import unquote

        charset, _, text = values["filename*"].partition("'")
        if charset.lower() == "utf-8":
            return name, unquote(text.partition("'")[2])
    file_name = values.get("filename")
    return name, None if file_name is None else file_name.replace("%22", '"')


def _quoted(text: str) -> tuple[str, str]:
    value: list[str] = []
    at = 0
    while at < len(text):
        letter = text[at]
        if letter == "\\" and text[at + 1 : at + 2] == '"':
            value.append('"')
            at += 2
            continue
        if letter == '"':
            return "".join(value), text[at + 1 :]
        value.append(letter)
        at += 1
    return "".join(value), ""
