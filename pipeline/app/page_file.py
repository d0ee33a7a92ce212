"""Single-file HTML pages: a template, a style and optionally a script; untrusted names are escaped."""

from __future__ import annotations

import base64
import hashlib
import os
import unicodedata
from pathlib import Path
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.web import asset

SHARED = Path(__file__).resolve().parent / "templates"
# Bidirectional control characters, which reverse the text that follows.
TURNING = frozenset("\u200e\u200f\u061c\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
UNPRINTABLE = frozenset(("Cc", "Cs", "Cn", "Co", "Zl", "Zp"))  # Unicode categories
REPLACEMENT = "\ufffd"  # replaces invisible and bidirectional control characters


def page_text(
    templates: Path, template: str, places: PathLabels, *, style: str, script: str | None = None, **content: object
) -> str:
    """Render a page as one self-contained HTML text.

    Args:
        templates: Folder of the template.
        template: Its name; it extends ``page.html.j2``.
        places: Folders of this machine, which the page must not reveal.
        style: Name of the bundled style.
        script: Name of the bundled script; None for a page without one.
        content: Values for the template. Everything is escaped except our own markup.

    Raises:
        MachineError: if this installation lacks the script or the style.
    """
    environment = Environment(
        loader=FileSystemLoader([templates, SHARED]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=places.plain_value,
    )
    environment.filters |= {"printable": printable, "one_line": one_line}
    code = asset(script).replace("</", "<\\/") if script else ""
    text = environment.get_template(template).render(
        style=Markup(asset(style).replace("</", "<\\/")),
        script=Markup(code),
        script_hash=base64.b64encode(hashlib.sha256(code.encode()).digest()).decode(),
        **content,
    )
    return text.encode("utf-8", "replace").decode()  # a file name may not be valid UTF-8


def printable(name: object) -> str:
    """A name safe to display: without invisible characters, line breaks and bidirectional controls."""
    text = str(name)
    return "".join(REPLACEMENT if unicodedata.category(c) in UNPRINTABLE or c in TURNING else c for c in text)


def one_line(message: object) -> str:
    """The same for a message that may contain names; its lines are joined into one."""
    return printable(" ".join(str(message).split()))


def relative_link(path: str) -> Markup:
    """The escaped URL of a file beside a page; relative if the path is."""
    return Markup("./" + quote(os.fsencode(path), safe="/"))
