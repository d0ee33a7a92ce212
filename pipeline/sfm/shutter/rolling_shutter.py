"""Correct a film's keypoints and model for its rolling shutter, where the film determines the readout time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.photos.video.film_times import FilmTimes
from splatpipe.pipeline.sfm.lenses.focal import MAX_UNOBSERVED_DEVIATION, adjust_within
from splatpipe.pipeline.sfm.lenses.track_choice import MIN_TRACKS, decision_tracks, with_only
from splatpipe.pipeline.sfm.mapping.retriangulation import retriangulate
from splatpipe.pipeline.sfm.model.structure import cameras_of, make_model, poses_of, read_structure
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.shutter.film_motion import FrameMotion, frame_motions
from splatpipe.pipeline.sfm.shutter.frame_shutter import FilmShutter
from splatpipe.pipeline.sfm.shutter.readout import Readout, estimate_readout
from splatpipe.pipeline.sfm.shutter.row_shift import shifts_of_frames

ROUNDS = 2  # corrections with the geometry of the one before; a third moves no keypoint by a hundredth of a pixel


@dataclass(frozen=True, eq=False)
class Corrected:
    """A film's model as if all rows of a frame had been exposed when the middle one was.

    Attributes:
        model: The corrected model, or the given one.
        verified: Its view graph, with the keypoints corrected likewise.
        readout: What was estimated.
        shift_px: RMS of the keypoints' corrections at the first and last row; 0 if there are none.
    """

    model: pycolmap.Reconstruction
    verified: ViewGraph
    readout: Readout
    shift_px: float = 0.0


def correct_rolling_shutter(
    model: pycolmap.Reconstruction,
    verified: ViewGraph,
    film: FilmTimes,
    held_px: Mapping[int, float] = MappingProxyType({}),
    seed: int = 0,
) -> Corrected:
    """Estimate a film's readout time, and correct its keypoints for it if it is determined.

    Args:
        model: The result of mapping; not modified.
        verified: Its view graph.
        film: When the frames were taken.
        held_px: Focal lengths that mapping held near their prior, by COLMAP's camera id.
        seed: For the choice of tracks.

    Returns:
        The model and view graph themselves if there is nothing to correct.
    """

    def motions_of(current: pycolmap.Reconstruction) -> Mapping[int, FrameMotion]:
        return _motions(current, film)

    chosen = decision_tracks(model, seed)
    if len(chosen) < MIN_TRACKS:
        return Corrected(model, verified, Readout())
    readout = estimate_readout(with_only(model, set(chosen.tolist())), motions_of, film.frame_s)
    if not readout.determined:
        return Corrected(model, verified, readout)
    result = pycolmap.Reconstruction(model)
    raw = {number: verified.keypoints[number].astype(np.float64) for number in motions_of(model)}
    shifts: Mapping[int, Float64[np.ndarray, "_ 2"]] = {}
    corrected = verified
    for number in range(ROUNDS):
        shifts = shifts_of_frames(result, motions_of(result), raw, readout.estimate_s)
        moved = {frame: (raw[frame] - shift).astype(np.float32) for frame, shift in shifts.items()}
        corrected = replace(verified, keypoints={**verified.keypoints, **moved})
        result = make_model(cameras_of(result).values(), poses_of(result), corrected, read_structure(result))
        if number:
            retriangulate(result, corrected, seed)
        adjust_within(result, held_px, MAX_UNOBSERVED_DEVIATION)
    return Corrected(result, corrected, readout, _edge_shift_px(shifts, raw, result))


def _motions(model: pycolmap.Reconstruction, film: FilmTimes) -> dict[int, FrameMotion]:
    frames = {number: model.images[number].name for number in sorted(model.reg_image_ids())}
    known = {number: name for number, name in frames.items() if name in film.times_s}
    return frame_motions(
        {number: np.asarray(model.images[number].cam_from_world().matrix(), np.float64) for number in known},
        {number: film.times_s[name] for number, name in known.items()},
        {number: film.part_of(name) for number, name in known.items()},
    )


def film_shutter(model: pycolmap.Reconstruction, film: FilmTimes, readout_s: float) -> FilmShutter:
    """Return the shutter of a finished model, in its frame."""
    motions = _motions(model, film)
    return FilmShutter(readout_s, {model.images[number].name: motion for number, motion in motions.items()})


def _edge_shift_px(
    shifts: Mapping[int, Float64[np.ndarray, "_ 2"]],
    raw: Mapping[int, Float64[np.ndarray, "_ 2"]],
    model: pycolmap.Reconstruction,
) -> float:
    """RMS of the corrections at the first and last row: the corrections grow linearly from the middle."""
    total, count = 0.0, 0.0
    for number, shift in shifts.items():
        height = model.cameras[model.images[number].camera_id].height
        total += float((shift**2).sum())
        count += float(((raw[number][:, 1] / height - 0.5) ** 2).sum())
    return math.sqrt(total / count) / 2.0 if count > 0.0 else 0.0


def shutter_summary(corrected: Corrected) -> JSON:
    """The estimate as JSON, for ``models.json``."""
    readout = corrected.readout
    finite = math.isfinite(readout.sigma_s)
    return {
        "readout_ms": round(1000.0 * readout.estimate_s, 3) if readout.determined else 0.0,
        "estimate_ms": round(1000.0 * readout.estimate_s, 3),
        "sigma_ms": round(1000.0 * readout.sigma_s, 3) if finite else None,
        "gain": round(readout.gain, 4),
        "determined": readout.determined,
        "frames": readout.frames,
        "shift_px": round(corrected.shift_px, 3),
    }


def report_shutter(corrected: Corrected, report: Reporter) -> None:
    """Say in a sentence what the film's shutter does, and whether it is corrected."""
    readout = corrected.readout
    if readout.determined:
        ends = ("first", "last") if readout.estimate_s > 0.0 else ("last", "first")
        report.note(
            f"The film's rolling shutter takes {1000.0 * abs(readout.estimate_s):.1f} ms (± "
            f"{1000.0 * readout.sigma_s:.1f}) from the {ends[0]} row to the {ends[1]}: keypoints are corrected, by "
            f"{corrected.shift_px:.1f} pixels (RMS) at the edge."
        )
    elif math.isfinite(readout.sigma_s):
        report.note(
            f"The film shows no rolling shutter that could be corrected ({1000.0 * readout.estimate_s:.1f} ± "
            f"{1000.0 * readout.sigma_s:.1f} ms)."
        )
