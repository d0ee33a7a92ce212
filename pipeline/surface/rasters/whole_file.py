"""Atomic replacement of files that libraries write, even after a kill, without leftovers beside them."""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatpipe.pipeline.engine.durable import sync_folder
from splatpipe.pipeline.engine.output_file import token, write_file

UNFINISHED = ".making"


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path in its own folder; the file is moved to ``path`` once it is complete.

    The folder also holds files that libraries write beside their own (GDAL's temporary overviews). Only one process at
    a time may write a file: unfinished files of another one are removed.

    Args:
        path: Final path; an older file there is replaced.

    Raises:
        OSError: if the disk is full or not writable; what was at ``path`` is still there.
    """
    for left in path.parent.glob(f".{glob.escape(path.name)}.*{UNFINISHED}"):
        shutil.rmtree(left, ignore_errors=True)
    folder = path.with_name(f".{path.name}.{token()}{UNFINISHED}")
    folder.mkdir()
    try:
        aside = folder / path.name
        yield aside
        with aside.open("rb") as file:
            os.fsync(file.fileno())
        aside.replace(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    sync_folder(path.parent)


def write_whole_text(path: Path, text: str) -> None:
    """Write a text as UTF-8 atomically.

    Raises:
        OSError: as ``whole_file``.
    """
    with whole_file(path) as aside:
        write_file(aside, text)
