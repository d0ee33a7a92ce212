"""Checks whether the views determine the lens, and with it the heights and the place of the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from splatpipe.pipeline.app.preflight.findings import Finding, Severity
from splatpipe.pipeline.app.preflight.intake import Intake
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.source import RunSource
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.files.names import printable
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.sfm.lenses.known_lenses import state_lenses
from splatpipe.pipeline.survey.adjustment.adjusted_positions import MAX_MOVED_GSDS
from splatpipe.pipeline.survey.adjustment.block_accuracy import ninety_five
from splatpipe.pipeline.survey.adjustment.position_adjustment import FOCAL_SHARES, OTHER_FOCAL_SHARE
from splatpipe.pipeline.survey.adjustment.predicted_flight import FlightCamera, PredictedAccuracy, predict_accuracy
from splatpipe.pipeline.survey.placing.uncertainty import metres_in_words

if TYPE_CHECKING:
    from splatpipe.stages.options import LineConfig

DOWN_DEG = -75.0  # gimbal pitch: views less steep show walls, which determine the focal length
MAX_RELATIVE_HEIGHT_SPREAD = 0.1  # spread of the heights above take-off relative to their median


def predict_heights(
    source: RunSource, config: LineConfig, intake: Intake, report: Reporter
) -> PredictedAccuracy | None:
    """Predict how well a run will know the ground of a flight with accurate positions; None if nothing can be said.

    Args:
        source: The user's folder.
        config: Configuration of the run that would follow.
        intake: The photos.
        report: Receives the notes on lenses.
    """
    if config.georef.adjust != "auto":
        return None
    times = {photo.name: photo.exif.time for photo in intake.photos}
    cameras = _cameras(source, config, intake, report)
    try:
        with threadpool_limits(limits=1):  # BLAS sums in another order on several threads
            return predict_accuracy(intake.positions.positions, cameras, times)
    except np.linalg.LinAlgError:  # singular: the metadata make no block
        return None


def height_findings(intake: Intake, predicted: PredictedAccuracy | None, controlled: bool) -> list[Finding]:
    """Warn of flights that do not determine the lens.

    Args:
        intake: The photos.
        predicted: The ground's accuracy by positions alone.
        controlled: Whether there are control points.
    """
    if predicted is None:
        return _nadir_only(intake)
    findings = []
    stated_across, stated_up = predicted.stated_m
    if (
        not controlled
        and predicted.plan_m > MAX_MOVED_GSDS * max(predicted.gsd_m, stated_across)
        and predicted.one_heading
    ):
        findings.append(_one_heading(predicted))
    if predicted.height_m <= MAX_MOVED_GSDS * predicted.gsd_m:
        return findings
    if predicted.height_m <= MAX_MOVED_GSDS * stated_up:  # the positions themselves are no better
        return [*findings, *_nadir_only(intake)]
    return findings if controlled else [*findings, _heights_uncertain(predicted)]


def _nadir_only(intake: Intake) -> list[Finding]:
    """Nadir-only flights at one height, whose accuracy cannot be predicted in metres."""
    stated = intake.positions.positions
    pitches = [each.pitch_deg for each in stated if each.pitch_deg is not None]
    if len(pitches) < max(3, len(intake.photos) // 2) or max(pitches) > DOWN_DEG:
        return []
    heights = [each.relative_altitude_m for each in stated if each.relative_altitude_m is not None]
    if (
        heights
        and np.median(heights) > 0.0
        and np.ptp(heights) > MAX_RELATIVE_HEIGHT_SPREAD * float(np.median(heights))
    ):
        return []
    text = (
        "All photos look straight down from one height: the focal length, and with it heights, cannot be "
        "determined reliably."
    )
    hint = "Add some photos at 45° or from another height, or control points with heights, or a calibrated lens."
    return [Finding("nadir-only", "warning", text, hint)]


def _heights_uncertain(predicted: PredictedAccuracy) -> Finding:
    size = f"uncertain by about {_interval(predicted.height_m)} together (95 %)"
    cause = "the flight hardly tells focal length from height"
    if predicted.straight_down and predicted.one_height:
        cause = "all photos look straight down from one height, which does not tell focal length from height"
    if predicted.angles_stated:
        text = f"Heights of the ground will be {size}: {cause}."
    else:
        text = f"If all photos look straight down (their angles are not stated), heights of the ground will be {size}."
    first, *others = (printable(spot.photo) for spot in predicted.spots)
    hint = f"One control point with a surveyed height near {first} ({_degrees(predicted)}) would make that "
    hint += f"{_interval(predicted.control_1_m)}, three (also near {' and '.join(others)}) "
    hint += _interval(predicted.control_3_m)
    if predicted.cross_strip_m is not None:
        hint += f", a strip across flown a quarter higher {_interval(predicted.cross_strip_m)}"
    severity: Severity = "warning" if predicted.angles_stated else "note"
    return Finding("heights-uncertain", severity, text, f"{hint}.{_assumptions(predicted)}")


def _one_heading(predicted: PredictedAccuracy) -> Finding:
    text = (
        f"All photos have one heading: the ground's horizontal position will be uncertain by about "
        f"{_interval(predicted.plan_m)} together (95 %), because the lens's principal point shifts it likewise."
    )
    hint = "Strips flown the opposite way or across, or one control point near "
    hint += f"{printable(predicted.spots[0].photo)} ({_degrees(predicted)}), would settle it."
    return Finding("one-heading", "warning", text, hint)


def _assumptions(predicted: PredictedAccuracy) -> str:
    parts = []
    if predicted.photos < predicted.of_photos:
        parts.append(f"from a part, {predicted.photos} of {predicted.of_photos} photos")
    if predicted.height_guessed:
        parts.append(
            f"for a height of {predicted.flying_height_m:.0f} m above ground, guessed from the photos' spacing"
        )
    return f" Predicted {', '.join(parts)}." if parts else ""


def _interval(sigma_m: float) -> str:
    return f"±{metres_in_words(ninety_five(sigma_m))}"


def _degrees(predicted: PredictedAccuracy) -> str:
    """Latitude and longitude of the first spot, to a decimetre."""
    return f"{predicted.spots[0].latitude:.6f}, {predicted.spots[0].longitude:.6f}"


def _cameras(source: RunSource, config: LineConfig, intake: Intake, report: Reporter) -> dict[str, FlightCamera]:
    """The camera of each photo, as a run will know it."""
    members: dict[int, list[CheckedPhoto]] = {}
    for photo in intake.photos:
        members.setdefault(intake.camera_of[photo.name], []).append(photo)
    path = source.part_path("source.lens")
    try:
        groups, _ = state_lenses(intake.groups, members, path if path.is_file() else None, report)
    except SplatpipeError:  # which ends a run
        groups = list(intake.groups)
    held = config.sparse.lens == "held"
    return {
        photo.name: FlightCamera(
            photo.width,
            photo.height,
            groups[number].focal_px,
            FOCAL_SHARES.get(groups[number].focal_source, OTHER_FOCAL_SHARE),
            held,
            number,
        )
        for number, photos in members.items()
        for photo in photos
    }
