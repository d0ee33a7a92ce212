"""Detection of control blunders: wrong CRS, swapped names, wrong coordinates; each is reported with a remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.joint_fit import (
    JointFit,
    JointObservations,
    Priors,
    critical,
    find_blunders,
    fit_jointly,
    misfit,
    studentised,
)
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.control.local_survey import LocalSurvey, Stations, locate_survey, observed_in
from splatpipe.pipeline.survey.crs.coordinate_readings import FAR_M, nearer_reading, shape_reading
from splatpipe.pipeline.survey.crs.geodesy import ecef_from_geodetic
from splatpipe.pipeline.survey.files.control_file import titled
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.points.located_points import SurveyPoint
from splatpipe.pipeline.survey.points.surveyed_points import Survey

DATUM_M = 20.0  # a larger height offset from the positions (and DATUM_SIGMAS) means another datum
DATUM_SIGMAS = 5.0
EXACT_M = 0.5  # sigma of positions that also tell a pole's length and another base station
EXACT_DATUM_M = 0.3  # least offset from such positions that is worth a warning
POLES_M = (1.0, 3.0)  # lengths of poles
DATUMS_APART_M = 150.0  # in height: geoids lie within 110 m of the ellipsoid, and barometers err by less
GEOID_BOUNDS_M = (-110.0, 90.0)  # heights of geoids above the ellipsoid, lowest and highest
SWAPPED_SHARE = 0.3  # largest share of two points' errors that remains if swapping their names explains them
WEAK_RATIO = 4.0  # model uncertainty over the control's own accuracy that is worth a warning
MIN_GSD = 3.0  # errors below this many ground pixels are not worth a message
CONTROL_HINT = "--set georef.control=none runs without control."


def require_near(survey: Survey, config: GeorefConfig, stations: Stations) -> Float64[np.ndarray, "n 3"]:
    """Return the survey's points in geographic coordinates, after checking that they are near the photos.

    Returns:
        Latitude, longitude, height (NaN if unknown).

    Raises:
        SplatpipeError: if they are elsewhere; the hint names a CRS that would match the photos, if any does.
    """
    try:
        geodetic = locate_survey(survey, config)
    except SplatpipeError as error:
        better = _better_reading(survey, stations)
        raise SplatpipeError(f"{survey.name}: {error}", f"{better or error.hint} {CONTROL_HINT}") from error
    if len(stations) == 0:
        return geodetic
    away = _distance_m(geodetic, stations)
    if away > FAR_M:
        better = _better_reading(survey, stations) or (
            "Check the CRS in its first line, and that east (or longitude) comes before north (or latitude)."
        )
        raise SplatpipeError(
            f"The points of {survey.name} lie {away / 1000.0:,.1f} km from the photos when read in"
            f" {survey.crs.text} ({survey.crs.name}).",
            f"{better} {CONTROL_HINT}",
        )
    return geodetic


def name_blunders(
    survey: Survey,
    site: LocalSurvey,
    model: SparseModel,
    start: tuple[Similarity, Priors],
    config: GeorefConfig,
    report: Reporter,
) -> Survey:
    """Return the survey without control points that contradict the rest; blunders, also of check points, are
    reported."""
    similarity, priors = start
    observed = observed_in(site, survey, model, similarity.scale, config.mark_sigma_px)
    control = [k for k, point in enumerate(survey.points) if point.role == "control" and point.found is not None]
    least = MIN_GSD * gsd_m(survey, model, similarity.scale)
    off = find_blunders(similarity, observed, priors, least)
    kept = np.ones(len(observed), dtype=bool)
    kept[list(off)] = False
    fit = fit_jointly(similarity, observed.only(kept), priors)
    suspects = {control[k] for k in off}
    for k, point in enumerate(survey.points):
        if point.role == "check" and point.found is not None and is_off(fit, site, point, k, least, config):
            suspects.add(k)
    points = list(survey.points)
    swapped = _swapped(sorted(suspects), survey, site, fit.similarity)
    for a, b in swapped:
        report.warning(
            f"The names {points[a].name} and {points[b].name} look swapped in {survey.name}:"
            " each is at the other's surveyed coordinates. Both are left out.",
            "Swap the two names, and run again.",
        )
        points[a] = points[a].left_out(f"it looks swapped with {points[b].name}")
        points[b] = points[b].left_out(f"it looks swapped with {points[a].name}")
    for k in sorted(suspects.difference(*swapped)):
        points[k] = _left_out_blunder(points[k], offset_of(points[k], site, k, fit.similarity), report)
    return survey.with_points(points)


@dataclass(frozen=True)
class _Offset:
    """Offset of a point from its surveyed position, estimated minus surveyed, metres; NaN for an unknown height."""

    enu: Float64[np.ndarray, " 3"]

    @property
    def length(self) -> float:
        return float(np.sqrt(np.nansum(self.enu**2)))

    def __str__(self) -> str:
        parts = [f"{name} {value:+.2f}" for name, value in zip(("east", "north", "up"), self.enu, strict=True)]
        return ", ".join(part for part, value in zip(parts, self.enu, strict=True) if np.isfinite(value)) + " m"


def offset_of(point: SurveyPoint, site: LocalSurvey, index: int, similarity: Similarity) -> _Offset:
    """Return a point's estimated minus its surveyed position."""
    assert point.found is not None
    off = similarity.apply(point.found.xyz[None])[0] - site.targets.enu[index]
    return _Offset(np.where(np.isfinite(site.targets.sigmas[index]), off, np.nan))


def is_off(
    fit: JointFit, site: LocalSurvey, point: SurveyPoint, index: int, least_m: float, config: GeorefConfig
) -> bool:
    """Return whether a point that was not used in a fit contradicts it."""
    if point.found is None or fit.degrees == 0:
        return False
    mark = fit.similarity.scale * config.mark_sigma_px * np.sqrt(np.trace(point.found.covariance) / 3.0)
    alone = JointObservations(
        point.found.xyz[None],
        site.targets.enu[index][None],
        np.hypot(site.targets.sigmas[index], mark)[None],
        np.full(1, -1, dtype=np.int64),
        np.ones(1, dtype=bool),
    )
    residual, sigmas = misfit(fit, alone, 0)
    known = int(np.isfinite(site.targets.sigmas[index]).sum())
    return studentised(residual, sigmas, known) > critical(fit.degrees) and float(np.linalg.norm(residual)) > least_m


def tell_heights_apart(fit: JointFit, survey: Survey, stations: Stations, report: Reporter) -> None:
    """Tell of heights that differ from the positions' as a pole's length, or a geoid from an ellipsoid, does.

    Neither can be tested: no other height is known. So they are named as possible.
    """
    if len(stations) == 0 or not stations.absolute or all(p.surveyed.z is None for p in survey.of_role("control")):
        return
    lift = fit.offsets[:, 2]  # heights of each flight's positions above those of the control, metres
    above = -float(lift[np.abs(lift).argmin()])
    sigma = float(np.median(stations.sigmas[:, 2]))
    side = "above" if above > 0.0 else "below"
    where = f"The heights of {survey.name} lie {abs(above):.2f} m {side} the photos' positions"
    follows = "The georeference follows the control."
    if sigma <= EXACT_M and POLES_M[0] <= above <= POLES_M[1] and above > DATUM_SIGMAS * sigma:
        report.warning(
            f"{where}, which are stated to {sigma:.2f} m.",
            f"Was a pole of that length not subtracted, or is the vertical datum another? {follows}",
        )
    elif max(EXACT_DATUM_M if sigma <= EXACT_M else DATUM_M, DATUM_SIGMAS * sigma) < abs(above) <= DATUMS_APART_M:
        possible = GEOID_BOUNDS_M[0] <= -above <= GEOID_BOUNDS_M[1]
        report.note(
            f"{where}: possibly one is above the geoid and the other above the ellipsoid,"
            f" which lie {GEOID_BOUNDS_M[0]:g} to {GEOID_BOUNDS_M[1]:+g} m apart. {follows}"
            if possible
            else f"{where}: their vertical datums differ. {follows}"
        )


def require_shape(survey: Survey, site: LocalSurvey, start: Similarity) -> None:
    """Refuse points that have the model's shape only when read by another convention.

    Args:
        survey: The points.
        site: Their coordinates.
        start: From the model to the world by the photos' positions.

    Raises:
        SplatpipeError: if a convention explains them that the stated one does not; the hint names it.
    """
    chosen = [k for k, point in enumerate(survey.points) if point.found is not None]
    places = [point.found.xyz for point in survey.points if point.found is not None]
    found = start.apply(np.array(places, dtype=np.float64).reshape(-1, 3))
    cause = shape_reading(found, site.targets.enu[chosen], np.isfinite(site.targets.sigmas[chosen, 2]))
    if cause is not None:
        reading, evidence = cause
        raise SplatpipeError(
            f"The points of {survey.name} do not have the shape that the photos show.",
            f"If {reading.cause}, {evidence.share:.0%} of them do: it looks like that. {reading.remedy} {CONTROL_HINT}",
        )


def warn_of_weak_control(fit: JointFit, observed: JointObservations, model: SparseModel, report: Reporter) -> None:
    """Warn if the control's geometry is weak (few points, in one corner or on a line), so that it extrapolates
    badly."""
    control = observed.sigmas[observed.is_control]
    if len(model.points) == 0 or len(control) == 0:
        return
    noise = max(fit.noise, 1.0)
    worth = noise * float(np.median(control[np.isfinite(control)]))
    measured = np.isfinite(control).any(axis=0)
    known = noise * float(np.median(fit.sigmas_at(model.points)[:, measured].max(axis=1)))
    if known > WEAK_RATIO * worth:
        report.warning(
            f"Away from its points, the control determines the model's position only to {known:.2f} m.",
            "Add control points spread over the site, not along one line.",
        )


def gsd_m(survey: Survey, model: SparseModel, scale: float) -> float:
    """Ground sampling distance, metres per pixel: the median over the marks; 0 without any."""
    sizes = []
    for point in survey.points:
        if point.found is None:
            continue
        for sighting in point.sightings:
            if sighting.index is not None and sighting.agrees:
                image = model.reconstruction.images[model.image_ids[sighting.index]]
                focal = model.reconstruction.cameras[image.camera_id].mean_focal_length()
                depth = float((image.cam_from_world() * point.found.xyz)[2])
                sizes.append(scale * depth / focal)
    return float(np.median(sizes)) if sizes else 0.0


def _left_out_blunder(point: SurveyPoint, off: _Offset, report: Reporter) -> SurveyPoint:
    if point.role == "check":
        report.warning(
            f"{titled('Check', point.name)} lies {off.length:.2f} m from its surveyed position ({off}).",
            "Check its coordinates and marks against the field book. It stays in the accuracy table.",
        )
        return point
    report.warning(
        f"{titled('Control', point.name)} is left out: the other points and the photos place it {off.length:.2f} m"
        f" from where it is surveyed ({off}).",
        "Check its coordinates and marks against the field book, correct the file, and run again.",
    )
    return point.left_out(f"it is {off.length:.2f} m off where the others and the photos have it")


def _swapped(
    suspects: Sequence[int], survey: Survey, site: LocalSurvey, similarity: Similarity
) -> list[tuple[int, int]]:
    """Return pairs of points that each lie at the other's surveyed position."""
    pairs: list[tuple[int, int]] = []
    taken: set[int] = set()
    for a in suspects:
        for b in suspects:
            if a < b and not {a, b} & taken:
                own = max(_gap(survey, site, similarity, a, a), _gap(survey, site, similarity, b, b))
                other = max(_gap(survey, site, similarity, a, b), _gap(survey, site, similarity, b, a))
                if other < SWAPPED_SHARE * own:
                    pairs.append((a, b))
                    taken |= {a, b}
    return pairs


def _gap(survey: Survey, site: LocalSurvey, similarity: Similarity, found: int, surveyed: int) -> float:
    """Distance from one point's estimated position to another's surveyed position, metres."""
    place = survey.points[found].found
    assert place is not None
    off = similarity.apply(place.xyz[None])[0] - site.targets.enu[surveyed]
    known = np.isfinite(site.targets.sigmas[surveyed])
    return float(np.linalg.norm(off[known]))


def _distance_m(geodetic: Float64[np.ndarray, "n 3"], stations: Stations) -> float:
    places = [np.column_stack([each[:, :2], np.zeros(len(each))]) for each in (geodetic, stations.geodetic)]
    centres = [np.median(ecef_from_geodetic(place), axis=0) for place in places]
    return float(np.linalg.norm(centres[0] - centres[1]))


def _better_reading(survey: Survey, stations: Stations) -> str:
    """A hint at the reading that would put the points near the photos; empty if there is none."""
    stated = np.array([[point.surveyed.x, point.surveyed.y] for point in survey.points], dtype=np.float64)
    return nearer_reading(stated.reshape(-1, 2), survey.crs, stations.geodetic)
