"""The verdict on a run, in plain words, at the top of the page: what is good and what is doubtful.

The limits are common practice (Pix4D's quality report requires 95 % of the photos and a focal length within 5 %;
surveyors expect check points within one to two ground sampling distances horizontally and three vertically).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from splatpipe.pipeline.app.report.facts.adjustment_results import adopted_focals_px, read_adjustment
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs
from splatpipe.pipeline.app.report.facts.wording import (
    count,
    duration,
    judged_of,
    judged_size,
    length,
    moment,
    number,
    plural,
    share,
)
from splatpipe.pipeline.engine.stage import stage_name
from splatpipe.stages.line import LINE

Level = Literal["good", "doubt", "bad"]

PLACED_GOOD, PLACED_DOUBT = 0.95, 0.75  # registered share of the photos
ERROR_GOOD_PX, ERROR_DOUBT_PX = 1.0, 2.0  # mean reprojection error
FOCAL_GOOD = 0.05  # relative deviation from the prior
HORIZONTAL_GSDS, VERTICAL_GSDS = 2.0, 3.0  # RMSE at check points
SURFACE_GSDS = 6.0  # largest error in height of one surveyed point, in GSDs: twice the usual RMSE
MAX_NAMED = 3
MIN_CHECK_POINTS = 3  # check points; fewer prove little
PSNR_GOOD_DB, PSNR_DOUBT_DB = 25.0, 20.0  # held-out photos at 2 megapixels, exposure compensated (trials.md)
CAMERAS = "Cameras"
CAMERAS_BAD = "The camera poses are unreliable"
PLACE = "Place"
PLACE_BAD = "The result contradicts what else is known of its place"
# Share of the light in front of held-out photos' points: 8 of 255 grey values, which begin to show.
MAX_VEIL_SHARE = 0.03


@dataclass(frozen=True)
class VerdictLine:
    """One line of the verdict."""

    level: Level
    title: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """The verdict at the top of the page."""

    level: Level
    headline: str
    text: str
    findings: Sequence[VerdictLine]


def judge(inputs: ReportInputs) -> Verdict:
    """Judge a run by its results so far; unreadable parts are skipped, and reported in their own chapters."""
    findings: list[VerdictLine] = []
    for criterion in (
        _place,
        _heights,
        _cameras,
        _photos,
        _reprojection,
        _focal,
        _georeference,
        _splat,
        _views,
        _floaters,
    ):
        try:
            findings += filter(None, [criterion(inputs)])
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
    ending, text = _ending(inputs)
    listed = _listed(inputs)
    stages = inputs.history.stages.values()
    warnings = sum(not message.endswith(listed) for stage in stages for message, _ in stage.messages.warnings)
    if warnings:
        what = "other warning" if listed else "warning"
        findings.append(VerdictLine("doubt", "Warnings", f"The run gave {plural(warnings, what)}."))
    wrong = next((it for it in findings if it.title == CAMERAS and it.level == "bad"), None)
    misplaced = any(it.title == PLACE for it in findings)
    if ending is not None and (ending.level == "bad" or (wrong is None and not misplaced)):
        return Verdict(ending.level, ending.title, ending.text, findings)
    if wrong is not None or misplaced:  # results based on them cannot be better
        headline = CAMERAS_BAD if wrong is not None else PLACE_BAD
        return Verdict("bad", headline, " ".join(filter(None, [text, ending.text if ending else ""])), findings)
    doubtful = [finding for finding in findings if finding.level != "good"]
    if any(finding.level == "bad" for finding in doubtful):
        return Verdict("bad", "Finished, but with a serious problem", text, findings)
    if doubtful:
        return Verdict("doubt", f"Finished; {plural(len(doubtful), 'point')} to check", text, findings)
    return Verdict("good", "Finished; no problems found", text, findings)


def _listed(inputs: ReportInputs) -> tuple[str, ...]:
    """Texts of warnings that are findings of their own, and not counted again."""
    heights = _height_sentence(inputs).partition("; ")[0]
    contradictions = (str(it["text"]) for it in _contradictions(inputs))
    return (
        *contradictions,
        *(str(reason["text"]) for reason in _mapping_reasons(inputs)),
        *([f"{heights}."] if heights else []),
    )


def _ending(inputs: ReportInputs) -> tuple[VerdictLine | None, str]:
    """A line on how the run ended if it was not successful, and a sentence on when."""
    history = inputs.history
    when = f"{moment(history.ended_s)}, after {duration(history.ended_s - history.began_s)}"
    if not history.stages:
        return VerdictLine("bad", "Nothing has run yet", "The folder has no record of a run."), ""
    if history.complete:
        missing = [name for name in history.stages if name == stage_name(name) and name not in inputs.artifacts]
        if missing:
            lost = f"It ended on {when}, but results of {', '.join(missing)} are missing or unreadable."
            return VerdictLine(
                "bad", "Finished, but its results are damaged", f"{lost} Repeat the command to restore them."
            ), ""
        last = [stage.name for stage in LINE if stage.name in inputs.artifacts][-1:]
        if last == [LINE[-1].name]:
            took = duration(history.ended_s - history.began_s)
            return None, f"The run ended on {moment(history.ended_s)}; its last command took {took}."
        got = f"up to {last[0]}" if last else "without a result"
        return VerdictLine("doubt", f"Run {got}, as requested", f"It ended on {when}."), ""
    stage = history.culprit
    where = f" in {stage.name}" if stage is not None else ""
    kept = "Finished stages are kept: repeat the command to resume."
    if history.running:
        return VerdictLine(
            "doubt", f"Still running{where}", f"{_progress_text(inputs)} Events up to {moment(history.ended_s)}."
        ), ""
    if stage is not None and stage.state == "stopped":
        return VerdictLine(
            "bad", f"Stopped{where} before it was finished", f"{_progress_text(inputs)} {when}. {kept}"
        ), ""
    if stage is not None and stage.state == "failed":
        reason = " ".join(filter(None, [stage.message, stage.hint]))
        return VerdictLine("bad", f"Failed{where}", f"{reason} ({when})"), ""
    if history.message and history.exit_code:
        return VerdictLine(
            "bad", f"Failed{where}", " ".join(filter(None, [history.message, history.hint])) + f" ({when})"
        ), ""
    lost = (
        f"Its events end abruptly: it was killed, or the machine went down. {_progress_text(inputs)} Last event {when}."
    )
    return VerdictLine("bad", f"Interrupted{where}", f"{lost} {kept}"), ""


def _progress_text(inputs: ReportInputs) -> str:
    """How far the last stage got."""
    stage = inputs.history.culprit
    if stage is None or not stage.messages.progress:
        return ""
    total, unit = stage.messages.progress.get("total"), str(stage.messages.progress.get("unit", ""))
    return f"It had reached {count(stage.reached)} of {count(total)} {unit}."


def _place(inputs: ReportInputs) -> VerdictLine | None:
    """What is known and was not used to georeference, and contradicts the result."""
    found = _contradictions(inputs)
    return VerdictLine("bad", PLACE, " ".join(f"{it['text']} {it['hint']}" for it in found)) if found else None


def _contradictions(inputs: ReportInputs) -> list[Mapping[str, str]]:
    """Georeferencing's contradictions; empty if there are none or they cannot be read."""
    found = inputs.summary("georef").get("contradictions", [])
    readable = isinstance(found, list) and all(isinstance(it, Mapping) and {"text", "hint"} <= set(it) for it in found)
    return found if readable else []


def _heights(inputs: ReportInputs) -> VerdictLine | None:
    """Heights that accurate positions leave uncertain: what a surveyor has to know before all else."""
    sentence = _height_sentence(inputs)
    return VerdictLine("doubt", "Heights", f"{sentence}.") if sentence else None


def _height_sentence(inputs: ReportInputs) -> str:
    """Georeferencing's warning of uncertain heights, without a full stop; empty if there is none."""
    if "georef" not in inputs.artifacts:
        return ""
    try:
        found = read_adjustment(inputs.read("georef.accuracy"))
    except (OSError, ValueError):
        return ""
    sentence = found.heights.sentence if found is not None and found.heights is not None else ""
    return sentence[:1].upper() + sentence[1:]


def _cameras(inputs: ReportInputs) -> VerdictLine | None:
    """The mapping stage's own verdict on the cameras."""
    reasons = _camera_reasons(inputs)
    if not reasons:
        return None
    return VerdictLine(reasons[0]["level"], CAMERAS, " ".join(f"{it['text']} {it['hint']}".strip() for it in reasons))


def _camera_reasons(inputs: ReportInputs) -> list[Mapping[str, Any]]:
    """The mapping stage's worst reasons that still hold; empty if there are none or they cannot be read."""
    reasons = _mapping_reasons(inputs)
    if not any(_is_focal_doubt(reason) for reason in reasons):
        return reasons
    try:
        focals_agree = _has_adopted_focals(inputs) and max(_focal_deviations(inputs), default=1.0) <= FOCAL_GOOD
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        focals_agree = False
    return [reason for reason in reasons if not (focals_agree and _is_focal_doubt(reason))]


def _mapping_reasons(inputs: ReportInputs) -> list[Mapping[str, Any]]:
    """The mapping stage's worst reasons to doubt the cameras; empty if there are none or they cannot be read."""
    try:
        verdict = inputs.read("sparse.summary")["verdict"]
        return [reason for reason in verdict["reasons"] if reason["level"] == verdict["level"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []


def _is_focal_doubt(reason: Mapping[str, Any]) -> bool:
    """Whether a reason is a doubtful focal length, which georeferencing may have settled since."""
    return bool(reason.get("kind") == "focal" and reason["level"] == "doubt")


def _has_adopted_focals(inputs: ReportInputs) -> bool:
    return bool(adopted_focals_px(inputs, inputs.summary("sparse").get("cameras", [])))


def _is_camera_reason(inputs: ReportInputs, kind: str) -> bool:
    """Whether the verdict on the cameras already reports a reason of this kind."""
    return any(reason.get("kind") == kind for reason in _camera_reasons(inputs))


def _photos(inputs: ReportInputs) -> VerdictLine | None:
    sparse = inputs.summary("sparse")
    if not sparse or _is_camera_reason(inputs, "placed"):
        return None
    photos, placed = int(sparse["photos"]), int(sparse["registered"])
    level: Level = "good" if placed >= PLACED_GOOD * photos else "doubt" if placed >= PLACED_DOUBT * photos else "bad"
    if placed == photos:
        return VerdictLine(level, "Photos", f"All {photos:,} photos were placed.")
    lost = f"{photos - placed:,} of {photos:,} photos could not be placed ({share(1 - placed / photos)})"
    return VerdictLine(level, "Photos", f"{lost}: areas that only they show are missing.")


def _reprojection(inputs: ReportInputs) -> VerdictLine | None:
    error = inputs.summary("sparse").get("mean_reprojection_error_px")
    if error is None:
        return None
    level: Level = "good" if error <= ERROR_GOOD_PX else "doubt" if error <= ERROR_DOUBT_PX else "bad"
    meaning = {"good": "points and observations agree", "doubt": "more than usual"}
    meaning["bad"] = "the cameras contradict each other"
    return VerdictLine(level, "Reprojection error", f"{error:.2f} pixels on average: {meaning[level]}.")


def _focal_deviations(inputs: ReportInputs) -> list[float]:
    """Relative deviations from the metadata of the focal lengths that the model has, georeferenced if it is."""
    cameras = inputs.summary("sparse").get("cameras", [])
    adopted = adopted_focals_px(inputs, cameras)
    return [
        abs(adopted.get(k, camera["focal_px"]) / camera["prior_focal_px"] - 1.0)
        for k, camera in enumerate(cameras)
        if camera["has_prior"] and camera["prior_focal_px"]
    ]


def _focal(inputs: ReportInputs) -> VerdictLine | None:
    off = _focal_deviations(inputs)
    if not off:
        return None
    if max(off) <= FOCAL_GOOD:
        return VerdictLine("good", "Focal length", f"Calibrated within {share(max(off), 1)} of the photos' metadata.")
    if _is_camera_reason(inputs, "focal"):
        return None
    return VerdictLine("doubt", "Focal length", f"Calibrated {share(max(off), 1)} away from the photos' metadata.")


UNPLACED = "Lengths and heights can be measured; its position on the earth and north are unknown."
SCALE_GOOD = 0.005  # relative standard deviation of scale bars: five millimetres per metre


def _georeference(inputs: ReportInputs) -> VerdictLine | None:
    if "georef" not in inputs.artifacts:
        return None
    frame = inputs.read("georef.frame")
    if frame.get("kind") != "enu" and frame.get("metres"):
        scale = inputs.read("georef.accuracy").get("scale") or {}
        text = f"The model is metric but not georeferenced: {scale.get('sentence', 'its scale is from scale bars.')}"
        good = scale.get("sigma", 1.0) <= SCALE_GOOD and sum(bar["used"] for bar in scale.get("bars", [])) > 1
        return VerdictLine("good" if good else "doubt", "Georeferencing", f"{text} {UNPLACED}")
    if frame.get("kind") != "enu":
        why = str(frame.get("note", "")).removeprefix("Arbitrary scale: ").partition(". Up is from")[0].rstrip(".")
        text = f"The model has neither scale nor georeference: {why or 'no reason recorded'}, and there is no control."
        return VerdictLine("doubt", "Georeferencing", f"{text} It cannot be measured in metres.")
    report = inputs.read("georef.accuracy")
    tables, gsd = report["tables"], report.get("gsd_m")
    checks, control = tables.get("check"), tables.get("control")
    if checks:
        return _checked(checks, gsd)
    if control:
        fit = f"{length(control['rmse_horizontal_m'])} horizontally, {length(control['rmse_up_m'])} in height"
        text = (
            f"{plural(control['count'], 'control point')} fit to {fit}, but there is no check point to verify "
            "it elsewhere."
        )
        return VerdictLine("doubt", "Accuracy", text)
    gps = tables.get("gps") or {}
    height = "" if gps.get("rmse_up_m") is None else f", {length(gps['rmse_up_m'])} in height"
    off = f"they scatter by {length(gps.get('rmse_horizontal_m'))} horizontally{height}"
    uncertainty = (report.get("uncertainty") or {}).get("sentence")
    worth = f", {uncertainty}" if uncertainty else ""
    text = (
        f"Georeferenced by the photos' own positions alone ({off}){worth}: there is no control or check point "
        "to verify it."
    )
    return VerdictLine("doubt", "Accuracy", text)


def _checked(table: Mapping[str, Any], gsd: float | None) -> VerdictLine:
    horizontal, vertical = table["rmse_horizontal_m"], table["rmse_up_m"]
    text = f"{plural(table['count'], 'check point')} {'are' if table['count'] > 1 else 'is'} off by "
    text += f"{length(horizontal)} horizontally and {length(vertical)} in height (root mean square)"
    if not gsd:
        return VerdictLine("doubt", "Accuracy", f"{text}.")
    text += f", {number((horizontal or 0.0) / gsd, 1)} and {number((vertical or 0.0) / gsd, 1)} ground sample distances"
    good = (horizontal or 0.0) <= HORIZONTAL_GSDS * gsd and (vertical or 0.0) <= VERTICAL_GSDS * gsd
    if table["count"] < MIN_CHECK_POINTS:
        return VerdictLine("doubt", "Accuracy", f"{text}; so few points prove little.")
    bounds = f"{HORIZONTAL_GSDS:g} and {VERTICAL_GSDS:g}"
    verdict = "as expected of a careful survey" if good else f"more than the {bounds} that are usual"
    return VerdictLine("good" if good else "doubt", "Accuracy", f"{text}: {verdict}.")


def _splat(inputs: ReportInputs) -> VerdictLine | None:
    accuracy = inputs.read("evaluate.metrics").get("accuracy", {})
    splat, gsd = accuracy.get("splat"), accuracy.get("gsd_m")
    if not splat or not gsd:
        return None
    points = [point for point in splat["points"] if point.get("residual_m")]
    if not points:
        return None
    lengths = {point["name"]: sum(x * x for x in point["residual_m"] if x is not None) ** 0.5 for point in points}
    bound = SURFACE_GSDS * gsd
    far = sorted((name for name, off in lengths.items() if off > bound), key=lambda n: -lengths[n])
    if not far:
        off = length(max(lengths.values()))
        text = f"At {plural(len(points), 'surveyed point')} the splat's surface is within {off}."
        return VerdictLine("good", "Surface", text)
    text = f"The splat's surface is off by more than {length(bound)} ({SURFACE_GSDS:g} ground sample distances) at "
    text += f"{len(far)} of {plural(len(points), 'surveyed point')}: "
    text += ", ".join(f"{name} ({length(lengths[name])})" for name in far[:MAX_NAMED])
    return VerdictLine("doubt", "Surface", text + (", …" if len(far) > MAX_NAMED else "") + ".")


def _views(inputs: ReportInputs) -> VerdictLine | None:
    if "evaluate" not in inputs.artifacts:
        return None
    metrics = inputs.read("evaluate.metrics")
    bounded = " inside the boundary" if "whole" in metrics else ""
    mean, views = metrics["mean"], [view for view in metrics["per_view"] if view["psnr"] is not None]
    if bounded and metrics["per_view"] and not views:
        text = "No held-out photo shows the area inside the boundary, so its quality cannot be measured."
        return VerdictLine("doubt", "Held-out photos", text)
    if not views:
        return VerdictLine("doubt", "Held-out photos", "No photo was held out, so image quality cannot be measured.")
    worst_of = min(views, key=_view_psnr)
    value, worst = _view_psnr(mean), _view_psnr(worst_of)
    level: Level = "good" if value >= PSNR_GOOD_DB else "doubt" if value >= PSNR_DOUBT_DB else "bad"
    quality = {"good": "good image quality", "doubt": "fair image quality", "bad": "poor image quality"}[level]
    at = f", at {size} megapixels" if (size := judged_size(metrics)) else ""
    seen = judged_of(len(views), metrics.get("held_out_views", 0), "photo")
    text = f"{seen} that training never saw: PSNR {number(mean['psnr'], 1)} dB{bounded}{at} "
    text += f"({value:.1f} after colour fit), SSIM {number(mean['ssim'], 2)}: {quality}"
    if level == "good" and worst < PSNR_DOUBT_DB:
        return VerdictLine(
            "doubt", "Held-out photos", f"{text} on average, but not of {worst_of['name']} ({worst:.1f} dB)."
        )
    return VerdictLine(level, "Held-out photos", f"{text}.")


def _view_psnr(measures: Mapping[str, Any]) -> float:
    """PSNR, exposure compensated if available."""
    return float(measures["psnr_cc"] if measures.get("psnr_cc") is not None else measures["psnr"])


def _floaters(inputs: ReportInputs) -> VerdictLine | None:
    """Verdict on floaters by the held-out photos, if any; training itself prunes what training photos see through."""
    veil = inputs.read("evaluate.metrics").get("floaters", {}).get("veil", {})
    if veil.get("mean") is None:
        return None
    level: Level = "good" if veil["mean"] <= MAX_VEIL_SHARE else "doubt"
    what = "Few floaters" if level == "good" else "Floaters"
    which = "that training never saw" if veil.get("held_out", True) else "of the training, since none was held out"
    text = f"{what} in front of {plural(veil['photos'], 'photo')} {which}: they block"
    text += f" {share(veil['mean'], 1)} of the light from the points seen"
    return VerdictLine(level, "Floaters", f"{text}, at worst {share(veil['worst'], 1)} ({veil['worst_photo']}).")
