"""The landing page of a run, with links to the viewer, the report, the training and the files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from splatpipe.pipeline.app.report import PDF_FILE, REPORT_FILE
from splatpipe.pipeline.app.serving.files import FileNotServedError, is_inside, open_inside
from splatpipe.pipeline.app.view.log import RunLog
from splatpipe.pipeline.engine.files.json_file import parse_json
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE, RunFolder
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.web.measured_page import SITE, SITE_PAGE

VIEWER = "viewer.html"
MAX_METRICS_BYTES = 4 << 20  # half a kilobyte for each of 8,000 views; parsed for each request, while others wait
WHAT = {
    REPORT_FILE: "what was done, and the quality of the result",
    PDF_FILE: "the same in short, for the client",
    VIEWER: "the splat in 3D, in a single page",
    SITE_PAGE: "the splat in 3D, with levels of detail: put the folder web/ on any web host",
    "splat.ply": "the splat, for any viewer of Gaussian splats",
    "splat.spz": "the splat, compressed, as the viewer draws it",
    "sky.ply": "the sky, as a dome of Gaussians",
    "georef.json": "where the splat is: CRS, vertical datum, matrices",
    "cameras.json": "the cameras, in the splat's frame",
    "metrics.json": "all quality figures",
    "sparse.glb": "sparse points and camera frusta",
    "flythrough.webm": "a flight through the scene",
}
BROWSER_SUFFIXES = (".html", ".json", ".pdf", ".mp4", ".webm", ".png", ".jpg")


def downloadable_files(run: RunFolder) -> tuple[str, ...]:
    """The files that may be fetched, relative to OUT: the report and the stages' deliverables."""
    return tuple(name for name in (REPORT_FILE, PDF_FILE, *run.deliverables()) if is_inside(run.out, name))


def landing(run: RunFolder, marking: bool) -> dict[str, Any]:
    """The values for the landing page's template.

    Args:
        run: The run.
        marking: Whether control points can be marked here.
    """
    log = RunLog(run.out, EVENTS_FILE)
    log.read()
    names = downloadable_files(run)
    at_work = run.is_running
    state = _state(log, at_work)
    return {
        "name": run.name,
        "out": run.out,
        "state": state,
        "figures": _figures(_read_json(run, "metrics.json")) if "metrics.json" in names else [],
        "ways": _ways(names, at_work, marking, has_log=bool(log.stages)),
        "files": [_file(run, name) for name in names if name == SITE_PAGE or not name.startswith(SITE)],
    }


def _state(log: RunLog, at_work: bool) -> dict[str, str]:
    failed = next((stage for stage in log.stages.values() if stage.state == "failed"), None)
    running = next((stage for stage in log.stages.values() if stage.state == "running"), None)
    if at_work:
        return {"kind": "running", "text": "Running" + (f": {running.name}." if running else ".")}
    if failed is not None:
        return {"kind": "failed", "text": f"Ended in {failed.name}: {failed.message}"}
    if log.stages and all(stage.state in ("done", "reused") for stage in log.stages.values()):
        return {"kind": "done", "text": "Finished."}
    if running is not None:
        return {"kind": "failed", "text": f"Ended in {running.name}. Repeat the command to resume."}
    return {"kind": "done", "text": ""}


def _ways(names: Sequence[str], at_work: bool, marking: bool, has_log: bool) -> list[dict[str, Any]]:
    ways = []
    if marking:
        ways.append(("mark", False, "Mark control points", "Mark the surveyed points in the photos"))
    if at_work:
        ways.append(
            ("live", False, "Watch the training", "The latest checkpoint beside the photos, and the training curves")
        )
    if VIEWER in names:
        ways.append((VIEWER, True, "3D viewer", "Fly around, measure, read coordinates"))
    if SITE_PAGE in names:
        ways.append((SITE_PAGE, True, "Viewer for the web", "For any web host: coarse at first, finer where you look"))
    if REPORT_FILE in names:
        ways.append((REPORT_FILE, True, "Report", "The capture, the processing and the quality of the result"))
    if "flythrough.webm" in names:
        ways.append(("flythrough.webm", True, "Film", "A flight through the scene"))
    if not at_work and has_log:
        ways.append(("live", False, "Training", "Training curves, and renders beside the photos"))
    return [
        {"href": href, "of_run": of_run, "title": title, "text": text, "first": k == 0}
        for k, (href, of_run, title, text) in enumerate(ways)
    ]


def _figures(metrics: Mapping[str, JSON]) -> list[dict[str, str]]:
    """The key figures."""
    rows = (
        ("photos placed", "registered", "{:,.0f}"),
        ("Gaussians", "gaussians", "{:,.0f}"),
        ("PSNR", "psnr", "{:.2f} dB"),
        ("SSIM", "ssim", "{:.3f}"),
    )
    return [
        {"title": title, "value": form.format(metrics[key])}
        for title, key, form in rows
        if isinstance(metrics.get(key), int | float)
    ]


def _read_json(run: RunFolder, name: str) -> Mapping[str, JSON]:
    try:
        file = open_inside(run.out, name)
        with os.fdopen(file.descriptor, "rb") as stream:
            found = parse_json(stream.read(MAX_METRICS_BYTES))
    except (FileNotServedError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _file(run: RunFolder, name: str) -> dict[str, Any]:
    size = (run.out / name).lstat().st_size
    in_browser = PurePosixPath(name).suffix in BROWSER_SUFFIXES
    return {"name": name, "size": _bytes(size), "text": WHAT.get(name, ""), "shown": in_browser}


def _bytes(size: int) -> str:
    return f"{size / 1e6:,.1f} MB" if size >= 1e6 else f"{size / 1e3:,.1f} kB"
