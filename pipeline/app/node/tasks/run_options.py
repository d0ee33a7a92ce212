"""Turns a task's options into those of ``splatpipe run``. Light to import."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from splatpipe.stages.products import CELL_PIXELS, options_for

DEPTH_MEGAPIXELS = {"ultra": 4.8, "high": 2.4, "medium": 1.2, "low": 0.6, "lowest": 0.3}
FEATURE_PIXELS = {"ultra": 4000, "high": 2800, "medium": 2000, "low": 1400, "lowest": 1000}
CM = 0.01
MARK_FIRST = "mark-first"  # the option with which a run stops where control points can be marked
MARKED_AFTER = "georef"  # marks are predicted in photos by the georeferenced model
# Last stages whose inputs do not include training: of the orthophoto alone, and of all surface products.
ORTHOPHOTO_UNTIL, SURFACES_UNTIL = "ortho", "publish"
LEFT_OUT_BY_FAST = ("mesh", "mesh-size", "facades", "sky")  # options that a fast orthophoto makes idle


@dataclass(frozen=True)
class RunOptions:
    """Arguments of ``splatpipe run``.

    Attributes:
        preset: The preset.
        tables: Options by section, over those of the preset.
        until: The last stage; empty for all.
        time_budget: The whole run's time, as ``--time-budget`` takes it; empty for none.
        boundary: GeoJSON of the boundary, which becomes a file; empty for none, or for one that was uploaded.
    """

    preset: str = "standard"
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    until: str = ""
    time_budget: str = ""
    boundary: str = ""


def run_options(given: Mapping[str, Any]) -> RunOptions:
    """The run's options for those of a task.

    Args:
        given: Typed values by the names of ``CATALOGUE``.
    """
    preset = given.get("preset", "standard")
    fast = bool(given.get("fast-orthophoto"))
    mesh = (bool(given.get("mesh")) or "mesh-size" in given) and not fast
    asked = [name for name in ("dsm", "dtm", "facades") if given.get(name)]
    asked += ["ortho"] if fast or "orthophoto-resolution" in given else []
    asked += ["dsm"] if "dem-resolution" in given else []
    terrain = fast and bool(given.get("dtm"))
    # Viewers of clients take their CRS from the cloud; its stage reads the terrain model.
    asked += ["cloud"] if terrain or not (fast or preset == "preview") else []
    asked += ["mesh"] if mesh else []
    tables: dict[str, dict[str, Any]] = options_for(",".join(asked), None, None) if asked else {}

    def put(section: str, name: str, value: Any) -> None:
        tables[section] = {**tables.get(section, {}), name: value}

    if "orthophoto-resolution" in given:
        put("ortho", "gsd_m", given["orthophoto-resolution"] * CM)
    if "dem-resolution" in given:
        put("dsm", "cell_m", given["dem-resolution"] * CM)
    elif "orthophoto-resolution" in given:  # an orthophoto is drawn on cells of its own size or coarser
        put("dsm", "cell_m", CELL_PIXELS * given["orthophoto-resolution"] * CM)
    if "pc-quality" in given:
        put("depths", "max_megapixels", DEPTH_MEGAPIXELS[given["pc-quality"]])
    if "feature-quality" in given:
        put("features", "max_image_size", FEATURE_PIXELS[given["feature-quality"]])
    if "mesh-size" in given:
        put("mesh", "triangles", given["mesh-size"])
    for name, option in (("crs", "crs"), ("vertical", "vertical"), ("check-points", "check_points")):
        if name in given:
            put("georef", option, given[name])
    if given.get("sky"):
        put("export", "sky", True)
    if not fast:
        put("export", "formats", "tiles")
        formats = [*(["mesh-tiles"] if mesh else []), *(["mbtiles"] if preset != "preview" or "ortho" in asked else [])]
        put("publish", "formats", ",".join(formats))
    return RunOptions(
        preset,
        tables,
        _until(given),
        given.get("time-budget", ""),
        given.get("boundary", ""),
    )


def _until(given: Mapping[str, Any]) -> str:
    if given.get(MARK_FIRST):
        return MARKED_AFTER
    if not given.get("fast-orthophoto"):
        return ""
    return SURFACES_UNTIL if given.get("dtm") else ORTHOPHOTO_UNTIL


def idle_options(given: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the options that others make idle: a fast orthophoto trains nothing, and makes no mesh."""
    return tuple(name for name in LEFT_OUT_BY_FAST if given.get(name)) if given.get("fast-orthophoto") else ()
