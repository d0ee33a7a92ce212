"""Checks positions, footprints and control points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from splatpipe.pipeline.app.preflight.findings import ControlPlace, Finding, Place
from splatpipe.pipeline.app.preflight.intake import Intake
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.names import NameFinder, list_names
from splatpipe.pipeline.sfm.pairing.footprints import MAX_DISTANCE_RATIO, MIN_HEIGHT_M, StatedPoses
from splatpipe.pipeline.sfm.pairing.layout import EARTH_RADIUS_M
from splatpipe.pipeline.survey.crs.coordinate_readings import nearer_reading
from splatpipe.pipeline.survey.crs.crs import Crs, to_geodetic
from splatpipe.pipeline.survey.files.control_file import ControlFile, read_control_file
from splatpipe.pipeline.survey.files.scale_bars import read_scale_bars
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.points.surveyed_points import check_names, missing_photos, name_hint

OUTSIDE_SHARE = 0.3  # share of marks outside their photos above which these had another size, which ends a run
ELSEWHERE_M = 1000.0  # from the photos: another zone or another CRS
REACH_SPACINGS, MIN_REACH_M = 3.0, 60.0  # around photos whose viewing direction is unknown


def origin_of(intake: Intake) -> tuple[float, float] | None:
    """Latitude and longitude of the layout's origin."""
    first = next(iter(intake.positions.positions), None)
    return None if first is None else (first.latitude, first.longitude)


def footprint(views: StatedPoses | None, photo: int) -> tuple[Place, ...] | None:
    """Corners of a photo's ground footprint, limited in range; None if unknown."""
    if views is None or not bool(views.known()[photo]):
        return None
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    rays = np.concatenate([signs * views.half_size[photo], np.ones((4, 1))], axis=1) @ views.enu_from_camera[photo].T
    height = max(float(views.centres_m[photo, 2] - views.ground_m[photo]), MIN_HEIGHT_M)
    reach = MAX_DISTANCE_RATIO * height
    corners = []
    for ray in rays:
        flat = float(np.hypot(ray[0], ray[1]))
        distance = height * flat / -ray[2] if ray[2] < 0.0 else np.inf
        step = ray[:2] / max(flat, 1e-9) * min(distance, reach)
        corner = views.centres_m[photo, :2] + step
        corners.append((round(float(corner[0]), 2), round(float(corner[1]), 2)))
    return tuple(corners)


def control_findings(path: Path, intake: Intake, georef: GeorefConfig) -> tuple[list[Finding], list[ControlPlace]]:
    """Read the GCP file as a run does, and compare it with the photos.

    Args:
        path: The file.
        intake: The photos.
        georef: How the file is to be read.
    """
    try:
        file = read_control_file(path)
    except SplatpipeError as error:
        return [Finding("control-broken", "error", error.message, error.hint)], []
    findings = _mark_findings(path.name, file, intake, 0.5 if georef.pixel_origin == "centre" else 0.0)
    if not intake.positions.positions:
        return findings, []
    rows = np.array([[p.x, p.y, np.nan if p.z is None else p.z] for p in file.points], dtype=np.float64)
    try:
        located = to_geodetic(rows, file.crs, bool(georef.approximate_crs)).geodetic
    except SplatpipeError as error:
        hint = _reading_of(rows, file.crs, intake) or error.hint
        return [*findings, Finding("control-broken", "error", error.message, hint)], []
    origin = origin_of(intake)
    assert origin is not None
    east = np.radians(located[:, 1] - origin[1]) * np.cos(np.radians(origin[0])) * EARTH_RADIUS_M
    north = np.radians(located[:, 0] - origin[0]) * EARTH_RADIUS_M
    points = np.stack([east, north], axis=1)
    checks = check_names(
        [point.name for point in file.points], {p.name: p.role for p in file.points}, georef.check_points
    )
    places = [
        ControlPlace(
            point.name,
            "check" if point.name in checks else "control",
            (round(float(at[0]), 2), round(float(at[1]), 2)),
            _count_showing_photos(at, intake),
            len({mark.photo for mark in point.marks}),
        )
        for point, at in zip(file.points, points, strict=True)
    ]
    better = _reading_of(rows, file.crs, intake)
    return [*findings, *_outside(path.name, places, points, intake, better)], places


def _reading_of(rows: Float64[np.ndarray, "n 3"], crs: Crs, intake: Intake) -> str:
    """A hint at how to read points that lie far from the photos; empty where none helps."""
    photos = [[each.latitude, each.longitude, 0.0] for each in intake.positions.positions]
    return nearer_reading(rows[:, :2], crs, np.array(photos, dtype=np.float64).reshape(-1, 3))


def scale_bar_findings(path: Path) -> list[Finding]:
    """Problems with the scale bars file, if any."""
    if not path.is_file():
        return []
    try:
        read_scale_bars(path)
    except SplatpipeError as error:
        return [Finding("scale-bars", "error", error.message, error.hint)]
    return []


def _mark_findings(name: str, file: ControlFile, intake: Intake, half_pixel: float) -> list[Finding]:
    sizes = {photo.name: (photo.width, photo.height) for photo in intake.photos}
    find = NameFinder(sorted(sizes))
    marks = [(point.name, mark, find(mark.photo)) for point in file.points for mark in point.marks]
    missing = sorted({mark.photo for _, mark, photo in marks if photo is None})
    outside = []
    for point, mark, photo in marks:
        if photo is not None:
            width, height = sizes[photo]
            x, y = mark.x + half_pixel, mark.y + half_pixel
            if not (0.0 <= x <= width and 0.0 <= y <= height):
                outside.append(f"{point} in {photo}")
    findings = []
    if marks and all(photo is None for _, _, photo in marks):
        text = f"None of the photos that {name} names can be found in this capture: {list_names(missing)}."
        hint = name_hint(missing, sizes) or "Check that the file belongs to these photos."
        return [Finding("control-broken", "error", text, hint)]
    if missing:
        text = f"{name} names {missing_photos(missing)}."
        hint = name_hint(missing, sizes) or "Correct the names, or add the photos."
        findings.append(Finding("control-marks", "warning", text, f"Their marks are ignored. {hint}"))
    if outside:
        severe = len(outside) > OUTSIDE_SHARE * len(marks)
        text = f"{len(outside)} of {len(marks)} marks of {name} lie outside of their photos: {list_names(outside)}."
        hint = "Were they made in photos that were resized or rotated?"
        if all(mark.y <= 0.0 for _, mark, _ in marks):
            hint = "All pixel rows are negative, as QGIS writes them: omit their minus signs."
        findings.append(Finding("control-marks", "error" if severe else "warning", text, hint))
    return findings


def _count_showing_photos(at: Float64[np.ndarray, " 2"], intake: Intake) -> int | None:
    """The number of photos that may show a place on the ground; None if their poses are unknown."""
    views = intake.layout.views
    if views is None:
        return None
    known = np.flatnonzero(views.known())
    point = np.stack([np.append(at, views.ground_m[k]) for k in known])
    in_camera = np.einsum("kx,kxc->kc", point - views.centres_m[known], views.enu_from_camera[known])
    depth = in_camera[:, 2]
    inside = (np.abs(in_camera[:, :2]) <= views.half_size[known] * np.maximum(depth, 0.0)[:, None]).all(axis=1)
    return int(np.count_nonzero(inside & (depth > 0.0)))


def _outside(
    name: str, places: Sequence[ControlPlace], points: Float64[np.ndarray, "n 2"], intake: Intake, better: str
) -> list[Finding]:
    """Points that no photo can show."""
    positions = intake.layout.positions_m[intake.layout.located(), :2]
    if not len(positions) or not len(points):
        return []
    tree = cKDTree(positions)
    nearest = np.full(len(points), np.inf)
    placed = np.isfinite(points).all(axis=1)
    nearest[placed] = tree.query(points[placed])[0]
    if float(np.median(nearest)) > ELSEWHERE_M:
        text = f"The points of {name} lie {np.median(nearest) / 1000.0:,.1f} km from the photos."
        return [
            Finding("control-outside", "error", text, better or "Check the CRS, its zone, and that east comes first.")
        ]
    spacing = float(np.median(tree.query(positions, k=2)[0][:, 1])) if len(positions) > 1 else 0.0
    reach = max(MIN_REACH_M, REACH_SPACINGS * spacing)
    off = [
        place.name
        for place, metres in zip(places, nearest.tolist(), strict=True)
        if metres > MAX_DISTANCE_RATIO * reach or (not place.marks and _is_beyond(place.photos, metres, reach))
    ]
    if not off:
        return []
    text = f"Points of {name} outside the view of all photos: {list_names(off)}."
    return [Finding("control-outside", "warning", text, "Check their coordinates, or take photos around them.")]


def _is_beyond(photos: int | None, metres: float, reach_m: float) -> bool:
    """Whether no photo shows a point, judged by footprints or, if these are unknown, by distance."""
    return metres > reach_m if photos is None else photos == 0
