"""The cheap part of the preflight, with which every run begins: files that would end it only hours later."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatpipe.pipeline.engine.session import Request


def require_readable(request: Request) -> None:
    """Read the surveyor's files as georef will, and tell now what is wrong with them.

    Raises:
        SplatpipeError: if the control file, the scale bars or the boundary cannot be read.
    """
    from splatpipe.pipeline.engine.source import open_source

    source = open_source(request.photos, request.out, request.stages, request.config)
    readers = {
        "source.control": _read_control,
        "source.scale_bars": _read_scale_bars,
        "source.boundary": _read_boundary,
    }
    for part, read in readers.items():
        path = source.part_path(part) if part in source.named else None
        if path is not None and path.is_file():
            read(path)


def _read_control(path: Path) -> None:
    from splatpipe.pipeline.survey.control_file import read_control_file
    from splatpipe.pipeline.survey.crs import parse_crs

    parse_crs(read_control_file(path).crs)


def _read_scale_bars(path: Path) -> None:
    from splatpipe.pipeline.survey.scale_bars import read_scale_bars

    read_scale_bars(path)


def _read_boundary(path: Path) -> None:
    from splatpipe.pipeline.survey.boundary_file import read_boundary

    read_boundary(path)
