"""Adds measurements on the surface model to OUT/viewer.html and OUT/web/index.html.

The stage `export` writes the page before there is a surface model, and sections can be cut on a finished run at any
time. So measurements are put into the copy of the page in OUT; the artifact itself is unchanged. The page keeps its
mtime, so that the store still recognises it as that copy (``is_copy``), and the same state gives the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from splatpipe.pipeline.app.measurements import has_measurements, is_number, read_measurements, title_of
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.output_file import is_inside
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.web.measured_page import PAGE, SITE_PAGE, with_measurements

SECTION_FIGURES = ("length_m", "share_with_height")
VOLUME_FIGURES = ("cut_m3", "cut_sigma_m3", "fill_m3", "fill_sigma_m3", "net_m3", "net_sigma_m3", "area_m2")
PLACES = ("x", "y", "z")
PROFILE, POINTS = ("distance", "height", "sigma", *PLACES), ("point_distance", "point_height")
MAX_COORDINATE_M = 1e9  # metres: larger coordinates are not on the earth, and a chart's steps are lost in rounding


def update_viewer(out: Path) -> str:
    """Update the viewers in OUT to show exactly the measurements that are still valid.

    Only the holder of OUT's lock may call this.

    Args:
        out: OUT.

    Returns:
        A warning for the user; empty if all is well or there is nothing to do.

    Raises:
        OSError: if the disk is full or not writable; each page is either unchanged or updated.
    """
    own = [name for name in (PAGE, SITE_PAGE) if is_inside(out, Path(name)) and not (out / name).is_symlink()]
    pages = [name for name in own if (out / name).is_file()]
    if not pages or not has_measurements(out):
        return ""
    measurements, trouble = displayed_measurements(out), ""
    for name in pages:
        try:
            _update(out / name, measurements)
        except ValueError:
            trouble = (
                f"{name} was written by an earlier version and cannot show measurements; update it with: "
                f"splatpipe stage export {out}"
            )
    return trouble


def _update(path: Path, measurements: Mapping[str, Any] | None) -> None:
    """Put measurements into a page without changing its mtime; a page that already shows them is left alone."""
    page = path.read_bytes()
    updated = with_measurements(page, measurements)
    if updated == page:
        return
    stamp = path.stat()

    def fill(file: IO[bytes]) -> None:
        file.write(updated)
        file.flush()  # a later flush would change its mtime
        os.utime(file.fileno(), ns=(stamp.st_atime_ns, stamp.st_mtime_ns))

    write_durably(path, fill)


def displayed_measurements(out: Path) -> dict[str, Any] | None:
    """The measurements to show: those of the current surface model, in the page's frame. None if there are none."""
    from splatpipe.stages.line import DSM, EXPORT, LINE  # here: every run ends in this module, whatever its pipeline

    run = open_run_folder(out, LINE)
    of_surface, of_page = run.lineage(DSM), run.lineage(EXPORT)
    surface, frame = of_surface.get("dsm.files"), of_page.get("georef.frame")
    if surface is None or frame is None:
        return None
    sections = read_measurements(out, "sections", surface.digest, frame.digest)
    volumes = read_measurements(out, "volumes", surface.digest, frame.digest)
    current = {
        "sections": [_section(item) for item in sections if _is_section_trace(item.get("trace"))],
        "volumes": [_volume(item) for item in volumes if _is_polygon_trace(item.get("trace"))],
    }
    return current if any(current.values()) else None


def _section(item: Mapping[str, Any]) -> dict[str, Any]:
    sigma_m = item.get("height_sigma_m")
    figures = {key: item[key] for key in SECTION_FIGURES}
    figures["height_sigma_m"] = sigma_m if is_number(sigma_m) else None
    return {"name": title_of(item), **figures, "trace": item["trace"]}


def _volume(item: Mapping[str, Any]) -> dict[str, Any]:
    figures = {key: item[key] for key in VOLUME_FIGURES}
    return {"name": title_of(item), "base": str(item["base"].get("kind")), **figures, "trace": item["trace"]}


def _is_section_trace(trace: Any) -> bool:
    """Whether the page can draw it: a damaged one must not hide the rest."""
    if not _has_columns(trace, PROFILE) or not _has_columns(trace, POINTS) or None in trace["distance"]:
        return False
    return trace["distance"][-1:] > [0.0] and any(height is not None for height in trace["height"])


def _is_polygon_trace(trace: Any) -> bool:
    return isinstance(trace, list) and all(_has_columns(ring, PLACES) for ring in trace)


def _has_columns(trace: Any, names: Sequence[str]) -> bool:
    """Whether these columns exist, have equal lengths, and contain only numbers or None."""
    if not isinstance(trace, dict) or not all(isinstance(trace.get(name), list) for name in names):
        return False
    if not all(
        value is None or (is_number(value) and abs(value) <= MAX_COORDINATE_M)
        for name in names
        for value in trace[name]
    ):
        return False
    return len({len(trace[name]) for name in names}) == 1
