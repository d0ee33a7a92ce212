"""The one way to start a Python process of our own."""

from __future__ import annotations

import sys

SAFE_PATH = {"PYTHONSAFEPATH": "1"}  # for the environment of other people's programs that start Python themselves


def python_module(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module with this interpreter.

    The current folder is not on the child's path (``-P``): in a folder of photos, ``numpy.py`` would be run instead of
    the library.
    """
    return [sys.executable, "-P", "-m", module, *arguments]
