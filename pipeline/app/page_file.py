"""Pages of one file: a template, a style and perhaps a script, in which names from anywhere stay text."""

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
# Characters that turn what follows.
TURNING = frozenset("\u200e\u200f\u061c\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
UNPRINTABLE = frozenset(("Cc", "Cs", "Cn", "Co", "Zl", "Zp"))  # categories of Unicode
REPLACED = "\ufffd"  # stands for what would be invisible, or turn the text around it


def page_text(
    templates: Path, template: str, places: PathLabels, *, style: str, script: str | None = None, **content: object
) -> str:
    """A page as one HTML text that needs nothing else.

    Args:
        templates: Folder of the template.
        template: Its name; it extends ``page.html.j2``.
        places: Folders of this machine, which the page is not to tell.
        style: Name of the bundled style.
        script: Name of the bundled script; None for a page without one.
        content: What the template fills in. Everything is escaped that is not markup of our own.

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
    return text.encode("utf-8", "replace").decode()  # a file's name may be no UTF-8


def printable(name: object) -> str:
    """A name as people can read it: nothing in it is invisible, breaks its line or turns it around."""
    text = str(name)
    return "".join(REPLACED if unicodedata.category(c) in UNPRINTABLE or c in TURNING else c for c in text)


def one_line(message: object) -> str:
    """A message likewise, in which names may be; its own lines become one."""
    return printable(" ".join(str(message).split()))


def relative_link(path: str) -> Markup:
    """The address of a file beside a page, whatever its name holds; as long as the path is relative, so is this."""
    return Markup("./" + quote(os.fsencode(path), safe="/"))
