"""Estimate the readout time of a film's rolling shutter from its reprojection errors, with its uncertainty.

Keypoints are corrected as for a readout time, and poses, points and lens adjusted to them. How the residuals differ
from those of another readout time, adjusted alike, is what the readout explains and nothing else does: their regression
on it gives the step to the best one, and its scatter from frame to frame gives its standard deviation. All lens
parameters are free in these trials, so that distortion is not taken for a shutter.

The model of the shutter is that of Vautherin et al. ("Photogrammetric accuracy and modeling of rolling shutter
cameras", ISPRS Annals III-3, 2016), with the motion from the film's poses in place of unknown velocities.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.sfm.lenses.lens_adjustment import BASE, ROBUST_PX, LensFreedom, adjust_lenses, weak_prior
from splatpipe.pipeline.sfm.lenses.lens_model import is_known
from splatpipe.pipeline.sfm.lenses.lens_trial import STEPS
from splatpipe.pipeline.sfm.shutter.film_motion import FrameMotion
from splatpipe.pipeline.sfm.shutter.row_shift import observed_rows, row_shifts

MotionsOf: TypeAlias = Callable[[pycolmap.Reconstruction], Mapping[int, FrameMotion]]

START_S = 0.02  # most cameras take 5 to 30 ms; searched from here in both directions, as flat ground has two minima
ROUNDS = 4  # the geometry that corrections are computed with improves with them; two rounds are usual
SETTLED = 0.1  # a step below this share of the standard deviation ends the rounds
MAX_SETTLING, SETTLED_COST = 6, 2e-4  # adjustments at first, and the relative change of the cost that ends them
MIN_FRAMES = 8  # with a known motion: fewer give no standard deviation worth the name
MIN_SIGMAS = 5.0  # the scatter between frames knows nothing of errors that all frames share
MIN_GAIN = 0.001  # of the adjustment's cost: a film with a global shutter gains a tenth of it by noise
MAX_READOUT = 1.1  # times the time between frames, within which a camera must have read all rows


@dataclass(frozen=True)
class Readout:
    """What a film tells of its shutter.

    Attributes:
        estimate_s: From the first row to the last, seconds; negative if the last is exposed first.
        sigma_s: Its standard deviation; infinite if it is not determined.
        gain: By how much it reduces the adjustment's cost, relatively.
        determined: Whether it is significant, useful and possible.
        frames: Frames that it is from.
    """

    estimate_s: float = 0.0
    sigma_s: float = math.inf
    gain: float = 0.0
    determined: bool = False
    frames: int = 0


@dataclass(frozen=True, eq=False)
class _Observations:
    """Observations of a model, frame after frame, in an order that adjustments do not change.

    Attributes:
        rows: By COLMAP's image id, the keypoints that observe points.
        points: The ids of these points.
        pixels: The keypoints as they are in the frames.
    """

    rows: Mapping[int, Int64[np.ndarray, " _"]]
    points: Mapping[int, tuple[int, ...]]
    pixels: Mapping[int, Float64[np.ndarray, "_ 2"]]


def estimate_readout(
    model: pycolmap.Reconstruction,
    motions_of: MotionsOf,
    frame_s: float,
) -> Readout:
    """Estimate the readout time.

    Args:
        model: Some tracks of a film's model, keypoints as they are in the frames, cameras of wide models; adjusted in
            place, without corrections.
        motions_of: Returns the motion at each frame of a model.
        frame_s: Time between the film's frames, seconds.
    """
    trial = ReadoutTrial(model, motions_of)
    if trial.frames < MIN_FRAMES or frame_s <= 0.0:
        return Readout(frames=trial.frames)
    trial.settle(model)
    start_s = min(0.5 * frame_s, START_S)
    ends = [_search(trial, pycolmap.Reconstruction(model), start, frame_s) for start in (start_s, -start_s)]
    best, other = sorted(ends, key=lambda end: end.cost)
    agree = abs(best.readout_s - other.readout_s) <= MIN_SIGMAS * max(best.sigma_s, other.sigma_s)
    sure = agree or other.cost > (1.0 + MIN_GAIN) * best.cost
    without = robust_cost(trial.residuals(trial.adjusted(0.0, best.model)))  # from there: as far converged
    gain = 1.0 - best.cost / max(without, 1e-300)
    sure = sure and abs(best.readout_s) > MIN_SIGMAS * best.sigma_s and gain >= MIN_GAIN
    sure = sure and abs(best.readout_s) <= MAX_READOUT * frame_s
    return Readout(best.readout_s, best.sigma_s, gain, sure, trial.frames)


@dataclass(frozen=True, eq=False)
class _End:
    """Where a search ended: the readout time, its standard deviation, the cost, and the model."""

    readout_s: float
    sigma_s: float
    cost: float
    model: pycolmap.Reconstruction


def _search(trial: ReadoutTrial, model: pycolmap.Reconstruction, start_s: float, frame_s: float) -> _End:
    """Search the best readout time near one, by steps of the regression (Gauss-Newton with all else eliminated)."""
    readout_s, sigma_s = start_s, math.inf
    residuals = trial.residuals(trial.adjusted(readout_s, model))
    further = trial.adjusted(-start_s, pycolmap.Reconstruction(model))
    effect = (trial.residuals(further) - residuals) / (-2.0 * start_s)
    for _ in range(ROUNDS):
        step_s, sigma_s = regress(residuals, effect, trial.frame_of, trial.unknowns)
        if not math.isfinite(sigma_s) or abs(step_s) < SETTLED * sigma_s:
            break
        readout_s = float(np.clip(readout_s + step_s, -2.0 * frame_s, 2.0 * frame_s))
        residuals = trial.residuals(trial.adjusted(readout_s, model))
    return _End(readout_s, sigma_s, robust_cost(residuals), model)


class ReadoutTrial:
    """Adjustments of the same observations, corrected for different readout times."""

    def __init__(self, model: pycolmap.Reconstruction, motions_of: MotionsOf) -> None:
        self._motions_of = motions_of
        self._seen = _observations(model)
        self._freedoms = {
            number: LensFreedom(_lens_of(camera), weak_prior(camera)) for number, camera in model.cameras.items()
        }
        counts = [len(rows) for _, rows in sorted(self._seen.rows.items())]
        self.frame_of = np.repeat(np.arange(len(counts)), counts)
        self.frames = len(motions_of(model))
        self.unknowns = 3 * model.num_points3D() + 6 * model.num_reg_images()

    def adjusted(self, readout_s: float, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """Correct the keypoints with a model's geometry, adjust it, in place, and return it."""
        self._correct(model, readout_s)
        adjust_lenses(model, self._freedoms)
        return model

    def settle(self, model: pycolmap.Reconstruction) -> None:
        """Adjust a model without corrections to convergence: flat ground lets a lens go a long way, in small steps."""
        before = math.inf
        for _ in range(MAX_SETTLING):
            cost = robust_cost(self.residuals(self.adjusted(0.0, model)))
            if cost >= (1.0 - SETTLED_COST) * before:
                break
            before = cost

    def _correct(self, model: pycolmap.Reconstruction, readout_s: float) -> None:
        motions: Mapping[int, FrameMotion] = self._motions_of(model)
        for number, rows in self._seen.rows.items():
            if number not in motions:
                continue
            image, pixels = model.images[number], self._seen.pixels[number]
            in_camera = self._in_camera(model, number)
            rotation = np.asarray(image.cam_from_world().matrix(), np.float64)[:, :3]
            camera = model.cameras[image.camera_id]
            shifts = row_shifts(camera, rotation, motions[number], in_camera, pixels, readout_s)
            for row, place in zip(rows.tolist(), pixels - shifts, strict=True):
                image.points2D[row].xy = place

    def residuals(self, model: pycolmap.Reconstruction) -> Float64[np.ndarray, "n 2"]:
        """The residuals of all observations as corrected, pixels, in a fixed order."""
        found = []
        for number, rows in sorted(self._seen.rows.items()):
            image = model.images[number]
            camera = model.cameras[image.camera_id]
            places = np.array([image.points2D[row].xy for row in rows.tolist()], np.float64).reshape(-1, 2)
            projected = np.asarray(camera.img_from_cam(self._in_camera(model, number)), np.float64).reshape(-1, 2)
            found.append(places - projected)
        residuals = np.concatenate(found)
        return np.where(np.isfinite(residuals), residuals, 0.0)

    def _in_camera(self, model: pycolmap.Reconstruction, number: int) -> Float64[np.ndarray, "n 3"]:
        pose = np.asarray(model.images[number].cam_from_world().matrix(), np.float64)
        points = np.stack([model.points3D[point].xyz for point in self._seen.points[number]])
        return np.asarray(points @ pose[:, :3].T + pose[:, 3])


def _observations(model: pycolmap.Reconstruction) -> _Observations:
    rows: dict[int, Int64[np.ndarray, " _"]] = {}
    points: dict[int, tuple[int, ...]] = {}
    pixels: dict[int, Float64[np.ndarray, "_ 2"]] = {}
    for number in sorted(model.reg_image_ids()):
        image = model.images[number]
        observed = observed_rows(image)
        if len(observed):
            seen = [image.points2D[row] for row in observed.tolist()]
            rows[number] = observed
            points[number] = tuple(int(point.point3D_id) for point in seen)
            pixels[number] = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
    return _Observations(rows, points, pixels)


def _lens_of(camera: pycolmap.Camera) -> tuple[str, ...]:
    """All that calibration may free of a lens: what a shutter explains must not be distortion."""
    return (*BASE, *sum(STEPS[camera.model_name], ())) if is_known(camera.model_name) else ()


def regress(
    residuals: Float64[np.ndarray, "n 2"],
    effect: Float64[np.ndarray, "n 2"],
    frame_of: Int64[np.ndarray, " n"],
    unknowns: int,
) -> tuple[float, float]:
    """Regress residuals on the effect of a readout time, weighted as the adjustment weights them.

    Args:
        residuals: Adjusted, pixels.
        effect: By how much a second more changes them, adjusted.
        frame_of: The frame of each observation.
        unknowns: Of the adjustment: they make residuals smaller than errors.

    Returns:
        The step that reduces them most, seconds, and its standard deviation (the "sandwich" of White, Econometrica
        1980): the larger of that for independent errors and that for errors which frames share (Liang and Zeger,
        Biometrika 1986); the latter alone is too small, as poses absorb most of what a frame's errors share.
    """
    weights = weights_of(residuals)[:, None]
    information = float((weights * effect**2).sum())
    frames, freedom = len(np.unique(frame_of)), residuals.size - unknowns
    if not information > 0.0 or frames < 2 or freedom <= 0:
        return 0.0, math.inf
    step_s = -float((weights * effect * residuals).sum()) / information
    scores = weights * effect * (residuals + step_s * effect)
    shared = frames / (frames - 1) * float((np.bincount(frame_of, scores.sum(axis=1)) ** 2).sum())
    own = float((scores**2).sum())
    return step_s, math.sqrt(residuals.size / freedom * max(shared, own)) / information


def weights_of(residuals: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
    """Weights of the adjustment's robust loss (SOFT_L1)."""
    return np.asarray(1.0 / np.sqrt(1.0 + (residuals**2).sum(axis=1) / ROBUST_PX**2))


def robust_cost(residuals: Float64[np.ndarray, "n 2"]) -> float:
    """The adjustment's cost (SOFT_L1), square pixels."""
    squares = (residuals**2).sum(axis=1) / ROBUST_PX**2
    return float(2.0 * ROBUST_PX**2 * (np.sqrt(1.0 + squares) - 1.0).sum())
