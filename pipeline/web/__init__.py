"""The scripts and styles of the pages: src/ is bundled into dist/ when splatpipe is built (build.py)."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.errors import MachineError

DIST = Path(__file__).resolve().parent / "dist"


def asset(name: str) -> str:
    """The text of a bundled script or style, e.g. ``viewer.js``.

    Raises:
        MachineError: if this installation was built without it.
    """
    try:
        return (DIST / name).read_text(encoding="utf-8")
    except OSError as error:
        raise MachineError(
            f"This installation of splatpipe lacks {name}.", hint="Build it again: make, or pip install of the sources."
        ) from error


def script_safe(text: str) -> str:
    """Escape JSON so that it cannot end the script element that contains it."""
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
