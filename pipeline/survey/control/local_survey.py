"""Set a model's frame by ground control, with the photos' positions where there are any."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.alignment import Correspondences, DirectionPrior, robust_similarity
from splatpipe.pipeline.geometry.joint_fit import JointFit, JointObservations, Priors
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.geometry.upright import rotation_to_up
from splatpipe.pipeline.survey.crs.crs import to_geodetic
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.assumed_heights import ASSUMED
from splatpipe.pipeline.survey.placing.fitting import MIN_POSITIONS, FrameUndeterminedError
from splatpipe.pipeline.survey.placing.gps import ORIGIN_DIGITS
from splatpipe.pipeline.survey.placing.level import UP_SIGMA_RAD, Positions, upright_cameras
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.points.surveyed_points import Survey

MIN_CONTROL = 3  # without positions
INLIER_SHARE = 0.05  # largest miss of an inlier to a hypothesis, over the control's extent
OFFSET_SIGMA_M = 2.0  # least sigma of a flight's common offset: a base station's coordinates
OFFSET_SIGMAS = 3.0  # times the positions' sigmas
DATUM_SIGMA_M = 1000.0  # sigma of a flight's offset in height: control and receivers need not share a datum
MIN_EXTENT_M = 0.01  # extent of control points below which they count as one
MAX_MISFIT_SHARE = 0.25  # error of a fit over the control's extent, above which it is rejected


@dataclass(frozen=True)
class Stations:
    """The photos' positions that are used.

    Attributes:
        names: Of the photos.
        indices: The photos' indices in the model.
        geodetic: Latitude, longitude, height.
        sigmas: Standard deviations of east, north, up, metres.
        group: Index of the flight.
        flights: Their numbers, by that index.
        absolute: Whether their heights are above a datum; else above take-off, or assumed.
        with_heights: Whether their heights are stated; else they are the model's own.
    """

    names: tuple[str, ...]
    indices: Int64[np.ndarray, " n"]
    geodetic: Float64[np.ndarray, "n 3"]
    sigmas: Float64[np.ndarray, "n 3"]
    group: Int64[np.ndarray, " n"]
    flights: tuple[int, ...]
    absolute: bool = True
    with_heights: bool = True

    def __len__(self) -> int:
        return len(self.names)

    def offset_sigmas(self) -> Float64[np.ndarray, "k 3"]:
        """Standard deviations (metres) of the offset that all positions of a flight share."""
        own = np.array([np.median(self.sigmas[self.group == k], axis=0) for k in range(len(self.flights))])
        result = np.maximum(OFFSET_SIGMA_M, OFFSET_SIGMAS * own.reshape(-1, 3))
        result[:, 2] = DATUM_SIGMA_M
        return result


@dataclass(frozen=True)
class Targets:
    """The surveyed positions of the survey's points, in its order.

    Attributes:
        enu: East, north, up; up is 0 where unknown.
        sigmas: Of the survey; infinite where unknown.
        geodetic: Latitude, longitude, height (NaN where unknown).
    """

    enu: Float64[np.ndarray, "n 3"]
    sigmas: Float64[np.ndarray, "n 3"]
    geodetic: Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class LocalSurvey:
    """The world's origin, and the known positions in it.

    Attributes:
        origin: Of the world.
        targets: The survey's points.
        stations: The photos' positions.
        station_enu: The same in the world.
    """

    origin: Origin
    targets: Targets
    stations: Stations
    station_enu: Float64[np.ndarray, "n 3"]


def stations_of(model: SparseModel, positions: Positions, frame: Frame | None) -> Stations:
    """The inliers of the fit of positions; none where the fit failed."""
    left_out = set() if frame is None else set(frame.left_out)
    rows = []
    for index, name in enumerate(model.names):
        record = positions.by_name.get(name)
        if frame is not None and record is not None and record["altitude_m"] is not None and name not in left_out:
            rows.append((name, index, record))
    flights = sorted({int(record.get("flight", 0)) for _, _, record in rows})
    worse = np.ones(2) if frame is None else _worse_than_stated(frame)
    geodetic = [[r["latitude"], r["longitude"], r["altitude_m"]] for _, _, r in rows]
    sigmas = [[r["sigma_horizontal_m"]] * 2 + [r["sigma_vertical_m"]] for _, _, r in rows]
    return Stations(
        tuple(name for name, _, _ in rows),
        np.array([index for _, index, _ in rows], dtype=np.int64),
        np.array(geodetic, dtype=np.float64).reshape(-1, 3),
        np.array(sigmas, dtype=np.float64).reshape(-1, 3) * worse[[0, 0, 1]],
        np.array([flights.index(int(r.get("flight", 0))) for _, _, r in rows], dtype=np.int64),
        tuple(flights),
        all(record.get("altitude_source", "") not in ("takeoff", ASSUMED) for _, _, record in rows),
        all(record.get("altitude_source", "") != ASSUMED for _, _, record in rows),
    )


def _worse_than_stated(frame: Frame) -> Float64[np.ndarray, " 2"]:
    """Factors, at least 1, by which positions count as worse than stated, horizontally and in height.

    The mean of many errors with correlation r between neighbours is as uncertain as that of independent errors that are
    larger by the square root of (1 + r) / (1 - r).
    """
    uncertainty = frame.residuals.get("uncertainty", {})
    factors = np.array(uncertainty.get("noise_over_stated", [1.0, 1.0]), dtype=np.float64)
    correlations = np.array(uncertainty.get("noise_correlation", [0.0, 0.0]), dtype=np.float64)
    return np.asarray(np.maximum(1.0, factors * np.sqrt((1.0 + correlations) / (1.0 - correlations))))


def locate_survey(survey: Survey, config: GeorefConfig) -> Float64[np.ndarray, "n 3"]:
    """Latitude, longitude and height (NaN where unknown) of the survey's points."""
    stated = [[p.surveyed.x, p.surveyed.y, math.nan if p.surveyed.z is None else p.surveyed.z] for p in survey.points]
    return to_geodetic(np.array(stated, dtype=np.float64), survey.crs, config.approximate_crs).geodetic


def make_site(
    survey: Survey, geodetic: Float64[np.ndarray, "n 3"], stations: Stations, frame: Frame | None, config: GeorefConfig
) -> LocalSurvey:
    """The world of a capture: its zero is that of the positions' frame, at the height of the control."""
    heights = geodetic[np.isfinite(geodetic[:, 2]), 2]
    if frame is not None and frame.origin is not None:
        latitude, longitude, height = frame.origin.latitude, frame.origin.longitude, frame.origin.height_m
    else:
        first = geodetic[0, 1]
        longitude = first + float(np.median((geodetic[:, 1] - first + 180.0) % 360.0 - 180.0))
        latitude = round(float(np.median(geodetic[:, 0])), ORIGIN_DIGITS)
        longitude, height = round((longitude + 180.0) % 360.0 - 180.0, ORIGIN_DIGITS), 0.0
    if len(heights):
        height = float(round(float(np.median(heights))))
    origin = Origin(latitude, longitude, height)
    known = np.isfinite(geodetic[:, 2])
    enu = origin.enu_from_geodetic(np.where(np.isfinite(geodetic), geodetic, height))
    sigmas = [
        [p.surveyed.sigma_m[0] or config.control_sigma_m] * 2
        + [p.surveyed.sigma_m[1] or config.control_sigma_vertical_m]
        for p in survey.points
    ]
    spread = np.array(sigmas, dtype=np.float64)
    spread[~known, 2], enu[~known, 2] = np.inf, 0.0
    return LocalSurvey(origin, Targets(enu, spread, geodetic), stations, origin.enu_from_geodetic(stations.geodetic))


def observed_in(
    site: LocalSurvey, survey: Survey, model: SparseModel, scale: float, mark_sigma_px: float
) -> JointObservations:
    """Control (first, in the survey's order) and positions, with sigmas that include the marks'."""
    chosen = [k for k, point in enumerate(survey.points) if point.role == "control" and point.found is not None]
    found = [survey.points[k].found for k in chosen]
    source = np.array([each.xyz for each in found if each is not None], dtype=np.float64).reshape(-1, 3)
    marks = np.array(
        [
            scale * mark_sigma_px * math.sqrt(float(np.trace(each.covariance)) / 3.0)
            for each in found
            if each is not None
        ]
    )
    sigmas = np.hypot(site.targets.sigmas[chosen], marks.reshape(-1, 1))
    count = len(site.stations)
    return JointObservations(
        np.concatenate([source, model.centres[site.stations.indices]]),
        np.concatenate([site.targets.enu[chosen], site.station_enu]),
        np.concatenate([sigmas, site.stations.sigmas]),
        np.concatenate([np.full(len(chosen), -1, dtype=np.int64), site.stations.group]),
        np.arange(len(chosen) + count) < len(chosen),
    )


def start_similarity(
    site: LocalSurvey, survey: Survey, model: SparseModel, positions: Positions, frame: Frame | None
) -> tuple[Similarity, Priors]:
    """An initial world-from-model similarity, and what else constrains the fit.

    Raises:
        FrameUndeterminedError: if there are neither positions nor enough control.
        SplatpipeError: if the control does not fit the model at all.
    """
    offsets = site.stations.offset_sigmas()
    control = [k for k, point in enumerate(survey.points) if point.role == "control" and point.found is not None]
    source = np.array([_place(survey, k) for k in control], dtype=np.float64).reshape(-1, 3)
    target, sigmas = site.targets.enu[control], site.targets.sigmas[control]
    known = np.isfinite(sigmas[:, 2])
    if frame is not None and len(site.stations) >= MIN_POSITIONS:
        assert frame.origin is not None
        start = frame.world_from_model
        lift = np.median(target[known, 2] - start.apply(source)[known, 2]) if known.any() else 0.0
        if not known.any():
            lift = frame.origin.height_m - site.origin.height_m
        lifted = start.translation + np.array([0.0, 0.0, float(lift)])
        return Similarity(start.scale, start.rotation, lifted), Priors(offsets)
    if len(control) < MIN_CONTROL:
        raise FrameUndeterminedError(
            f"only {len(control)} of the control points can be used, where without positions it takes {MIN_CONTROL}"
        )
    up = upright_cameras(model, positions).up
    prior = DirectionPrior(up[None], np.array([[0.0, 0.0, 1.0]]), UP_SIGMA_RAD)
    if known.sum() >= MIN_CONTROL:
        extent = float(np.linalg.norm(np.ptp(target[known], axis=0)))
        points = Correspondences(source[known], target[known], sigmas[known])
        try:
            found = robust_similarity(points, max(1.0, INLIER_SHARE * extent), prior)
        except ValueError as error:
            raise FrameUndeterminedError(f"the control points do not determine the frame ({error})") from error
        return found.similarity, Priors(offsets, prior if found.used_prior else None)
    return _levelled(source, target, up), Priors(offsets, prior)


def _place(survey: Survey, index: int) -> Float64[np.ndarray, " 3"]:
    found = survey.points[index].found
    assert found is not None
    return found.xyz


def _levelled(
    source: Float64[np.ndarray, "n 3"], target: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, " 3"]
) -> Similarity:
    """Scale, heading and position by horizontal control, for a model levelled by its cameras' orientations."""
    level = rotation_to_up(up)
    flat = source @ level.T
    a, b = flat[:, 0] + 1j * flat[:, 1], target[:, 0] + 1j * target[:, 1]
    factor = np.vdot(a - a.mean(), b - b.mean()) / max(float(np.vdot(a - a.mean(), a - a.mean()).real), 1e-300)
    scale, angle = max(abs(complex(factor)), 1e-12), math.atan2(factor.imag, factor.real)
    turn = np.array(
        [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    rotation = turn @ level
    centre = np.array([target[:, 0].mean(), target[:, 1].mean(), 0.0])
    return Similarity(scale, rotation, centre - scale * (rotation @ source.mean(axis=0)))


def require_fit(fit: JointFit, observed: JointObservations, survey: Survey) -> None:
    """Reject control whose shape differs from the model's.

    Raises:
        SplatpipeError: if it misses the model by a large part of its own extent.
    """
    control = observed.is_control
    if control.sum() < MIN_CONTROL:
        return
    known = np.isfinite(observed.sigmas[control])
    error = float(np.sqrt((np.where(known, fit.residuals[control], 0.0) ** 2).sum(axis=1).mean()))
    extent = float(np.linalg.norm(np.ptp(observed.target[control], axis=0)))
    if extent < MIN_EXTENT_M:
        raise SplatpipeError(
            f"All control points of {survey.name} have the same coordinates.",
            "Each name needs its own coordinates: was one line copied to all?",
        )
    if error > MAX_MISFIT_SHARE * extent:
        raise SplatpipeError(
            f"The control points of {survey.name} do not fit the model: they are {error:,.1f} m off"
            f" over an extent of {extent:,.1f} m.",
            f"Check the CRS in its first line ({survey.crs.text}), the order of the coordinates (east first), and that"
            " names and marks match.",
        )
    if not math.isfinite(error):
        raise SplatpipeError(f"The control points of {survey.name} do not fit the model.", "Check its coordinates.")


def with_sigmas_times(observed: JointObservations, factor: float) -> JointObservations:
    """The same observations, with the control's sigmas multiplied by a factor."""
    scale = np.where(observed.is_control, factor, 1.0)[:, None]
    return replace(observed, sigmas=observed.sigmas * scale)
