"""The lines of a text file of the user's."""

from __future__ import annotations

import re


def text_lines(text: str) -> list[str]:
    """Split a text at ``\\n`` and ``\\r\\n`` only.

    ``str.splitlines`` also splits at U+0085, U+2028 and others, which a name may contain. A text without any ``\\n`` is
    split at ``\\r``: spreadsheets on a Mac still offer that. Anywhere else a ``\\r`` stays in its line.
    """
    lines = re.split(r"\r*\n", text) if "\n" in text else text.split("\r")
    return lines if lines[-1] else lines[:-1]
