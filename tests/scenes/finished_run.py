"""Copies of a finished run, and whether it is still what it was."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

WRITTEN_INTO = ("events.jsonl", "splatpipe.log", ".lock")  # a run appends to these
DATABASE = ".db"  # opened for writing even by those who only read


def linked_copy(run: Path, target: Path) -> Path:
    """Copy a run so that it can be continued: files are hard links unless a run writes into them."""

    def copy(source: str, place: str) -> None:
        path = Path(source)
        (shutil.copy2 if path.name in WRITTEN_INTO or path.suffix == DATABASE else os.link)(source, place)

    return Path(shutil.copytree(run, target, copy_function=copy))


def write_apart(path: Path, text: str) -> None:
    """Write a file of a linked copy, and leave the file that it was linked to."""
    path.unlink()
    path.write_text(text, encoding="utf-8")


def folder_digest(folder: Path) -> str:
    """Return the sha256 (hex) of the names and contents of all files below a folder."""
    total = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            with path.open("rb") as file:
                total.update(f"{path.relative_to(folder)} {hashlib.file_digest(file, 'sha256').hexdigest()}\n".encode())
    return total.hexdigest()
