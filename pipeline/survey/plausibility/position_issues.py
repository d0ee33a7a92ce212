"""Doubtful photo positions, detected before matching from metadata alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from splatpipe.pipeline.photos.files.names import list_names, printable
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.photos.intake.capture_issues import CaptureIssue
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.position_outliers import median_distance_m
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.placing.fitting import MIN_POSITIONS
from splatpipe.pipeline.survey.placing.position_spread import spread_of
from splatpipe.pipeline.survey.plausibility.altitude_issues import find_altitude_issues, who_states
from splatpipe.pipeline.survey.positions.flight_steps import FlightSteps, flying_relation, steps_of
from splatpipe.pipeline.survey.positions.photo_positions import NOWHERE, Position, PositionList
from splatpipe.pipeline.survey.positions.position_repeats import copied_coordinate, repeats, two_places
from splatpipe.pipeline.survey.positions.position_sources import is_on_earth, xmp_place
from splatpipe.pipeline.survey.positions.stated_positions import FilePlaces

CONTRADICTION_M = 1.0  # between a photo's EXIF and XMP: too large for rounding
CONTRADICTION_TIMES = 6.0  # times the difference in most photos, whose EXIF may have been post-processed (PPK)
ANOTHER_PLACE_M = 10.0  # in most photos: too large for a correction
WELL_KNOWN_M = 0.1  # a standard deviation up to this is RTK's
MIN_RTK_SHARE = 0.5  # share of photos with a fix above which the others have lost it
MIN_REPEATS = 6  # photos


def find_position_issues(
    photos: Sequence[CheckedPhoto], positions: PositionList, file: FilePlaces | None = None
) -> list[CaptureIssue]:
    """List what is doubtful, one entry per kind.

    Args:
        photos: The photos in use.
        positions: Their positions as read.
        file: The file of positions, if there is one.
    """
    return [
        *_none_on_earth(positions),
        *_missing(photos, positions),
        *_degenerate(positions.positions),
        *_repeating(photos, positions),
        *_doubted(positions),
        *_elsewhere(positions, file),
        *_contradicting(photos, positions),
        *_headings(photos, positions),
        *find_altitude_issues(positions),
        *_lost_fix(positions.positions),
    ]


def _none_on_earth(positions: PositionList) -> list[CaptureIssue]:
    issues = []
    if positions.impossible:
        issues.append(
            CaptureIssue(
                "position-impossible",
                f"Impossible positions: {list_names(positions.impossible)}."
                if positions.positions
                else "All stated positions are impossible: the result will have neither scale nor georeference.",
                "They are none on Earth, 0, 0, of no known hemisphere, or not in degrees, minutes and seconds. "
                "These photos are used without them.",
                positions.impossible,
            )
        )
    elsewhere = {name: why for name, why in positions.wrong.items() if why != NOWHERE}
    if elsewhere:
        reasons = [f"{printable(name)} {why}" for name, why in elsewhere.items()]
        more = f"; and {len(reasons) - 10} more" if len(reasons) > 10 else ""
        issues.append(
            CaptureIssue(
                "position-far",
                f"Implausible positions: {'; '.join(reasons[:10])}{more}.",
                "These photos are used without their positions.",
                tuple(sorted(elsewhere)),
            )
        )
    return issues


def _missing(photos: Sequence[CheckedPhoto], positions: PositionList) -> list[CaptureIssue]:
    stated = {position.name for position in positions.positions} | set(positions.wrong)
    without = tuple(photo.name for photo in photos if photo.name not in stated)
    if not without:
        return []
    if len(without) == len(photos):
        return [
            CaptureIssue(
                "position-missing",
                "No photo has a position: the result will have neither scale nor georeference.",
                "Control points give both, scale bars the scale. Was the receiver off, or the EXIF lost in a copy?",
                severity="note",
            )
        ]
    which = list_names(without) if len(without) <= len(photos) / 2 else f"{len(without)} of {len(photos)} photos"
    single = without if len(without) <= len(photos) / 2 else ()
    hint = "Was the receiver's fix lost, or the EXIF in a copy? They are used without it."
    return [CaptureIssue("position-missing", f"Without a position: {which}.", hint, single)]


def _degenerate(positions: Sequence[Position]) -> list[CaptureIssue]:
    """Positions that cannot determine scale and rotation, all together."""
    if not positions:
        return []
    spread = spread_of([(each.latitude, each.longitude, each.altitude_m or 0.0) for each in positions])
    consequence = "the result will have neither scale nor georeference"
    if spread.too_few:
        text = f"{spread.too_few[0].upper()}{spread.too_few[1:]}: {consequence}."
        hint = "Was the receiver's fix lost, or its last one repeated? Control points give both, scale bars the scale."
        return [CaptureIssue("positions-too-few", text, hint)]
    sigma = float(np.median([each.sigma_horizontal_m for each in positions]))
    if spread.is_too_close(sigma):
        text = (
            f"All positions lie within {spread.extent_m:.2g} m, but are accurate only to {sigma:.2g} m: {consequence}."
        )
        hint = "Control points give both, scale bars the scale; or give more accurate positions."
        return [CaptureIssue("positions-too-close", text, hint)]
    if spread.is_line(sigma):
        text = "All positions lie along a line: they do not determine the rotation about it."
        hint = "The gimbal's angles or the pictures' edges give it less accurately; a second line, or control, would."
        return [CaptureIssue("positions-in-line", text, hint, severity="note")]
    return []


def _repeating(photos: Sequence[CheckedPhoto], positions: PositionList) -> list[CaptureIssue]:
    """Positions that repeat: a copied coordinate, two places, a receiver slower than the camera."""
    places = [(each.latitude, each.longitude) for each in positions.positions]
    issues = []
    copied = copied_coordinate(places)
    if copied:
        text = f"All {len(places)} photos state one and the same {copied}, as no receiver does: it looks copied."
        hint = "The scale would be wrong: correct it, or give positions in geo.txt."
        issues.append(CaptureIssue("position-copied", text, hint))
    split = two_places(places)
    if split is not None:
        text = f"The positions are at two places, {split[2] / 1000.0:,.1f} km apart ({split[0]} and {split[1]} photos)."
        hint = (
            "If it is one site, those of one place are wrong (an earlier fix?): leave them out. If not, run each alone."
        )
        issues.append(CaptureIssue("position-two-places", text, hint))
    names = [each.name for each in positions.positions]
    again = repeats(places, _steps(photos, positions))
    if len(again) >= MIN_REPEATS and len(set(places)) >= MIN_POSITIONS:
        text = f"{len(again)} of {len(names)} photos state the position of the photo before."
        hint = "In flight, the receiver is then slower than the camera; the run tells whether they moved."
        issues.append(CaptureIssue("position-repeated", text, hint, severity="note"))
    return issues


def _steps(photos: Sequence[CheckedPhoto], positions: PositionList) -> FlightSteps:
    """From photo to photo, in order of time."""
    times = {photo.name: Photo(photo.name, photo.sha256, 0, 0, 0, photo.exif.time) for photo in photos}
    stated = positions.positions
    return steps_of([each.name for each in stated], {each.name: {"flight": each.flight} for each in stated}, times)


def _doubted(positions: PositionList) -> list[CaptureIssue]:
    """Photos whose EXIF is not read as it stands."""
    doubts = positions.doubts
    texts: list[tuple[str, frozenset[str], str, str]] = [
        (
            "position-frozen",
            doubts.frozen,
            "state one and the same position in EXIF: the receiver was frozen, or the EXIF copied.",
            "XMP's positions, which vary, are used.",
        ),
        (
            "position-hemisphere",
            doubts.by_xmp,
            "state no hemisphere (N or S, E or W) in EXIF.",
            "XMP's positions are used.",
        ),
        (
            "position-hemisphere",
            doubts.no_hemisphere,
            "state no hemisphere (N or S, E or W): they are read as north and east.",
            "In the west or south this would mirror the flight and place the model on another continent. Then add "
            "GPSLatitudeRef and GPSLongitudeRef to the EXIF, or give positions in geo.txt.",
        ),
        (
            "altitude-sign",
            doubts.sign,
            "state an altitude below the sea in EXIF, and the same above it in XMP.",
            "It is read as above the sea (EXIF's AltitudeRef is wrong).",
        ),
        (
            "altitude-takeoff",
            doubts.above_takeoff,
            "state the height above take-off as EXIF's altitude.",
            "XMP's altitudes are used.",
        ),
        ("altitude-zero", doubts.zero, "state an altitude of exactly 0 m.", "It is read as no altitude."),
    ]
    for datum in sorted(set(doubts.datum.values())):
        names = frozenset(name for name, stated in doubts.datum.items() if stated == datum)
        text = f"state the datum {printable(datum)} in EXIF: their positions are read as WGS 84, which may be hundreds"
        hint = "Convert them to WGS 84, or give positions with their CRS in geo.txt."
        texts.append(("position-datum", names, f"{text} of metres off.", hint))
    return [
        CaptureIssue(code, f"{who_states(names, positions)} {text}", hint, tuple(sorted(names)))
        for code, names, text, hint in texts
        if names
    ]


def _elsewhere(positions: PositionList, file: FilePlaces | None) -> list[CaptureIssue]:
    """A file of positions that lie off the photos' own."""
    if file is None or not file.by_name or not positions.elsewhere:
        return []
    source, metres = max(positions.elsewhere.items(), key=lambda entry: entry[1])
    apart = f"{metres / 1000.0:,.1f} km" if metres >= 1000.0 else f"{metres:.0f} m"
    text = f"{file.name} places the photos {apart} from their own positions ({source.upper()})."
    hint = file.better or "Check its CRS and datum (the zone, too), and that east or longitude comes first."
    hint = f"{hint} The file's are used; --set ingest.positions=none takes the photos' own."
    return [CaptureIssue("position-contradiction", text, hint)]


def _headings(photos: Sequence[CheckedPhoto], positions: PositionList) -> list[CaptureIssue]:
    """A flight that does not lead where the aircraft heads, as mirrored and turned positions do not."""
    stated = positions.positions
    if not stated:
        return []
    steps = _steps(photos, positions)
    yaw = [each.yaw_deg if each.flight_yaw_deg is None else each.flight_yaw_deg for each in stated]
    headings = np.array([np.nan if value is None else value for value in yaw], dtype=np.float64)
    geodetic = np.array([[each.latitude, each.longitude, 0.0] for each in stated], dtype=np.float64)
    relation, _ = flying_relation(Origin(*geodetic[0]).enu_from_geodetic(geodetic), headings, steps)
    hint = "Check the signs of latitude and longitude (S and W), and their order."
    if relation == "mirrored":
        text = "The positions lead the other way round than the drone's headings: they look mirrored."
        return [CaptureIssue("position-mirrored", text, hint)]
    if relation == "backwards":
        text = "The positions lead against the drone's headings: they look mirrored or turned by 180°, or it flew"
        return [CaptureIssue("position-mirrored", f"{text} backwards.", hint)]
    return []


def _contradicting(photos: Sequence[CheckedPhoto], positions: PositionList) -> list[CaptureIssue]:
    """Photos whose EXIF and XMP state different positions, where most photos' agree."""
    apart: dict[str, float] = {}
    resolved = positions.doubts.frozen | positions.doubts.by_xmp
    for photo in photos:
        gps, other = photo.exif.gps, xmp_place(photo.xmp)
        if photo.name in resolved or gps is None or other is None or not is_on_earth(gps.latitude, gps.longitude):
            continue
        if is_on_earth(other.latitude, other.longitude):
            places = [(gps.latitude, gps.longitude)], [(other.latitude, other.longitude)]
            apart[photo.name] = median_distance_m(*places)
    step = float(np.median(list(apart.values()))) if apart else 0.0
    limit = max(CONTRADICTION_M, CONTRADICTION_TIMES * step)
    names = tuple(sorted(name for name, metres in apart.items() if metres > limit))
    if step > ANOTHER_PLACE_M:
        text = f"EXIF and the drone's XMP place the photos {step:,.0f} m apart."
        return [CaptureIssue("position-contradiction", text, "EXIF's positions are used; were they rewritten?")]
    if not names:
        return []
    furthest = max(names, key=apart.__getitem__)
    text = f"EXIF and XMP state different positions: {list_names(names)} (up to {apart[furthest]:,.0f} m apart)."
    return [
        CaptureIssue("position-contradiction", text, "EXIF's are used: correct them, or restore the originals.", names)
    ]


def _lost_fix(positions: Sequence[Position]) -> list[CaptureIssue]:
    """Photos without the fix that most have, by the receiver's RTK flag, else by its standard deviations."""
    if not positions:
        return []
    fixed = {each.name: _is_fixed(each) for each in positions}
    lost = tuple(name for name, has in fixed.items() if not has)
    if not lost or len(lost) > (1.0 - MIN_RTK_SHARE) * len(positions):
        return []
    sigmas: Mapping[str, float] = {each.name: each.sigma_horizontal_m for each in positions}
    worst = max(sigmas[name] for name in lost)
    text = f"RTK was lost: {list_names(lost)} (their positions are accurate to {worst:.2g} m; the others' to "
    text += f"{np.median([sigmas[name] for name in fixed if fixed[name]]):.2g} m)."
    return [
        CaptureIssue("rtk-lost", text, "They get less weight; PPK, or flying them again with a fix, would help.", lost)
    ]


def _is_fixed(position: Position) -> bool:
    if position.rtk is not None and position.rtk != "fixed":
        return False
    return position.sigma_horizontal_m <= WELL_KNOWN_M
