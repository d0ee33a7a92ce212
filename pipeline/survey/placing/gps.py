"""Determine the model's frame from its photos' positions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.alignment import Correspondences, DirectionPrior, SimilarityFit, robust_similarity
from splatpipe.pipeline.photos.files.names import list_names
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.placing.assumed_heights import ASSUMED
from splatpipe.pipeline.survey.placing.fitting import (
    MAX_SIGMA_ROTATION_RAD,
    MAX_SIGMA_SCALE,
    MIN_POSITIONS,
    FrameUndeterminedError,
    PositionFit,
    capture_order,
    fit_positions,
    require_determined,
)
from splatpipe.pipeline.survey.placing.flight_offsets import (
    bound,
    declared_datum,
    flights_json,
    shared_errors,
    unbound,
    warn_of_flight_offsets,
)
from splatpipe.pipeline.survey.placing.level import Positions, known_directions
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.placing.position_spread import spread_of
from splatpipe.pipeline.survey.placing.up_witnesses import UpVerdict, check_up

ORIGIN_DIGITS = 5  # degrees: about a metre, so that the origin stays put when a few photos are added or removed
SWAPPED_NOISE_RATIO = 0.5  # noise with swapped coordinates over that as stated, below which they are swapped
POOR_NOISES = 2.0  # noise over the stated sigmas that is worth a warning
LINE_RAD = math.radians(60.0)  # if the rotation about an axis is no better determined, positions lie along that axis
NADIR_PITCH_DEG = -60.0
MAX_HEIGHT_DEVIATION = 0.1  # relative difference from the drone's height above ground that is worth a warning


def georeference(
    model: SparseModel, positions: Positions, max_error_m: float | Literal["auto"], photos: Mapping[str, Photo]
) -> tuple[Frame, PositionFit]:
    """Determine the frame from positions, in the vertical datum that these declare.

    Args:
        model: The sparse model.
        positions: The photos' stated positions.
        max_error_m: Positions further off are left out; ``auto``: those that are off by far more than the noise of all.
        photos: All photos of the capture by name; their times give the order in which they were taken.

    Raises:
        FrameUndeterminedError: if the positions do not determine a frame.
    """
    limit = None if max_error_m == "auto" else max_error_m
    usable = [name for name in model.names if _altitude(positions.by_name.get(name)) is not None]
    if len(usable) < MIN_POSITIONS:
        raise FrameUndeterminedError(_why_few(model, positions, len(usable)))
    times = {name: photos[name].time if name in photos else None for name in usable}
    names = capture_order(usable, positions.by_name, times)
    records = [positions.by_name[name] for name in names]
    if reason := spread_of([(r["latitude"], r["longitude"], r["altitude_m"]) for r in records]).too_few:
        raise FrameUndeterminedError(reason)
    index = {name: i for i, name in enumerate(model.names)}
    geodetic = np.array([[r["latitude"], r["longitude"], r["altitude_m"]] for r in records], dtype=np.float64)
    sigmas = np.array([[r["sigma_horizontal_m"]] * 2 + [r["sigma_vertical_m"]] for r in records], dtype=np.float64)
    origin = _origin(geodetic)
    source = model.centres[[index[name] for name in names]]
    points = Correspondences(source, origin.enu_from_geodetic(geodetic), sigmas)
    points = replace(points, shared=shared_errors(records, sigmas))
    flights = np.array([int(record.get("flight", 0)) for record in records], dtype=np.int64)
    directions = known_directions(model, positions)
    noise = math.inf
    try:
        if points.shared is not None:
            points = _bound(points, limit)
        robust = _robust(points, limit, directions.prior)
        noise = robust.noise
        try:
            fit = fit_positions(points, flights, robust, limit, directions, model.points)
        except np.linalg.LinAlgError as error:
            raise FrameUndeterminedError("the photo positions determine neither scale nor rotation") from error
        require_determined(fit, points)
        _require_upright(check_up(fit.noisy.similarity, model, positions, photos))
    except FrameUndeterminedError:
        _require_unswapped(points, geodetic, limit, noise)
        raise
    if noise > 1.0:
        _require_unswapped(points, geodetic, limit, noise)
    wrong = [name for name in model.names if name in positions.wrong]
    left_out = [name for name, inlier in zip(names, fit.inliers, strict=True) if not inlier]
    note = f"From the positions of {len(names) - len(left_out)} photos: {fit.uncertainty.sentence()}"
    note += f"; the rotation that they leave open is from {fit.held_by}." if fit.held_by else "."
    if any(record.get("altitude_source") == ASSUMED for record in records):
        fit = replace(fit, uncertainty=fit.uncertainty.without_heights(directions.prior.sigma_rad))
        note = f"From the horizontal positions of {len(names) - len(left_out)} photos: {fit.uncertainty.sentence()}."
        note += f" Up is from {directions.source}; heights are arbitrary: they count from the middle of the scene."
    residuals = {**_residuals(names, fit), "flights": flights_json(records, points, fit.noisy.offsets)}
    datum = declared_datum(records, points)
    return Frame("enu", fit.noisy.similarity, origin, datum, residuals, tuple(sorted(left_out + wrong)), note), fit


def _bound(points: Correspondences, limit: float | None) -> Correspondences:
    """Determine which flights are apart, by a fit with free offsets; none where that fit is undetermined."""
    try:
        return bound(points, robust_similarity(unbound(points), limit))
    except ValueError:
        return points


def _robust(points: Correspondences, limit: float | None, prior: DirectionPrior) -> SimilarityFit:
    try:
        fit = robust_similarity(points, limit, prior)
    except ValueError as error:
        raise FrameUndeterminedError(f"the positions do not fit the model ({error})") from error
    _require_agreement(fit, len(points))
    return fit


def _require_unswapped(
    points: Correspondences, geodetic: Float64[np.ndarray, "n 3"], limit: float | None, noise: float
) -> None:
    """Reject positions that fit far better with latitude and longitude swapped.

    A flat flight fits both ways to some degree.

    Args:
        points: The cameras, and their positions as stated.
        geodetic: The latter, as latitude and longitude (degrees) and height (metres).
        limit: As for the fit.
        noise: Residuals of the positions as stated, over their sigmas.
    """
    swapped = geodetic[:, [1, 0, 2]]
    if np.abs(swapped[:, 0]).max() > 90.0:
        return
    target = _origin(swapped).enu_from_geodetic(swapped)
    try:
        fit = robust_similarity(replace(points, target=target), limit)
        _require_agreement(fit, len(points))
    except (ValueError, FrameUndeterminedError):
        return
    determined = fit.sigma_scale <= MAX_SIGMA_SCALE and fit.sigma_rotation_rad <= MAX_SIGMA_ROTATION_RAD
    if determined and fit.noise < SWAPPED_NOISE_RATIO * noise:
        raise FrameUndeterminedError("the photo positions fit only with latitude and longitude swapped: correct them")


def _require_upright(verdict: UpVerdict) -> None:
    """Reject a placement that is upside down or mirrored by all that is known besides the positions."""
    if verdict.refuted:
        raise FrameUndeterminedError(
            f"the photo positions place the model upside down or mirrored: {verdict.sentence()}; a W or S that is "
            "missing, or latitude and longitude swapped, does that"
        )


def _require_agreement(fit: SimilarityFit, positions: int) -> None:
    inliers = int(fit.inliers.sum())
    if inliers < MIN_POSITIONS or 2 * inliers < positions:
        raise FrameUndeterminedError(f"only {inliers} of {positions} photo positions agree with the model")


def _why_few(model: SparseModel, positions: Positions, usable: int) -> str:
    stated = sum(name in positions.by_name for name in model.names)
    if stated == 0:
        return "no photo of the model has a position"
    records = [positions.by_name[name] for name in model.names if name in positions.by_name]
    if stated >= MIN_POSITIONS and (why := spread_of([(r["latitude"], r["longitude"], 0.0) for r in records]).too_few):
        return why
    if usable < stated:
        return f"only {usable} photos of the model have a position with an altitude"
    return f"only {stated} photo{'s' if stated > 1 else ''} of the model {'have' if stated > 1 else 'has'} a position"


def _origin(geodetic: Float64[np.ndarray, "n 3"]) -> Origin:
    """A rounded median; longitudes are taken relative to the first, as they may straddle 180°."""
    first = geodetic[0, 1]
    longitude = first + float(np.median((geodetic[:, 1] - first + 180.0) % 360.0 - 180.0))
    return Origin(
        latitude=round(float(np.median(geodetic[:, 0])), ORIGIN_DIGITS),
        longitude=round((longitude + 180.0) % 360.0 - 180.0, ORIGIN_DIGITS),
        height_m=float(round(float(np.median(geodetic[:, 2])))),
    )


def _residuals(names: Sequence[str], fit: PositionFit) -> dict[str, Any]:
    used = fit.residuals[fit.inliers]
    uncertainty = fit.uncertainty
    return {
        "rmse_horizontal_m": _rms(used[:, :2]),
        "rmse_vertical_m": _rms(used[:, 2:]) if uncertainty.heights_known else None,
        "rmse_m": _rms(used),
        "photos_used": len(used),
        "over_stated_sigmas": float(np.sqrt((uncertainty.noise.factors[[0, 0, 1]] ** 2).mean())),
        "sigma_scale_percent": 100.0 * uncertainty.scale,
        "sigma_rotation_deg": math.degrees(uncertainty.weakest_rad),
        "uncertainty": uncertainty.as_json(),
        "photos": dict(sorted(zip(names, fit.residuals.tolist(), strict=True))),
    }


def _rms(residuals: Float64[np.ndarray, "n k"]) -> float:
    """Root mean square of the vectors' lengths."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def report_fit(frame: Frame, fit: PositionFit, model: SparseModel, positions: Positions, report: Reporter) -> None:
    """Report how well the positions place the model; warn about wrong positions or a weak fit."""
    report.note(f"By the photos' positions alone: {fit.uncertainty.sentence()}.")
    _warn_of_noise(fit, frame, positions, report)
    _warn_of_directions(fit, report)
    report_frame(frame, model, positions, report)


def report_frame(frame: Frame, model: SparseModel, positions: Positions, report: Reporter) -> None:
    """Warn about flights in other datums, wrong positions, and heights that the drone knows otherwise."""
    warn_of_flight_offsets(frame.residuals["flights"], report)
    if frame.left_out:
        report.warning(
            f"The stated position of {len(frame.left_out)} photos is wrong and is left out of the fit: "
            f"{list_names(frame.left_out)}.",
            "The photos themselves are used.",
        )
    heights = _heights(frame, model, positions)
    if heights is not None and abs(heights[0] / heights[1] - 1.0) > MAX_HEIGHT_DEVIATION:
        report.warning(
            f"The cameras are {heights[0]:.1f} m above the ground in the model, {heights[1]:.1f} m according to "
            "the drone.",
            "At a single flying height the focal length is poorly determined, and heights scale with it; or the "
            "take-off "
            "point was at another ground height.",
        )


def _warn_of_noise(fit: PositionFit, frame: Frame, positions: Positions, report: Reporter) -> None:
    """Warn about positions that scatter by far more than their stated sigmas."""
    used = [positions.by_name[name] for name in frame.residuals["photos"]]
    factors = fit.uncertainty.noise.factors
    if float(factors.max()) > POOR_NOISES:
        axes = ("horizontal", "vertical")
        stated = [float(np.median([record[f"sigma_{axis}_m"] for record in used])) for axis in axes]
        across, height = (frame.residuals[f"rmse_{axis}_m"] for axis in axes)  # as in the report's table
        known = fit.uncertainty.heights_known
        off, expected = (f" and {height:.1f} m in height", f" and {stated[1]:g}") if known else ("", "")
        report.warning(
            f"The photos' positions are inaccurate: off by {across:.1f} m horizontally{off} "
            f"(RMS), where {stated[0]:g}{expected} m were expected. Result: {fit.uncertainty.sentence()}.",
            "Control points (gcp_list.txt), or better positions (positions.csv), would improve the georeference.",
        )


def _warn_of_directions(fit: PositionFit, report: Reporter) -> None:
    """Warn if the model's orientation comes from other directions than the positions."""
    if fit.contradicted_rad > 0.0:
        report.warning(
            f"The photos' positions would rotate the model by {math.degrees(fit.contradicted_rad):.0f}° against"
            f" {fit.held_by}: their error drifts along the flight. The model's orientation is mostly from the latter.",
            "Check that level ground is level in the result, or add control points.",
        )
    elif fit.held_by and fit.alone_rad > LINE_RAD:
        report.warning(f"The photos were taken along a line: the rotation about it is from {fit.held_by}.")
    elif fit.held_by:
        report.warning(
            f"The photos' positions determine the model's orientation only to {math.degrees(fit.alone_rad):.1f}°:"
            f" it is from {fit.held_by} as well."
        )


def _heights(frame: Frame, model: SparseModel, positions: Positions) -> tuple[float, float] | None:
    """Median height of nadir cameras above the ground: in the model, and above take-off by the drone."""
    relative: list[float] = []
    index: list[int] = []
    for i, name in enumerate(model.names):
        record = positions.by_name.get(name, {})
        height, pitch = record.get("relative_altitude_m"), record.get("pitch_deg")
        if height is not None and height > 1.0 and pitch is not None and pitch <= NADIR_PITCH_DEG:
            index.append(i)
            relative.append(height)
    if len(index) < MIN_POSITIONS or len(model.points) == 0:
        return None
    up = frame.world_from_model.apply(model.points)[:, 2]
    cameras = frame.world_from_model.apply(model.centres[index])[:, 2]
    return float(np.median(cameras) - np.median(up)), float(np.median(relative))


def _altitude(record: Mapping[str, Any] | None) -> float | None:
    return None if record is None else record["altitude_m"]


def read_positions(path: Path) -> Positions:
    """Read ``positions.json``.

    Raises:
        SplatpipeError: if it is missing or broken.
    """
    try:
        value = read_json(path)
        by_name = {record["name"]: record for record in value["positions"]}
        return Positions(by_name, value.get("orientations", {}), value.get("wrong", {}), value.get("elsewhere", {}))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatpipeError(f"The positions {path} cannot be read: {error}", "Run with --rerun ingest.") from error
