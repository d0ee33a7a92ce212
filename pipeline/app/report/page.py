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
from splatpipe.pipeline.app.report.charts.gallery import Gallery, Keep, draw_now
from splatpipe.pipeline.app.report.facts.picture_sources import limited, source_facts
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs, results_digest
from splatpipe.pipeline.app.report.facts.wording import count, duration, judged_of, judged_size, length, moment, number
from splatpipe.pipeline.app.report.verdict import judge
from splatpipe.pipeline.engine.errors import SplatpipeError

if TYPE_CHECKING:
    from splatpipe.pipeline.app.report.charts.geometry import Geometry

TEMPLATES = Path(__file__).resolve().parent / "templates"
Chapter = dict[str, Any]
Build = Callable[[], Chapter | None]
# The parts that each chapter with pictures may see.
MODEL = ("sparse.model", "georef.model", "georef.frame")
CAPTURE = (
    "ingest.photos",
    "ingest.left_out",
    "ingest.positions",
    "ingest.cameras",
    "georef.accuracy",
    "split.views",
)
REGISTRATION = ("ingest.photos", "sparse.summary", "matches.pairs", "georef.accuracy")
GEOREFERENCING = ("ingest.photos", "georef.control", "georef.accuracy", "evaluate.metrics", "export.georef")
VIEWS = ("ingest.photos", "evaluate.metrics", "evaluate.views")


def report_content(inputs: ReportInputs, *, drawn: bool, gallery: Gallery | None = None) -> dict[str, Any]:
    """What a report says: the values for the template of the page, and for that of the PDF.

    Args:
        inputs: The report's inputs.
        drawn: Whether to include charts and images; without them it is quick.
        gallery: Pictures of the last report, which receives those of this one; None draws them all.
    """
    if not drawn:
        return _content(inputs, None, draw_now)
    if gallery is None:
        gallery = Gallery(inputs.out, {})  # kept pictures pass through it, so drawn ones do, too: they are the same
    keep = gallery.keep
    return _content(inputs, _Scene(limited(inputs, MODEL), keep), keep)


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


def _content(inputs: ReportInputs, scene: _Scene | None, keep: Keep) -> dict[str, Any]:
    drawn = scene is not None
    chapters = _chapters(inputs) if scene is None else _drawn_chapters(inputs, scene, keep)
    return {
        "name": _name(inputs),
        "photos_dir": "" if inputs.photos_dir is None else inputs.photos_dir.name,
        "began": moment(inputs.history.began_s) if inputs.history.began_s else "",
        "version": importlib.metadata.version("splatpipe"),
        "verdict": judge(inputs),
        "key_figures": _guarded(lambda: {"cards": _cards(inputs)}),
        "drawn": drawn,
        "results": results_digest(inputs) if drawn else "",
        "geometry_trouble": None if scene is None else scene.trouble or None,
        **{name: _guarded(build) for name, build in chapters.items()},
        "training": _guarded(lambda: training_chapter(inputs, drawn=drawn, keep=keep)),
        "surfaces": _guarded(lambda: surfaces_chapter(inputs, drawn=drawn, keep=keep)),
        "processing": _guarded(lambda: processing_chapter(inputs, drawn=drawn)),
        "files": _guarded(lambda: files_chapter(inputs)),
        "messages": _guarded(lambda: messages_chapter(inputs)),
    }


def _chapters(inputs: ReportInputs) -> dict[str, Build]:
    """The chapters with pictures, without them."""
    return {
        "capture": lambda: capture_chapter(inputs, None, drawn=False) if _checked(inputs) else None,
        "registration": lambda: registration_chapter(inputs, None, drawn=False) if _matched(inputs) else None,
        "georeferencing": lambda: georeferencing_chapter(inputs, None),
        "views": lambda: views_chapter(inputs, drawn=False),
    }


def _drawn_chapters(inputs: ReportInputs, scene: _Scene, keep: Keep) -> dict[str, Build]:
    """The same with pictures; each is made from limited inputs, which its key covers, and kept as a whole."""

    def kept(name: str, seen: ReportInputs, build: Callable[[ReportInputs], Chapter | None]) -> Build:
        def drawn() -> Chapter | None:
            from splatpipe.pipeline.app.report.charts.drawing import styled

            with styled():
                return build(seen)

        return lambda: keep(name, source_facts(seen), drawn)

    def see(*parts: str, summaries: tuple[str, ...] = (), photos: bool = False) -> ReportInputs:
        return limited(inputs, (*MODEL, *parts), summaries, photos=photos)

    capture = see(*CAPTURE, summaries=("ingest",))
    registration = see(*REGISTRATION, summaries=("features", "matches", "sparse", "georef"), photos=True)
    georeferencing = see(*GEOREFERENCING, summaries=("georef", "sparse"), photos=True)
    chapters = {
        "capture": kept("capture", capture, lambda seen: capture_chapter(seen, scene.geometry, drawn=True)),
        "registration": kept(
            "registration", registration, lambda seen: registration_chapter(seen, scene.geometry, drawn=True)
        ),
        "georeferencing": kept(
            "georeferencing", georeferencing, lambda seen: georeferencing_chapter(seen, scene.geometry)
        ),
        "views": kept("views", see(*VIEWS), lambda seen: views_chapter(seen, drawn=True)),
    }
    present = {"capture": _checked(inputs), "registration": _matched(inputs)}
    return {name: build if present.get(name, True) else _nothing for name, build in chapters.items()}


def _nothing() -> None:
    """A chapter for which there is no data."""


class _Scene:
    """The sparse model's geometry, read only if something is drawn from it.

    Args:
        inputs: Limited to what it is read from.
        keep: Keeps whether it can be read.
    """

    def __init__(self, inputs: ReportInputs, keep: Keep) -> None:
        self._inputs, self._keep = inputs, keep

    @cached_property
    def trouble(self) -> str:
        """Why it cannot be read; empty if it can, or there is none."""
        facts = [source_facts(self._inputs)]
        trouble = self._keep("geometry", facts, lambda: self._read[1] or "")
        if not isinstance(trouble, str):
            raise TypeError("the kept text is none")
        return trouble

    @property
    def geometry(self) -> Geometry | None:
        return self._read[0]

    @cached_property
    def _read(self) -> tuple[Geometry | None, str | None]:
        return _geometry(self._inputs)


def run_labels(inputs: ReportInputs) -> PathLabels:
    """The labels that replace this machine's folders in a report."""
    options = {} if inputs.config is None else inputs.config.model_dump(mode="json")
    return PathLabels.of(inputs.out, inputs.photos_dir, options)


def _checked(inputs: ReportInputs) -> bool:
    return "ingest" in inputs.artifacts


def _matched(inputs: ReportInputs) -> bool:
    return any(name in inputs.artifacts for name in ("features", "matches", "sparse"))


def _guarded(build: Callable[[], dict[str, Any] | None]) -> dict[str, Any] | None:
    """Build a chapter; if its artifact is damaged or from another version, return the error instead."""
    try:
        return build()
    except Exception as error:  # one damaged part must not hide the rest from the client
        return {"trouble": f"This part could not be read: {type(error).__name__}: {error}"}


def _geometry(inputs: ReportInputs) -> tuple[Geometry | None, str | None]:
    """The sparse model's geometry, in world coordinates if georeferenced; or the error if it cannot be read."""
    frame = inputs.part("georef.frame")
    path = inputs.part("georef.model") if frame is not None else inputs.part("sparse.model")
    if path is None:
        return None, None
    from splatpipe.pipeline.app.report.charts.geometry import read_geometry

    try:
        return read_geometry(path, frame), None
    except (OSError, ValueError, RuntimeError, KeyError, TypeError, SplatpipeError) as error:
        return None, f"The sparse model could not be read, so there are no maps: {error}"


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
    seconds = [float(artifact.manifest["seconds"]) for artifact in inputs.artifacts.values()]
    if seconds:
        cards.append(("Computing time", duration(sum(seconds)), "elapsed time of all stages"))
    return cards
