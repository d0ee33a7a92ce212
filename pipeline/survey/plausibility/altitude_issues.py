"""Doubtful altitudes, detected before matching from metadata alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.photos.files.names import list_names
from splatpipe.pipeline.photos.intake.capture_issues import CaptureIssue
from splatpipe.pipeline.survey.placing.fitting import MIN_POSITIONS
from splatpipe.pipeline.survey.plausibility.barometer import altitude_climbs
from splatpipe.pipeline.survey.positions.photo_positions import DATUM_STEP_M, PositionList
from splatpipe.pipeline.survey.positions.position_sources import MOST_DATUMS_M

ALTITUDE_SPREADS = 8.0  # deviation from the median altitude over the median deviation, for an altitude to be wrong
MIN_ALTITUDE_M = 150.0  # off the others: more than a building and its hill
FILE_STEP_M = 20.0  # between altitudes of a file and the photos' own: a drone's own are off by nearly as much


def find_altitude_issues(positions: PositionList) -> list[CaptureIssue]:
    """List what is doubtful about the altitudes, one entry per kind."""
    return [*_altitudes(positions), *_datums(positions), *_file_step(positions)]


def who_states(names: Collection[str], positions: PositionList) -> str:
    """All photos, or their number and names."""
    if len(names) >= len(positions.positions):
        return f"All {len(names)} photos"
    return f"{len(names)} of {len(positions.positions)} photos ({list_names(sorted(names))})"


def _altitudes(of: PositionList) -> list[CaptureIssue]:
    """Altitudes that are missing, impossible, or far off the others'."""
    positions = of.positions
    stated = {each.name: each.altitude_m for each in positions if each.altitude_m is not None}
    takeoff = any(each.altitude_source == "takeoff" for each in positions)
    lacking = frozenset(each.name for each in positions if takeoff or each.altitude_m is None)
    issues = []
    impossible = {name: metres for name, metres in of.doubts.impossible_m.items() if name in lacking}
    if impossible:
        least, most = min(impossible.values()), max(impossible.values())
        values = f"{least:,.0f} m" if round(least) == round(most) else f"{least:,.0f} to {most:,.0f} m"
        text = f"{who_states(impossible, of)} state an impossible altitude ({values})."
        issues.append(CaptureIssue("altitude-impossible", text, "It is not used.", tuple(sorted(impossible))))
    if takeoff:
        text = "No photo states a usable altitude: heights will count from the take-off point, not from the sea."
        hint = "Scale, horizontal place and up are not affected. Control points or geo.txt would give heights."
        issues.append(CaptureIssue("altitude-missing", text, hint))
    elif lacking:
        issues.append(_without_altitude(sorted(lacking), len(stated)))
    climbs = altitude_climbs([asdict(each) for each in positions])
    if climbs is not None:
        issues.append(CaptureIssue("altitude-climbs", *climbs))
    return [*issues, *_far_altitudes(stated)]


def _without_altitude(names: Sequence[str], others: int) -> CaptureIssue:
    """Photos without an altitude.

    Args:
        names: The photos.
        others: How many have one.
    """
    if others < MIN_POSITIONS:
        who = f"Only {others} of {len(names) + others} photos state" if others else "No photo states"
        text = f"{who} a usable altitude: only horizontal positions are used, and heights are arbitrary."
        hint = "Up will be from how the cameras were held. Control points, or altitudes in geo.txt, would give heights."
        return CaptureIssue("altitude-missing", text, hint)
    who = list_names(names) if len(names) <= others else f"{len(names)} of {len(names) + others} photos"
    return CaptureIssue("altitude-missing", f"Without an altitude: {who}.", "Others place the model.", tuple(names))


def _far_altitudes(stated: Mapping[str, float]) -> list[CaptureIssue]:
    """Altitudes far off the others'."""
    if len(stated) < MIN_POSITIONS:
        return []
    values: Float64[np.ndarray, " n"] = np.array(list(stated.values()), dtype=np.float64)
    off = np.abs(values - np.median(values))
    limit = max(MIN_ALTITUDE_M, ALTITUDE_SPREADS * float(np.median(off)))
    odd = tuple(name for name, metres in zip(stated, off.tolist(), strict=True) if metres > limit)
    if not odd:
        return []
    text = f"Altitudes far from the others' ({np.median(values):.0f} m): {list_names(odd)}."
    return [CaptureIssue("altitude-far", text, "Correct them, or leave the photos out.", odd)]


def _datums(positions: PositionList) -> list[CaptureIssue]:
    kinds = Counter((each.vertical, each.altitude_source) for each in positions.positions if each.altitude_source)
    issues = []
    if len(kinds) > 1:
        references = ", ".join(f"{count} {_datum(*kind)}" for kind, count in kinds.most_common())
        issues.append(
            CaptureIssue(
                "altitude-datums",
                f"Altitudes have different references: {references}.",
                "Heights of different datums differ by up to a hundred metres: give positions in one datum in geo.txt.",
            )
        )
    step = positions.altitude_step_m
    if step is not None and abs(step) > MOST_DATUMS_M:
        text = f"The altitudes in EXIF and in the drone's XMP differ by {step:.1f} m, more than any two datums do."
        hint = "Usually one of them is the height above take-off. EXIF's are used: correct them if they are wrong."
        issues.append(CaptureIssue("altitude-contradiction", text, hint))
    elif step is not None and abs(step) > DATUM_STEP_M:
        issues.append(
            CaptureIssue(
                "altitude-datums",
                f"The altitudes in EXIF and in the drone's XMP differ by {step:.1f} m: they have different datums.",
                "EXIF's are used.",
            )
        )
    return issues


def _datum(vertical: str, source: str | None) -> str:
    where = {
        "file": "from the file of positions",
        "exif": "from EXIF",
        "xmp": "from XMP",
        "takeoff": "above take-off",
    }.get(source or "", "")
    return f"{where} ({vertical if vertical != 'unknown' else 'datum not stated'})"


def _file_step(positions: PositionList) -> list[CaptureIssue]:
    """The altitudes of a file of positions against the photos' own."""
    step = positions.file_step_m
    if step is None or abs(step) <= FILE_STEP_M:
        return []
    text = f"The altitudes in the file of positions lie {abs(step):.0f} m {'above' if step > 0.0 else 'below'} the"
    if abs(step) > MOST_DATUMS_M:
        text = f"{text} photos' own, more than any two datums do."
        hint = "Are they heights above take-off, in feet, or of the wrong sign? The file's are used."
        return [CaptureIssue("altitude-contradiction", text, hint)]
    hint = "One may be above the geoid and the other above the ellipsoid. The file's are used."
    return [CaptureIssue("altitude-datums", f"{text} photos' own.", hint, severity="note")]
