"""Text for pages that go to clients: without the folders of the machine that made them.

A path tells a user's name, a customer's, a server's. What lies in OUT is named from there, photos from their folder,
and of all else only the last name stays.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SYSTEM = ("dev", "proc", "sys")  # the same on every machine, and what a message on them is about
_END = r"\s\"'<>|,;:()\[\]"
_ELSEWHERE = re.compile(rf"(?<![\w./~-])(?:file://)?~?/(?!(?:{'|'.join(SYSTEM)})\b)(?:[^/{_END}]+/)+([^/{_END}]*)")
_BESIDE = re.compile(rf"(?<![\w./-])(?:\.\./)+(?:[^/{_END}]+/)*([^/{_END}]+)")


@dataclass(frozen=True)
class PathLabels:
    """Folders and files that messages may name, with what they are called instead; longer ones come first."""

    names: tuple[tuple[str, str], ...]

    @staticmethod
    def of(out: Path, photos: Path | None = None, options: Mapping[str, Any] | None = None) -> PathLabels:
        """Those of a run.

        Args:
            out: Its folder of results.
            photos: Its folder of photos, if anybody knows.
            options: Its options, sections of them or not; paths among them are those of a surveyor's files.
        """
        found = {str(path.parent): "" for path in _forms(out)} | {str(path): "OUT" for path in _forms(out)}
        for path in () if photos is None else _forms(photos):
            found[str(path.parent)], found[str(path)] = "", "PHOTOS"
        for value in _strings(options or {}):
            if value.startswith(("/", "~")):
                found[value], found[str(Path(value).parent)] = Path(value).name, ""
        # A folder right below the root tells nothing, and its name may be a word of the text.
        kept = {path: name for path, name in found.items() if path.count("/") > 1}
        return PathLabels(tuple(sorted(kept.items(), key=lambda item: -len(item[0]))))

    def plain(self, text: str) -> str:
        """A text without folders of this machine."""
        if "/" not in text:
            return text
        for path, name in self.names:
            shown = rf"{_escaped(name)}\1" if name else ""
            text = re.sub(rf"(?<![\w.-]){re.escape(path)}(?![\w-])(/?)", shown, text)
        return _BESIDE.sub(r"\1", _ELSEWHERE.sub(r"\1", text))

    def plain_value(self, value: Any) -> Any:
        """What a template is about to show: a text without folders; markup of ours and all else as it is.

        For jinja2's ``finalize``, so that nothing that is shown can be forgotten.
        """
        return self.plain(value) if type(value) is str else value


def _escaped(name: str) -> str:
    return name.replace("\\", r"\\")


def _forms(path: Path) -> list[Path]:
    """As the user wrote it and as it is, where that is absolute."""
    return [form for form in (path.absolute(), path.resolve()) if form != Path(form.anchor)]


def _strings(value: Any) -> Iterable[str]:
    if isinstance(value, str):
        return [value]
    if isinstance(value, Mapping):
        return [text for each in value.values() for text in _strings(each)]
    return [text for each in value for text in _strings(each)] if isinstance(value, list | tuple) else []
