"""Sections and volumes of a finished run's surface model, into OUT/sections and OUT/volumes.json."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.run_folder import open_run_folder
from splatpipe.stages.line import DEPTHS, DSM, GEOREF, LINE, UNDISTORT

SECTIONS = "sections"
VOLUMES = "volumes.json"
MOST_SECTIONS = 100
Base = Literal["rim", "lowest"] | float
Line = tuple[float, float, float, float]


@dataclass(frozen=True)
class Wanted:
    """What is to be measured.

    Attributes:
        lines: Of sections, the run's CRS.
        polygons: A GeoJSON file to measure volumes in; None for none.
        base: Of volumes: ``rim``, ``lowest``, or a height in the CRS's unit.
    """

    lines: tuple[Line, ...]
    polygons: Path | None
    base: Base

    @property
    def anything(self) -> bool:
        """Whether there is anything to do."""
        return bool(self.lines) or self.polygons is not None

    @staticmethod
    def of(sections: Sequence[str], polygons: Path | None, base: str) -> Wanted:
        """As it stands on a command line.

        Raises:
            UsageError: if a section is no line, or the base none.
        """
        if len(sections) > MOST_SECTIONS:
            raise UsageError(f"{len(sections)} sections are too many.", hint=f"At most {MOST_SECTIONS} at a time.")
        height = _number(base)
        if height is None and base not in ("rim", "lowest"):
            raise UsageError(f'There is no base "{base[:40]}".', hint="Choose rim, lowest, or a height.")
        plane: Base = height if height is not None else "rim" if base == "rim" else "lowest"
        return Wanted(tuple(_line(text) for text in sections), polygons, plane)


def _line(text: str) -> Line:
    numbers = [_number(part) for part in text.split(",")[:5]]
    if len(numbers) != 4 or None in numbers:
        raise UsageError(f'Cannot understand --section "{text[:60]}".', hint="Write it as --section X1,Y1,X2,Y2.")
    x1, y1, x2, y2 = (number for number in numbers if number is not None)
    return x1, y1, x2, y2


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def measure_surface(out: Path, wanted: Wanted, threads: int) -> dict[str, Any]:
    """Cut sections and measure volumes.

    Args:
        out: OUT, of a run with a surface model.
        wanted: What.
        threads: Photos at a time.

    Returns:
        What the files tell, for programs.

    Raises:
        SplatpipeError: if there is no surface model, or a line or a polygon misses it.
    """
    from splatpipe.pipeline.mvs.depth_maps import kept_depth_maps
    from splatpipe.pipeline.photos.dataset import load_views
    from splatpipe.pipeline.surface.map_crs import open_map
    from splatpipe.pipeline.surface.run_sources import metric_depths
    from splatpipe.pipeline.surface.section_files import write_section
    from splatpipe.pipeline.surface.sections import cut_section
    from splatpipe.pipeline.surface.surface_file import open_surface
    from splatpipe.pipeline.surface.volume_file import write_volumes
    from splatpipe.pipeline.survey.boundary import placed_area
    from splatpipe.pipeline.survey.boundary_file import read_boundary
    from splatpipe.pipeline.survey.frames import load_frame

    parts = {
        name: part.path for name, part in open_run_folder(out, LINE).lineage(DSM, DEPTHS, UNDISTORT, GEOREF).items()
    }
    files = parts.get("dsm.files")
    if files is None or not (files / "dsm.tif").is_file():
        raise SplatpipeError("The run has no surface model.", hint=f"Make it first: splatpipe surface {out}")
    frame = load_frame(parts["georef.frame"])
    crs, model = open_map(frame), open_surface(files / "dsm.tif", files / "dsm_confidence.tif")
    told: dict[str, Any] = {}
    if wanted.lines:
        folder = out / SECTIONS
        folder.mkdir(exist_ok=True)
        maps = kept_depth_maps(parts["depths.maps"], load_views(parts["undistort.dataset"]))
        sources = metric_depths(maps, frame.world_from_model)
        told["sections"] = [
            write_section(folder, f"section-{number}", cut_section(model, line, crs, sources, threads), crs)
            for number, line in enumerate(wanted.lines, 1)
        ]
    if wanted.polygons is not None:
        area = placed_area(read_boundary(wanted.polygons), frame)
        told["volumes"] = write_volumes(out / VOLUMES, model, area, crs, wanted.base)
    return told
