"""The block adjustment of a capture's positions: from its records, and to a frame and its accuracy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.adjustment.adjustment import can_adjust, moved_px
from splatpipe.pipeline.survey.adjustment.block_accuracy import (
    BlockAccuracy,
    camera_accuracy,
    ninety_five,
    with_control,
    with_cross_strip,
)
from splatpipe.pipeline.survey.adjustment.georef_input import AdjustedPositions, GeorefInput
from splatpipe.pipeline.survey.adjustment.position_adjustment import PositionAdjustment, adjust_to_positions
from splatpipe.pipeline.survey.adjustment.position_noise import StatedPositions
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.placing.assumed_heights import ASSUMED
from splatpipe.pipeline.survey.placing.fitting import capture_order
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.placing.receiver_noise import ReceiverNoise
from splatpipe.pipeline.survey.placing.uncertainty import Uncertainty, metres_in_words

ACCURATE_M = 0.5  # standard deviation up to which positions bend the model: RTK, PPK, also without a fix
MIN_POSITIONS = 8
MIN_TIES = 20  # points that a photo must have at the median, to be adjusted
MIN_DEFORMATION_PX = 0.5  # RMS shift in the images; if positions deform the model by less, it is not adjusted
MAX_MOVED_GSDS = 3.0  # ground sample distances, or standard deviations of a position: ground heights should be as good
HEIGHTS_SHOWN = 400


def adjust_model(capture: GeorefInput, frame: Frame, report: Reporter) -> AdjustedPositions | None:
    """Adjust a model to its positions if these are accurate; None if they are not, or too few.

    Args:
        capture: The model and its photos.
        frame: By a similarity to the positions.
        report: Receives progress.
    """
    model = capture.model
    stated = stated_positions(model, frame, capture.positions, capture.photos)
    if stated is None or not can_adjust(model.reconstruction) or _ties(model) < MIN_TIES:
        return None
    names, observed = stated
    suspects = np.array([name in frame.left_out for name in names])
    try:
        done = adjust_to_positions(
            model.reconstruction,
            frame.world_from_model,
            model.image_ids,
            observed,
            names,
            suspects,
            capture.lenses,
            lenses_held=capture.lenses_held,
            poll=lambda step, steps: report.progress(step, steps, "adjusting to the positions", "steps"),
        )
    except np.linalg.LinAlgError as error:
        report.warning(f"The positions place the model, but cannot adjust it: {error}.", "Is the sparse model sound?")
        return None
    sizes = np.median(done.noise.sizes(done.positions), axis=0)
    if not done.adjusted.converged or float(sizes.max()) > ACCURATE_M:
        return None  # not what they are stated to be: the similarity says so
    moved = moved_px(model.reconstruction, done.reconstruction)
    return AdjustedPositions(done, moved, moved >= MIN_DEFORMATION_PX, names, flights_of(names, capture.positions))


def _ties(model: SparseModel) -> float:
    """Tie points that a photo has."""
    seen = [model.reconstruction.images[number].num_points3D for number in model.image_ids]
    return float(np.median(seen))


def flights_of(names: Sequence[str], positions: Positions) -> tuple[int, ...]:
    """Numbers of the flights of some photos, ascending."""
    return tuple(sorted({int(positions.by_name[name].get("flight", 0)) for name in names}))


def stated_positions(
    model: SparseModel, frame: Frame, positions: Positions, photos: Mapping[str, Photo]
) -> tuple[tuple[str, ...], StatedPositions] | None:
    """The positions of a model's photos in the order of capture, with their names; None if they are poor or few."""
    if frame.origin is None:
        return None
    index = {name: k for k, name in enumerate(model.names)}
    usable = [
        name
        for name in model.names
        if (record := positions.by_name.get(name)) is not None
        and record["altitude_m"] is not None
        and record.get("altitude_source") != ASSUMED
        and name not in positions.wrong
    ]
    if len(usable) < MIN_POSITIONS:
        return None
    times = {name: photos[name].time if name in photos else None for name in usable}
    names = capture_order(usable, positions.by_name, times)
    records = [positions.by_name[name] for name in names]
    sigmas = np.array([[r["sigma_horizontal_m"]] * 2 + [r["sigma_vertical_m"]] for r in records], dtype=np.float64)
    if float(np.median(sigmas)) > ACCURATE_M:
        return None
    geodetic = np.array([[r["latitude"], r["longitude"], r["altitude_m"]] for r in records], dtype=np.float64)
    flights = flights_of(names, positions)
    apart = {int(each["flight"]): each["apart"] for each in frame.residuals.get("flights", [])}
    return tuple(names), StatedPositions(
        np.array([index[name] for name in names], dtype=np.int64),
        frame.origin.enu_from_geodetic(geodetic),
        sigmas,
        np.array([flights.index(int(r.get("flight", 0))) for r in records], dtype=np.int64),
        tuple(str(r.get("rtk") or "unstated") for r in records),
        np.array([[apart.get(n, [False, False])[k] for k in (0, 0, 1)] for n in flights], dtype=bool),
    )


def adjusted_frame(frame: Frame, found: AdjustedPositions) -> Frame:
    """The frame with the residuals and accuracy of an adjustment."""
    done = found.done
    errors = done.errors
    uncertainty = uncertainty_of_block(done)
    rms = np.sqrt((errors**2).mean(axis=0))
    residuals: dict[str, Any] = {
        **frame.residuals,
        "rmse_horizontal_m": float(np.hypot(rms[0], rms[1])),
        "rmse_vertical_m": float(rms[2]),
        "rmse_m": float(np.sqrt((rms**2).sum())),
        "photos_used": len(errors),
        "over_stated_sigmas": float(np.sqrt((done.noise.factors[done.noise.main][[0, 0, 1]] ** 2).mean())),
        "sigma_scale_percent": 100.0 * uncertainty.scale,
        "sigma_rotation_deg": math.degrees(uncertainty.weakest_rad),
        "uncertainty": uncertainty.as_json(),
        "photos": {**frame.residuals["photos"], **dict(zip(done.names, errors.tolist(), strict=True))},
    }
    residuals["photos"] = dict(sorted(residuals["photos"].items()))
    offsets = dict(zip(found.flights, done.adjusted.offsets.tolist(), strict=True))
    residuals["flights"] = [
        {**flight, "offset_m": offsets.get(flight["flight"], flight["offset_m"])} for flight in residuals["flights"]
    ]
    wrong = [name for name in frame.left_out if name not in found.names]
    note = (
        f"From the positions of {len(errors)} photos, adjusted together with the tie points: {uncertainty.sentence()}."
    )
    return replace(frame, residuals=residuals, left_out=tuple(sorted({*done.left_out, *wrong})), note=note)


def uncertainty_of_block(done: PositionAdjustment) -> Uncertainty:
    """The accuracy of the adjusted block in the terms of a frame's."""
    cameras: dict[str, Any] = camera_accuracy(done.accuracy)
    ground = np.median(done.accuracy.ground_sigmas(), axis=0) if len(done.accuracy.points) else np.zeros(3)
    noise = done.noise
    hidden = noise.offset_sigmas(done.positions, 0.0)[0]
    equivalent = ReceiverNoise(noise.factors[noise.main], noise.white_correlations(), noise.degrees[noise.main])
    return Uncertainty(
        offset_m=np.array(cameras["offset_m"]),
        north_rad=cameras["north_rad"],
        up_rad=cameras["up_rad"],
        scale=cameras["scale"],
        weakest_rad=max(cameras["north_rad"], cameras["up_rad"]),
        coordinates_m=np.array([float(np.sqrt((ground[:2] ** 2).mean())), float(ground[2])]),
        common_m=hidden[[0, 2]],
        noise=equivalent,
        covariance=np.zeros((7, 7)),
    )


def adjustment_json(found: AdjustedPositions, gsd: float | None) -> dict[str, JSON]:
    """What ``accuracy.json`` says of an adjustment to positions."""
    done = found.done
    squares = np.nanmean(done.predicted**2, axis=0)
    predicted = [float(np.sqrt(squares[:2].mean())), float(np.sqrt(squares[2]))]
    used = [
        {
            "photo": name,
            "flight": found.flights[int(done.positions.group[k])],
            "residual_m": np.round(error, 4).tolist(),
        }
        for k, (name, error) in enumerate(zip(done.names, done.errors, strict=True))
    ]
    judged = done.judgement
    return {
        "moved_px": found.moved_px,
        "adopted": found.adopted,
        "positions": used,
        "left_out": list(done.left_out),
        "predicted_m": predicted,
        "sentence": (
            f"camera positions that the fit did not use are predicted to {metres_in_words(predicted[0])} along each "
            f"horizontal axis and {metres_in_words(predicted[1])} in height"
        ),
        "noise": [
            {"of": name, "factors": np.round(factors, 3).tolist()}
            for name, factors in zip(done.noise.classes, done.noise.factors, strict=True)
        ],
        "lens_judged": None
        if judged is None
        else {
            "tie_points_px": [judged.simple_px, judged.whole_px],
            "positions_m": [list(judged.simple_m), list(judged.whole_m)],
            "whole": judged.taken,
        },
        **block_json(done.accuracy, gsd, stated_sigma(done.positions)),
    }


def with_adjustment(frame: Frame, adjustment: Mapping[str, Any]) -> Frame:
    """The frame whose uncertainty has the sentences of an adjustment too, for ``georef.json``."""
    heights = adjustment["heights"] or {}
    together = heights.get("together_sigma_m")
    said = {
        "positions_left_out_m": adjustment["predicted_m"],
        "positions_left_out": adjustment["sentence"],
        "heights_95_m": None if together is None else round(ninety_five(together[2]), 4),
        "heights": heights.get("sentence"),
        "unknown": "what the base station's place or the datum (ETRS89, ITRF, WGS 84) is off by leaves no residual",
    }
    uncertainty = {**frame.residuals.get("uncertainty", {}), **said}
    return replace(frame, residuals={**frame.residuals, "uncertainty": uncertainty})


def stated_sigma(positions: StatedPositions) -> float:
    """Typical stated standard deviation of a position's height, metres."""
    return float(np.median(positions.sigmas[:, 2]))


def block_json(accuracy: BlockAccuracy, gsd: float | None, stated_m: float | None) -> dict[str, JSON]:
    """Lens and heights of an adjusted block, with their accuracy.

    Args:
        accuracy: By propagation.
        gsd: Ground sample distance, metres.
        stated_m: Typical stated standard deviation of the positions' heights; None where control is in the adjustment,
            so that no remedy has to be named.
    """
    lenses = []
    for lens, covariance in zip(accuracy.adjusted.block.lenses, accuracy.lens_sigmas(), strict=True):
        sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        lenses.append(
            {
                "camera": lens.camera.camera_id,
                "names": list(lens.names),
                "values": lens.values.tolist(),
                "sigmas": sigmas.tolist(),
                "correlations": np.round(covariance / np.maximum(np.outer(sigmas, sigmas), 1e-300), 3).tolist(),
            }
        )
    return {"lenses": lenses, "heights": _heights_json(accuracy, gsd, stated_m)}


def _heights_json(accuracy: BlockAccuracy, gsd: float | None, stated_m: float | None) -> JSON:
    if not len(accuracy.points):
        return None
    together = accuracy.mean_sigmas()
    sigmas = accuracy.ground_sigmas()
    step = max(1, len(sigmas) // HEIGHTS_SHOWN)
    places = np.column_stack([accuracy.places[:, :2], sigmas[:, 2]])[::step]
    remedies: dict[str, JSON] = {}
    sentence = None
    if stated_m is not None:
        by_control = with_control(accuracy)
        strip = with_cross_strip(accuracy)
        remedies = {
            **{f"control_{count}": remedy.as_json() for count, remedy in by_control.items()},
            "cross_strip": None if strip is None else strip.as_json(),
        }
        sentence = height_sentence(float(together[2]), gsd, stated_m)
    return {
        "together_sigma_m": together.tolist(),
        "typical_sigma_m": np.median(sigmas, axis=0).tolist(),
        "map": np.round(places, 3).tolist(),
        "remedies": remedies,
        "sentence": sentence,
    }


def height_sentence(together_m: float, gsd: float | None, stated_m: float) -> str | None:
    """The warning that accurate positions do not make accurate heights; None where they do.

    Args:
        together_m: Standard deviation of the ground's mean height.
        gsd: Ground sample distance.
        stated_m: Typical stated standard deviation of the positions' heights.
    """
    if gsd is None or stated_m > ACCURATE_M or together_m <= MAX_MOVED_GSDS * max(gsd, stated_m):
        return None
    return (
        f"heights of the ground are uncertain by ±{metres_in_words(ninety_five(together_m))} together (95 %): photos"
        " straight down from one height do not tell focal length from height; one control point, oblique photos beside"
        " these or a second flying height would settle it"
    )
