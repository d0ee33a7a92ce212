"""The frame that a model lies in, from the positions that its photos state."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.scene.alignment import Correspondences, DirectionPrior, SimilarityFit, robust_similarity
from splatpipe.pipeline.scene.frames import Frame
from splatpipe.pipeline.scene.geodesy import Origin
from splatpipe.stages.georef.flights import (
    bound,
    declared_datum,
    flights_json,
    shared_errors,
    tell_flights_apart,
    unbound,
)
from splatpipe.stages.georef.level import Positions, direction_prior
from splatpipe.stages.georef.model import SparseModel

MIN_POSITIONS = 3
ORIGIN_DIGITS = 5  # degrees: a metre; the origin then stays where it is when some photos come or go
MAX_SIGMA_SCALE = 0.2  # a scale known less well is no scale
MAX_SIGMA_ROTATION_RAD = math.radians(20.0)
SWAPPED_NOISE = 0.5  # of the residuals: what fits twice as well with swapped coordinates has them swapped
NADIR_PITCH_DEG = -60.0
HEIGHT_TOLERANCE = 0.1  # of the height above ground, against what the drone measured
NAMES_SHOWN = 10


class NoPlaceError(Exception):
    """The positions do not determine the frame; the text is the reason, a sentence without its full stop."""


def georeference(model: SparseModel, positions: Positions, max_error_m: float) -> tuple[Frame, SimilarityFit]:
    """The frame from positions, in the vertical datum that these declare.

    Raises:
        NoPlaceError: if they do not determine one.
    """
    chosen = np.array([_altitude(positions.by_name.get(name)) is not None for name in model.names], dtype=bool)
    names = [name for name, is_chosen in zip(model.names, chosen, strict=True) if is_chosen]
    if len(names) < MIN_POSITIONS:
        raise NoPlaceError(_why_few(model, positions, len(names)))
    records = [positions.by_name[name] for name in names]
    geodetic = np.array([[r["latitude"], r["longitude"], r["altitude_m"]] for r in records], dtype=np.float64)
    sigmas = np.array([[r["sigma_horizontal_m"]] * 2 + [r["sigma_vertical_m"]] for r in records], dtype=np.float64)
    origin = _origin(geodetic)
    points = Correspondences(model.centres[chosen], origin.enu_from_geodetic(geodetic), sigmas)
    points = replace(points, shared=shared_errors(records, sigmas))
    prior, prior_note = direction_prior(model, positions)
    try:
        if points.shared is not None:
            points = _bound(points, max_error_m)
        fit = _fit(points, max_error_m, prior)
    except NoPlaceError:
        _require_unswapped(points, geodetic, max_error_m, math.inf)
        raise
    if fit.noise > 1.0:
        _require_unswapped(points, geodetic, max_error_m, fit.noise)
    wrong = [name for name in model.names if name in positions.wrong]
    left_out = [name for name, inlier in zip(names, fit.inliers, strict=True) if not inlier]
    note = f"From the positions of {len(names) - len(left_out)} photos"
    note += f"; the rotation that they leave free is from {prior_note}." if fit.used_prior else "."
    residuals = {**_residuals(names, fit), "flights": flights_json(records, points, fit)}
    datum = declared_datum(records, points)
    return Frame("enu", fit.similarity, origin, datum, residuals, tuple(sorted(left_out + wrong)), note), fit


def _bound(points: Correspondences, max_error_m: float) -> Correspondences:
    """Which flights are apart, from a fit in which each has any offset; none where that determines nothing."""
    try:
        return bound(points, robust_similarity(unbound(points), max_error_m))
    except ValueError:
        return points


def _fit(points: Correspondences, max_error_m: float, prior: DirectionPrior) -> SimilarityFit:
    try:
        fit = robust_similarity(points, max_error_m, prior)
    except ValueError as error:
        raise NoPlaceError(f"the positions do not fit the model ({error})") from error
    _require_determined(fit, len(points))
    return fit


def _require_unswapped(
    points: Correspondences, geodetic: Float64[np.ndarray, "n 3"], max_error_m: float, noise: float
) -> None:
    """Refuse positions that fit far better with latitude and longitude swapped; a flat flight fits both ways a little.

    Args:
        points: The cameras, and their positions as stated.
        geodetic: The latter, as latitude and longitude (degrees) and height (metres).
        max_error_m: As for the fit.
        noise: What the residuals of the positions as stated are, over their sigmas.
    """
    swapped = geodetic[:, [1, 0, 2]]
    if np.abs(swapped[:, 0]).max() > 90.0:
        return
    target = _origin(swapped).enu_from_geodetic(swapped)
    try:
        fit = robust_similarity(replace(points, target=target), max_error_m)
        _require_determined(fit, len(points))
    except (ValueError, NoPlaceError):
        return
    if fit.noise < SWAPPED_NOISE * noise:
        raise NoPlaceError("the photo positions fit only with latitude and longitude swapped: correct them")


def _require_determined(fit: SimilarityFit, positions: int) -> None:
    inliers = int(fit.inliers.sum())
    if inliers < MIN_POSITIONS or 2 * inliers < positions:
        raise NoPlaceError(f"only {inliers} of {positions} photo positions agree with the model")
    if fit.sigma_scale > MAX_SIGMA_SCALE:
        raise NoPlaceError("the photos were taken too close together for the accuracy of their positions")
    if fit.sigma_rotation_rad > MAX_SIGMA_ROTATION_RAD:
        raise NoPlaceError("the photos were taken along a line, and nothing tells how the model is turned about it")


def _why_few(model: SparseModel, positions: Positions, usable: int) -> str:
    stated = sum(name in positions.by_name for name in model.names)
    if stated == 0:
        return "no photo of the model has a position"
    if usable < stated:
        return f"only {usable} photos of the model have a position with an altitude"
    return f"only {stated} photo{'s' if stated > 1 else ''} of the model {'have' if stated > 1 else 'has'} a position"


def _origin(geodetic: Float64[np.ndarray, "n 3"]) -> Origin:
    """A rounded median; longitudes are taken about the first, as they may straddle 180°."""
    first = geodetic[0, 1]
    longitude = first + float(np.median((geodetic[:, 1] - first + 180.0) % 360.0 - 180.0))
    return Origin(
        latitude=round(float(np.median(geodetic[:, 0])), ORIGIN_DIGITS),
        longitude=round((longitude + 180.0) % 360.0 - 180.0, ORIGIN_DIGITS),
        height_m=float(round(float(np.median(geodetic[:, 2])))),
    )


def _residuals(names: Sequence[str], fit: SimilarityFit) -> dict[str, Any]:
    used = fit.residuals[fit.inliers]
    return {
        "rmse_horizontal_m": _rms(used[:, :2]),
        "rmse_vertical_m": _rms(used[:, 2:]),
        "rmse_m": _rms(used),
        "photos_used": len(used),
        "over_stated_sigmas": fit.noise,
        "sigma_scale_percent": 100.0 * fit.sigma_scale,
        "sigma_rotation_deg": math.degrees(fit.sigma_rotation_rad),
        "photos": {name: residual.tolist() for name, residual in zip(names, fit.residuals, strict=True)},
    }


def _rms(residuals: Float64[np.ndarray, "n k"]) -> float:
    """Root mean square of the vectors' lengths."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def tell(frame: Frame, fit: SimilarityFit, model: SparseModel, positions: Positions, report: Reporter) -> None:
    """Warn of what is wrong with the positions, or weak about the fit."""
    tell_flights_apart(frame.residuals["flights"], report)
    if frame.left_out:
        shown = ", ".join(frame.left_out[:NAMES_SHOWN])
        more = f" and {len(frame.left_out) - NAMES_SHOWN} more" if len(frame.left_out) > NAMES_SHOWN else ""
        report.warning(
            f"The stated position of {len(frame.left_out)} photos is off and left out of the fit: {shown}{more}.",
            "The photos themselves are used.",
        )
    if fit.used_prior:
        report.warning("The photos were taken along a line: " + frame.note.partition("; ")[2])
    heights = _heights(frame, model, positions)
    if heights is not None and abs(heights[0] / heights[1] - 1.0) > HEIGHT_TOLERANCE:
        report.warning(
            f"The cameras are {heights[0]:.1f} m above the ground in the model, {heights[1]:.1f} m by the drone.",
            "On a flight at one height the focal length is hardly observable, and heights scale with it; or it took "
            "off from other ground.",
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
        value = json.loads(path.read_text(encoding="utf-8"))
        by_name = {record["name"]: record for record in value["positions"]}
        return Positions(by_name, value.get("orientations", {}), value.get("wrong", {}))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatpipeError(f"The positions {path} cannot be read: {error}", "Run with --rerun ingest.") from error
