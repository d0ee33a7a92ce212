"""Removes this machine's folders from text for pages that go to clients.

A path may reveal the name of a user, a customer or a server. Paths in OUT are shown relative to it, photos relative to
their folder, and of all others only the last component.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SYSTEM = ("dev", "proc", "sys")  # folders identical on every machine, and needed to understand messages about them
# A folder's name in a text. It may have single blanks, unless a path begins after one, and pairs of brackets; what
# remains unclear is taken as part of the path: a word too few is better than a customer's name.
_FOLDER = (
    r"""(?:[^\s/\\"'<>|,;:()\[\]]|\([^()/\\\n]*\)|\[[^\[\]/\\\n]*\]|(?<=\w)'(?=\w)|(?<=\S)[ ](?=\w|[(\[&+#@-]))+"""
)
_FOLDERS = (
    rf"(?<![\w./~-])~?/(?!(?:{'|'.join(SYSTEM)})\b)(?:{_FOLDER}/+)+",  # in the file system, also from ~
    rf"(?<![\w./-])(?:\.\./)+(?:{_FOLDER}/+)*",
    rf"(?<![\w+.-])(?!https?:)[A-Za-z][\w+.-]+://[^\s/]*/*(?:{_FOLDER}/+)*",  # smb://, file://, …
    rf"(?<!\w)[A-Za-z]:[\\/]+(?:{_FOLDER}[\\/]+)*",  # Windows paths with a drive
    rf"(?<![\w\\/])\\\\+{_FOLDER}\\+(?:{_FOLDER}[\\/]+)*",  # a Windows server's
)
_ELSEWHERE = re.compile("|".join(_FOLDERS))


@dataclass(frozen=True)
class PathLabels:
    """Replacements for folders and files that messages may contain; longer paths come first."""

    names: tuple[tuple[str, str], ...]

    @staticmethod
    def of(out: Path, photos: Path | None = None, options: Mapping[str, Any] | None = None) -> PathLabels:
        """The labels for a run.

        Args:
            out: Its results folder.
            photos: Its photo folder, if known.
            options: Its options, by section or not; paths among them are survey files.
        """
        found = {str(path.parent): "" for path in _forms(out)} | {str(path): "OUT" for path in _forms(out)}
        for path in () if photos is None else _forms(photos):
            found[str(path.parent)], found[str(path)] = "", "PHOTOS"
        for value in _strings(options or {}):
            if value.startswith(("/", "~")):
                found[value], found[str(Path(value).parent)] = Path(value).name, ""
        # A folder directly below the root reveals nothing, and its name may be an ordinary word in the text.
        kept = {path: name for path, name in found.items() if path.count("/") > 1}
        return PathLabels(tuple(sorted(kept.items(), key=lambda item: -len(item[0]))))

    def plain(self, text: str) -> str:
        """Remove this machine's folders from a text."""
        if "/" not in text and "\\" not in text:
            return text
        for path, name in self.names:
            replacement = rf"{_escape_backslashes(name)}\1" if name else ""
            text = re.sub(rf"(?<![\w.-]){re.escape(path)}(?![\w-])(/?)", replacement, text)
        return _ELSEWHERE.sub("", text)

    def plain_value(self, value: Any) -> Any:
        """Remove folders from a template's value if it is text; our own markup and other types are unchanged.

        For jinja2's ``finalize``, so that nothing shown is missed.
        """
        return self.plain(value) if type(value) is str else value


def _escape_backslashes(name: str) -> str:
    return name.replace("\\", r"\\")


def _forms(path: Path) -> list[Path]:
    """The path as the user wrote it and resolved, if absolute."""
    return [form for form in (path.absolute(), path.resolve()) if form != Path(form.anchor)]


def _strings(value: Any) -> Iterable[str]:
    if isinstance(value, str):
        return [value]
    if isinstance(value, Mapping):
        return [text for each in value.values() for text in _strings(each)]
    return [text for each in value for text in _strings(each)] if isinstance(value, list | tuple) else []
