"""Pictures of the last report, kept in OUT with what they were drawn from, so that the next draws only what changed.

Drawing is most of a report's work, and after most commands nearly all of its pictures are as before. A picture is used
again only if everything it is drawn from is the same, our code and the libraries that draw included. The file may be
damaged or somebody else's: whatever in it is not as we would have written it is drawn again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from splatpipe.pipeline.app.report import PICTURES_FILE
from splatpipe.pipeline.app.report.charts.picture_check import is_plain_picture
from splatpipe.pipeline.app.report.facts.picture_sources import code_digest
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import parse_json, read_json
from splatpipe.pipeline.engine.files.output_file import own_folder

MAX_BYTES = 64 << 20  # several times the largest report
PICTURE = "picture"  # the only key of an object that stands for a picture
KEY, CONTENT, DIGEST = "key", "content", "digest"

Keep = Callable[[str, Any, Callable[[], Any]], Any]


def draw_now(_name: str, _facts: Any, draw: Callable[[], Any]) -> Any:
    """A ``Keep`` that keeps nothing: it draws."""
    return draw()


class Gallery:
    """The pictures of a run's report.

    Args:
        out: The run's folder.
        kept: The entries of its file by name, of which nothing is known yet.
    """

    def __init__(self, out: Path, kept: Mapping[str, Any]) -> None:
        self._out, self._kept = out, kept
        self._entries: dict[str, Mapping[str, str]] = {}
        self._code = code_digest()
        self.reused: list[str] = []

    @classmethod
    def read(cls, out: Path) -> Gallery:
        """The gallery that the last report left in OUT; empty if there is none or it cannot be read."""
        try:
            found = read_json(out / PICTURES_FILE, MAX_BYTES)
        except (OSError, ValueError):
            found = None
        return cls(out, found if isinstance(found, dict) else {})

    def keep(self, name: str, facts: Any, draw: Callable[[], Any]) -> Any:
        """Return what ``draw`` returns, or did for the same facts.

        Args:
            name: The entry's name.
            facts: All that it is drawn from, as JSON.
            draw: Draws it: lists, mappings, dataclasses, texts, numbers; pictures are ``Markup``.

        Returns:
            Its plain lists and dictionaries, in which dataclasses have become dictionaries.
        """
        text = json.dumps([self._code, name, facts], sort_keys=True, default=str)
        key = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
        entry = self._kept.get(name)
        with suppress(ValueError, TypeError, KeyError, RecursionError):
            if entry is not None and entry[KEY] == key and entry[DIGEST] == _digest(content := entry[CONTENT]):
                drawn = _with_pictures(parse_json(content.encode()))
                self._entries[name] = {part: entry[part] for part in (KEY, DIGEST, CONTENT)}
                self.reused.append(name)
                return drawn
        plain = _without_pictures(draw())
        content = json.dumps(plain)
        self._entries[name] = {KEY: key, DIGEST: _digest(content), CONTENT: content}
        return _with_pictures(json.loads(content))

    def write(self) -> None:
        """Keep what this report shows in OUT, and nothing else; without room for it, the next report is drawn anew."""
        if self._entries == self._kept:
            return
        text = json.dumps(self._entries)
        if len(text) <= MAX_BYTES:
            with suppress(OSError, SplatpipeError):
                write_durably(own_folder(self._out, PICTURES_FILE.parent) / PICTURES_FILE.name, text)


def _digest(content: str) -> str:
    if not isinstance(content, str):
        raise TypeError("not a text")
    return hashlib.sha256(content.encode()).hexdigest()


def _without_pictures(value: Any) -> Any:
    """A value as JSON can say it: a picture is an object with only that key."""
    if isinstance(value, Markup):
        return {PICTURE: str(value)}
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _without_pictures(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        assert set(value) != {PICTURE}, "it would be read as a picture"
        return {str(key): _without_pictures(each) for key, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_without_pictures(each) for each in value]
    return value


def _with_pictures(value: Any) -> Any:
    """The inverse, but that sequences are lists and dataclasses dictionaries.

    Raises:
        ValueError: if a picture is not one.
    """
    if isinstance(value, dict):
        if set(value) != {PICTURE}:
            return {key: _with_pictures(each) for key, each in value.items()}
        markup = value[PICTURE]
        if not isinstance(markup, str) or not is_plain_picture(markup):
            raise ValueError("not a picture")
        return Markup(markup)
    return [_with_pictures(each) for each in value] if isinstance(value, list) else value
