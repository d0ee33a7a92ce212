"""Adds what is made after the splat to OUT/viewer.html and OUT/web/index.html: measurements, mesh and points.

The stage `export` writes the page before there is a surface model, and sections can be cut on a finished run at any
time. So these are put into the copy of the page in OUT; the artifact itself is unchanged. The page keeps its mtime, so
that the store still recognises it as that copy (``is_copy``), and the same state gives the same bytes. A site gets the
mesh and the points as a file beside the page, which loads it when they are first shown. Every command ends here, and
pages are large: `stages/viewers.json` says what they show, and they are read only if there is something else.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from splatpipe.pipeline.app.measurements import has_measurements, is_number, read_measurements, title_of
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import is_inside
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.runs.store import Part
from splatpipe.pipeline.web import script_safe
from splatpipe.pipeline.web.measured_page import (
    PAGE,
    SITE_PAGE,
    SURFACES,
    SURFACES_BEGIN,
    with_measurements,
    with_surfaces,
)

SECTION_FIGURES = ("length_m", "share_with_height")
VOLUME_FIGURES = ("cut_m3", "cut_sigma_m3", "fill_m3", "fill_sigma_m3", "net_m3", "net_sigma_m3", "area_m2")
PLACES = ("x", "y", "z")
LAYERS = ("mesh", "points")  # of `surfaces.json`
MAX_SURFACES_BYTES = 64 << 20  # bytes: five times the largest that `publish` writes
SHOWN = Path("stages/viewers.json")
DIGEST_CHARACTERS = 16  # hexadecimal digits, enough to be unique within a site
PROFILE, POINTS = ("distance", "height", "sigma", *PLACES), ("point_distance", "point_height")
GROUND = "ground"  # a column of profiles, if the run has a terrain model
MAX_COORDINATE_M = 1e9  # metres: larger coordinates are not on the earth, and a chart's steps are lost in rounding


def update_viewer(out: Path) -> str:
    """Update the viewers in OUT to show exactly the measurements, mesh and points that are still valid.

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
    if not pages:
        return ""
    measurements, trouble = displayed_measurements(out) if has_measurements(out) else None, ""
    part = _surfaces_part(out)
    if _shown(out) == _to_show(out, pages, measurements, part):
        return ""
    surfaces = _read_surfaces(part)
    for name in pages:
        try:
            beside = None if name == PAGE else (out / name).with_name(SURFACES)
            _update(out / name, measurements, _surfaces_of_page(surfaces, beside))
        except ValueError:
            if measurements is not None or surfaces is not None:
                trouble = (
                    f"{name} was written by an earlier version and cannot show all results; update it with: "
                    f"splatpipe stage export {out}"
                )
    if not trouble:
        write_durably(out / SHOWN, json.dumps(_to_show(out, pages, measurements, part), sort_keys=True))
    return trouble


def _to_show(
    out: Path, pages: Sequence[str], measurements: Mapping[str, Any] | None, surfaces: Part | None
) -> dict[str, Any]:
    """The pages' files as they are, and digests of what they are to show."""
    beside = out / Path(SITE_PAGE).with_name(SURFACES)
    files = [out / name for name in pages] + ([beside] if beside.is_file() else [])
    return {
        "files": {path.relative_to(out).as_posix(): _identity(path) for path in files},
        "measurements": hashlib.sha256(_json(measurements or {})).hexdigest(),
        "surfaces": "" if surfaces is None else surfaces.digest,
    }


def _identity(path: Path) -> list[int]:
    """What changes if anybody writes a file."""
    facts = path.stat()
    return [facts.st_size, facts.st_ino, facts.st_mtime_ns, facts.st_ctime_ns]


def _shown(out: Path) -> Any:
    """What the last command left in the pages; None if it is not known."""
    try:
        return read_json(out / SHOWN)
    except (OSError, ValueError):
        return None


def _surfaces_of_page(surfaces: Mapping[str, Any] | None, beside: Path | None) -> bytes | None:
    """What a page needs to show the mesh and the points; None if there are none.

    Args:
        surfaces: From ``_read_surfaces``.
        beside: A file for it beside the page; None to put it into the page.
    """
    if surfaces is None:
        if beside is not None:
            beside.unlink(missing_ok=True)
        return None
    layers = {"layers": list(surfaces)}
    if beside is None:
        return _json({**layers, **surfaces})
    data = _json(surfaces)
    if not (beside.is_file() and not beside.is_symlink() and beside.read_bytes() == data):
        write_durably(beside, data.decode("ascii"))
    return _json({**layers, "address": f"{beside.name}?v={hashlib.sha256(data).hexdigest()[:DIGEST_CHARACTERS]}"})


def _json(value: Mapping[str, Any]) -> bytes:
    return script_safe(json.dumps(value, separators=(",", ":"), allow_nan=False)).encode("ascii")


def _surfaces_part(out: Path) -> Part | None:
    """The part with the mesh and the points, if it is of the page's run and frame."""
    from splatpipe.stages.line import EXPORT, LINE, PUBLISH

    run = open_run_folder(out, LINE)
    published, of_page = run.lineage(PUBLISH), run.lineage(EXPORT)
    part, frames = published.get("publish.viewer"), [parts.get("georef.frame") for parts in (published, of_page)]
    return part if None not in frames and len({frame.digest for frame in frames if frame is not None}) == 1 else None


def _read_surfaces(part: Part | None) -> dict[str, Any] | None:
    """The mesh and the points to show; None if there are none."""
    if part is None:
        return None
    try:
        found = read_json(part.path / SURFACES, MAX_SURFACES_BYTES)
    except (OSError, ValueError):  # it was not made, or somebody else's is damaged
        return None
    surfaces = {layer: found[layer] for layer in LAYERS if layer in found} if isinstance(found, dict) else {}
    return surfaces or None


def _update(path: Path, measurements: Mapping[str, Any] | None, surfaces: bytes | None) -> None:
    """Put results into a page without changing its mtime; a page that already shows them is left alone."""
    page = path.read_bytes()
    updated = with_measurements(page, measurements)
    updated = updated if surfaces is None and SURFACES_BEGIN not in updated else with_surfaces(updated, surfaces)
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
    of = {"base": str(item["base"].get("kind")), "model": "dtm" if item.get("model") == "dtm" else "dsm"}
    return {"name": title_of(item), **of, **figures, "trace": item["trace"]}


def _is_section_trace(trace: Any) -> bool:
    """Whether the page can draw it: a damaged one must not hide the rest."""
    profile = (*PROFILE, GROUND) if isinstance(trace, dict) and GROUND in trace else PROFILE
    if not _has_columns(trace, profile) or not _has_columns(trace, POINTS) or None in trace["distance"]:
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
