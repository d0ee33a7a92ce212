"""Assembles the report: the chapters for which there is data, and the page made from them."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.app.page_file import page_text
from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.app.report.chapters.capture import capture_chapter, registration_chapter
from splatpipe.pipeline.app.report.chapters.georeferencing import georeferencing_chapter
from splatpipe.pipeline.app.report.chapters.processing import files_chapter, messages_chapter, processing_chapter
from splatpipe.pipeline.app.report.chapters.surfaces import surfaces_chapter
from splatpipe.pipeline.app.report.chapters.training import training_chapter, views_chapter
from splatpipe.pipeline.app.report.facts.last_report import Chapter, LastReport
from splatpipe.pipeline.app.report.facts.overlap import overlap_s
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs, results_digest
from splatpipe.pipeline.app.report.facts.wording import count, duration, judged_of, judged_size, length, moment, number
from splatpipe.pipeline.app.report.verdict import judge
from splatpipe.pipeline.engine.errors import SplatpipeError

if TYPE_CHECKING:
    from splatpipe.pipeline.app.report.charts.geometry import Geometry

TEMPLATES = Path(__file__).resolve().parent / "templates"
Make = Callable[[ReportInputs], Chapter | None]


def report_content(inputs: ReportInputs, *, drawn: bool, last: LastReport | None = None) -> dict[str, Any]:
    """What a report says: the values for the template of the page, and for that of the PDF.

    Args:
        inputs: The report's inputs.
        drawn: Whether to include charts and images; without them it is quick.
        last: The last report, whose chapters are taken over if they would be the same; None to draw all of them.
    """
    last, model = LastReport(inputs) if last is None else last, _Model(inputs, drawn=drawn)

    def chapter(name: str, make: Make, *, charts: bool = True) -> Chapter | None:
        make_drawn = _in_style(make) if charts else make
        return _guarded(lambda: last.chapter(name, make_drawn) if drawn else make(inputs))

    content: dict[str, Any] = {
        "name": _name(inputs),
        "photos_dir": "" if inputs.photos_dir is None else inputs.photos_dir.name,
        "began": moment(inputs.history.began_s) if inputs.history.began_s else "",
        "version": importlib.metadata.version("splatpipe"),
        "verdict": judge(inputs),
        "key_figures": _guarded(lambda: {"cards": _cards(inputs)}),
        "drawn": drawn,
        "results": results_digest(inputs) if drawn else "",
        "capture": chapter("capture", lambda seen: _capture(seen, model, drawn=drawn)),
        "registration": chapter("registration", lambda seen: _registration(seen, model, drawn=drawn)),
        "georeferencing": chapter("georeferencing", lambda seen: georeferencing_chapter(seen, model.geometry)),
        "training": chapter("training", lambda seen: training_chapter(seen, drawn=drawn)),
        "views": chapter("views", lambda seen: views_chapter(seen, drawn=drawn)),
        "surfaces": chapter("surfaces", lambda seen: surfaces_chapter(seen, drawn=drawn), charts=False),
        "processing": _guarded(lambda: processing_chapter(inputs, drawn=drawn)),
        "files": _guarded(lambda: files_chapter(inputs)),
        "messages": _guarded(lambda: messages_chapter(inputs)),
    }
    return content | {"geometry_trouble": model.trouble}


def report_page(inputs: ReportInputs, content: Mapping[str, Any]) -> str:
    """The report as one self-contained HTML text.

    Args:
        inputs: The report's inputs.
        content: Its content.

    Raises:
        MachineError: if this installation lacks the page's script or style.
    """
    places = run_labels(inputs)
    return page_text(TEMPLATES, "report.html.j2", places, style="report.css", script="report.js", **content)


def _name(inputs: ReportInputs) -> str:
    """The run's name: the title that its viewer was given, else its folder's."""
    if inputs.config is not None and inputs.config.export.title != type(inputs.config.export)().title:
        return inputs.config.export.title
    return inputs.out.resolve().name or str(inputs.out)


def run_labels(inputs: ReportInputs) -> PathLabels:
    """The labels that replace this machine's folders in a report."""
    options = {} if inputs.config is None else inputs.config.model_dump(mode="json")
    return PathLabels.of(inputs.out, inputs.photos_dir, options)


def _capture(inputs: ReportInputs, model: _Model, *, drawn: bool) -> Chapter | None:
    return capture_chapter(inputs, model.geometry, drawn=drawn) if "ingest" in inputs.artifacts else None


def _registration(inputs: ReportInputs, model: _Model, *, drawn: bool) -> Chapter | None:
    if not any(name in inputs.artifacts for name in ("features", "matches", "sparse")):
        return None
    return registration_chapter(inputs, model.geometry, drawn=drawn)


def _in_style(make: Make) -> Make:
    def styled_chapter(inputs: ReportInputs) -> Chapter | None:
        from splatpipe.pipeline.app.report.charts.drawing import styled

        with styled():
            return make(inputs)

    return styled_chapter


def _guarded(build: Callable[[], dict[str, Any] | None]) -> dict[str, Any] | None:
    """Build a chapter; if its artifact is damaged or from another version, return the error instead."""
    try:
        return build()
    except Exception as error:  # one damaged part must not hide the rest from the client
        return {"trouble": f"This part could not be read: {type(error).__name__}: {error}"}


class _Model:
    """The sparse model, read when the first chapter shows it.

    Args:
        inputs: The report's inputs.
        drawn: Whether it is shown at all.
    """

    def __init__(self, inputs: ReportInputs, *, drawn: bool) -> None:
        self._inputs, self._drawn = inputs, drawn
        self.trouble: str | None = None  # why it cannot be read

    @cached_property
    def geometry(self) -> Geometry | None:
        """Its geometry, in world coordinates if georeferenced; None without a model that can be read."""
        frame = self._inputs.part("georef.frame")
        path = self._inputs.part("georef.model") if frame is not None else self._inputs.part("sparse.model")
        if path is None or not self._drawn:
            return None
        from splatpipe.pipeline.app.report.charts.geometry import read_geometry

        try:
            return read_geometry(path, frame)
        except (OSError, ValueError, RuntimeError, KeyError, TypeError, SplatpipeError) as error:
            self.trouble = f"The sparse model could not be read, so there are no maps: {error}"
            return None


def _cards(inputs: ReportInputs) -> list[tuple[str, str, str]]:
    """Title, value and explanation of the key figures."""
    sparse, train, evaluate = (inputs.summary(name) for name in ("sparse", "train", "evaluate"))
    accuracy = inputs.read("georef.accuracy") if "georef" in inputs.artifacts else {}
    tables = accuracy.get("tables") or {}
    cards = []
    if sparse:
        placed = f"{count(sparse.get('registered'))} of {count(sparse.get('photos'))}"
        error = number(sparse.get("mean_reprojection_error_px"), 2)
        cards += [("Photos placed", placed, ""), ("Reprojection error", f"{error} px", "mean")]
    if accuracy.get("gsd_m"):
        cards.append(("Ground sample distance", length(accuracy["gsd_m"]), "size of a photo's pixel on the object"))
    for name, title in (("check", "Check points"), ("control", "Control points")):
        if tables.get(name):
            found = tables[name]
            cards.append((title, length(found.get("rmse_3d_m")), f"RMS of {count(found.get('count'))}, in 3D"))
            break
    if evaluate.get("psnr") is not None:
        seen = judged_of(evaluate.get("test_views", 0), evaluate.get("held_out_views", 0), "held-out photo")
        text = f"SSIM {number(evaluate.get('ssim'), 2)}, {seen}"
        inside = ", inside the boundary" if evaluate.get("whole_psnr") is not None else ""
        at = f", at {size} megapixels" if (size := judged_size(evaluate)) else ""
        cards.append(("PSNR", f"{number(evaluate.get('psnr'), 1)} dB", text + at + inside))
    if train:
        cards.append(("Gaussians", count(inputs.summary("clean").get("gaussians", train.get("gaussians"))), ""))
    manifests = [artifact.manifest for artifact in inputs.artifacts.values()]
    if manifests:
        seconds = sum(float(manifest["seconds"]) for manifest in manifests) - overlap_s(manifests)
        cards.append(("Computing time", duration(seconds), "elapsed time of all stages"))
    return cards
