"""Georef: the frame that a model lies in, from the photos' positions or, without them, from how cameras are held."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.scene.alignment import Correspondences, DirectionPrior, SimilarityFit, robust_similarity
from splatpipe.pipeline.scene.frames import Frame, save_frame
from splatpipe.pipeline.scene.geodesy import Origin
from splatpipe.pipeline.scene.names import match_names
from splatpipe.pipeline.scene.photos import load_photo_list
from splatpipe.pipeline.scene.similarity import Similarity
from splatpipe.pipeline.scene.upright import (
    Upright,
    camera_axes,
    display_from_stored,
    enu_from_gimbal,
    mean_rotation,
    rotation_to_up,
    up_from_cameras,
)
from splatpipe.stages.line import GeorefConfig

MIN_POSITIONS = 3
ORIGIN_DIGITS = 5  # degrees: a metre; the origin then stays where it is when some photos come or go
MAX_SIGMA_SCALE = 0.2  # a scale known less well is no scale
MAX_SIGMA_ROTATION_RAD = math.radians(20.0)
GIMBAL_SIGMA_RAD = math.radians(3.0)  # its compass errs by some degrees
GIMBAL_SPREAD_RAD = math.radians(15.0)  # angles that agree less with the model are in another convention
UP_SIGMA_RAD = math.radians(5.0)
NADIR_PITCH_DEG = -60.0
HEIGHT_TOLERANCE = 0.1  # of the height above ground, against what the drone measured
NAMES_SHOWN = 10


@dataclass(frozen=True)
class _Model:
    """What georef needs of a sparse model, its photos sorted by name.

    Attributes:
        names: Of the registered photos, as ingest has them; as the model has them where ingest does not know them.
        centres: Camera centres.
        cam_from_model: Rotations.
        points: Of the sparse cloud.
    """

    names: list[str]
    centres: Float64[np.ndarray, "n 3"]
    cam_from_model: Float64[np.ndarray, "n 3 3"]
    points: Float64[np.ndarray, "m 3"]


@dataclass(frozen=True)
class _Positions:
    """``positions.json``: records by photo name, and EXIF orientations where they are not 1."""

    by_name: Mapping[str, Mapping[str, Any]]
    orientations: Mapping[str, int]


class _NoPlaceError(Exception):
    """The positions do not determine the frame; the text is the reason, a sentence without its full stop."""


def run(config: GeorefConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the parts frame (``frame.json``) and model (the sparse model, byte for byte).

    Raises:
        SplatpipeError: if the model cannot be read or has no photos.
    """
    source = inputs["sparse.model"]
    report.progress(0, 2, "reading the model", "steps")
    model = _read_model(source, load_photo_list(inputs["ingest.photos"]).by_name())
    positions = _read_positions(inputs["ingest.positions"])
    report.progress(1, 2, "fitting the positions", "steps")
    used = 0
    try:
        frame, fit = _georeference(model, positions, config.max_position_error_m)
        used = int(fit.inliers.sum())
        _tell(frame, fit, model, positions, report)
    except _NoPlaceError as error:
        frame = _arbitrary(model, positions, str(error))
        report.warning(f"Arbitrary scale: {error}.", "Lengths and heights in this result have no unit.")
    save_frame(frame, out / "frame.json")
    _copy_model(source, out / "sparse" / "0", may_link=inputs.photos_dir not in source.parents)
    report.progress(2, 2, "fitting the positions", "steps")
    residuals = {key: value for key, value in frame.residuals.items() if key.startswith("rmse")}
    return {
        "kind": frame.kind,
        "note": frame.note,
        "positions_used": used,
        "positions_left_out": len(frame.left_out),
        **residuals,
    }


def _georeference(model: _Model, positions: _Positions, max_error_m: float) -> tuple[Frame, SimilarityFit]:
    """The frame from positions.

    Raises:
        _NoPlaceError: if they do not determine one.
    """
    chosen = np.array([_altitude(positions.by_name.get(name)) is not None for name in model.names], dtype=bool)
    names = [name for name, is_chosen in zip(model.names, chosen, strict=True) if is_chosen]
    if len(names) < MIN_POSITIONS:
        raise _NoPlaceError(_why_few(model, positions, len(names)))
    records = [positions.by_name[name] for name in names]
    geodetic = np.array([[r["latitude"], r["longitude"], r["altitude_m"]] for r in records], dtype=np.float64)
    sigmas = np.array([[r["sigma_horizontal_m"]] * 2 + [r["sigma_vertical_m"]] for r in records], dtype=np.float64)
    origin = _origin(geodetic)
    points = Correspondences(model.centres[chosen], origin.enu_from_geodetic(geodetic), sigmas)
    prior, prior_note = _direction_prior(model, positions)
    try:
        fit = robust_similarity(points, max_error_m, prior)
    except ValueError as error:
        raise _NoPlaceError(f"the positions do not fit the model ({error})") from error
    _require_determined(fit, len(names))
    left_out = tuple(name for name, inlier in zip(names, fit.inliers, strict=True) if not inlier)
    note = f"From the positions of {len(names) - len(left_out)} photos"
    note += f"; the rotation that they leave free is from {prior_note}." if fit.used_prior else "."
    residuals = _residuals(names, fit)
    return Frame("enu", fit.similarity, origin, "unknown", residuals, left_out, note), fit


def _require_determined(fit: SimilarityFit, positions: int) -> None:
    inliers = int(fit.inliers.sum())
    if inliers < MIN_POSITIONS or 2 * inliers < positions:
        raise _NoPlaceError(f"only {inliers} of {positions} photo positions agree with the model")
    if fit.sigma_scale > MAX_SIGMA_SCALE:
        raise _NoPlaceError("the photos were taken too close together for the accuracy of their positions")
    if fit.sigma_rotation_rad > MAX_SIGMA_ROTATION_RAD:
        raise _NoPlaceError("the photos were taken along a line, and nothing tells how the model is turned about it")


def _why_few(model: _Model, positions: _Positions, usable: int) -> str:
    stated = sum(name in positions.by_name for name in model.names)
    if stated == 0:
        return "no photo of the model has a position"
    if usable < stated:
        return f"only {usable} photos of the model have a position with an altitude"
    return f"only {stated} photo{'s' if stated > 1 else ''} of the model {'have' if stated > 1 else 'has'} a position"


def _arbitrary(model: _Model, positions: _Positions, reason: str) -> Frame:
    """Up is +z; scale and place stay the model's."""
    gimbal = _gimbal_rotation(model, positions)
    if gimbal is not None:
        similarity, source = Similarity(1.0, gimbal, np.zeros(3)), "the gimbal's angles"
    else:
        upright = _upright(model, positions)
        similarity, source = Similarity(1.0, rotation_to_up(upright.up), np.zeros(3)), upright.source
    return Frame("arbitrary", similarity, note=f"Arbitrary scale: {reason}. Up is from {source}.")


def _direction_prior(model: _Model, positions: _Positions) -> tuple[DirectionPrior, str]:
    gimbal = _gimbal_rotation(model, positions)
    if gimbal is not None:
        return DirectionPrior(gimbal, np.eye(3), GIMBAL_SIGMA_RAD), "the gimbal's angles"
    upright = _upright(model, positions)
    return DirectionPrior(upright.up[None], np.array([[0.0, 0.0, 1.0]]), UP_SIGMA_RAD), upright.source


def _gimbal_rotation(model: _Model, positions: _Positions) -> Float64[np.ndarray, "3 3"] | None:
    """Rotation from the model to east-north-up by the gimbal's angles; None where these do not agree with the model."""
    keys = ("yaw_deg", "pitch_deg", "roll_deg")
    records = [positions.by_name.get(name, {}) for name in model.names]
    index = [i for i, record in enumerate(records) if all(record.get(key) is not None for key in keys)]
    if len(index) < MIN_POSITIONS:
        return None
    yaw, pitch, roll = (np.array([records[i][key] for i in index], dtype=np.float64) for key in keys)
    turns = np.stack([display_from_stored(positions.orientations.get(model.names[i], 1)) for i in index])
    enu_from_model = enu_from_gimbal(yaw, pitch, roll) @ turns @ model.cam_from_model[index]
    rotation, spread = mean_rotation(enu_from_model)
    return rotation if spread <= GIMBAL_SPREAD_RAD else None


def _upright(model: _Model, positions: _Positions) -> Upright:
    orientations = np.array([positions.orientations.get(name, 1) for name in model.names], dtype=np.int64)
    return up_from_cameras(camera_axes(model.cam_from_model, orientations), model.centres, model.points)


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


def _tell(frame: Frame, fit: SimilarityFit, model: _Model, positions: _Positions, report: Reporter) -> None:
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


def _heights(frame: Frame, model: _Model, positions: _Positions) -> tuple[float, float] | None:
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


def _read_positions(path: Path) -> _Positions:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        by_name = {record["name"]: record for record in value["positions"]}
        return _Positions(by_name, value.get("orientations", {}))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatpipeError(f"The positions {path} cannot be read: {error}", "Run with --rerun ingest.") from error


def _read_model(path: Path, photos: Iterable[str]) -> _Model:
    import pycolmap

    try:
        reconstruction = pycolmap.Reconstruction(str(path))
    except Exception as error:  # pycolmap raises its C++ errors as several types
        raise SplatpipeError(
            f"The sparse model cannot be read: {' '.join(str(error).split())[:200]}",
            "It has to hold cameras, images and points3D, as COLMAP writes them (.bin or .txt).",
        ) from error
    images = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda image: image.name)
    if not images:
        raise SplatpipeError("The sparse model has no photo with a pose.", "Reconstruct again, with more overlap.")
    poses = np.stack([np.asarray(image.cam_from_world().matrix(), dtype=np.float64) for image in images])
    rotations = poses[:, :, :3]
    centres = -np.einsum("nji,nj->ni", rotations, poses[:, :, 3])
    points = [point.xyz for _, point in sorted(reconstruction.points3D.items())]
    cloud = np.array(points, dtype=np.float64).reshape(-1, 3)
    finite: Bool[np.ndarray, " n"] = np.isfinite(centres).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
    matched = match_names((image.name for image in images), photos)
    names = [matched.get(image.name, image.name) for image, good in zip(images, finite, strict=True) if good]
    return _Model(names, centres[finite], rotations[finite], cloud[np.isfinite(cloud).all(axis=1)])


def _copy_model(source: Path, target: Path, may_link: bool) -> None:
    """The model's files as they are: linked where that is allowed (never a user's own) and possible, else copied."""
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.iterdir()):
        if path.is_file() and not path.name.startswith("."):
            copy = target / path.name
            copy.unlink(missing_ok=True)
            if may_link:
                with contextlib.suppress(OSError):  # another file system, or one without links
                    os.link(path, copy)
                    continue
            shutil.copyfile(path, copy)
