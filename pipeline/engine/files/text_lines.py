"""The lines of a text file of the user's."""

from __future__ import annotations

import codecs
import io
import re
from pathlib import Path
from typing import TextIO

from splatpipe.pipeline.engine.files.small_file import open_regular

BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def text_lines(text: str) -> list[str]:
    """Split a text at ``\\n`` and ``\\r\\n`` only.

    ``str.splitlines`` also splits at U+0085, U+2028 and others, which a name may contain. A text without any ``\\n`` is
    split at ``\\r``: spreadsheets on a Mac still offer that. Anywhere else a ``\\r`` stays in its line.
    """
    lines = re.split(r"\r*\n", text) if "\n" in text else text.split("\r")
    return lines if lines[-1] else lines[:-1]


def open_text(path: Path) -> TextIO:
    """Open a text file of any size: UTF-8, or what its byte order mark says.

    Lines end with ``\\n``. Bytes that are not UTF-8 are kept as surrogates (``surrogateescape``).

    Raises:
        OSError: if it cannot be opened or is not a regular file.
    """
    return io.TextIOWrapper(open_regular(path), encoding_of(path) or "utf-8", "surrogateescape", newline="\n")


def encoding_of(path: Path) -> str:
    """Python's name of the encoding that a file's byte order mark states; empty for a file without one."""
    with open_regular(path) as file:
        head = file.read(max(map(len, BOMS)))
    return next((encoding for mark, encoding in BOMS.items() if head.startswith(mark)), "")
