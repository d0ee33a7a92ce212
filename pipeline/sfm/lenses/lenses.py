"""Lens calibration: free lens parameters step by step, as long as held-out tracks show that they are needed.

Mapping estimates one focal length and one distortion coefficient per camera, all that its first photos can support.
Afterwards the principal point and further radial and tangential distortion are freed, one group at a time, in an
adjustment that excludes some tracks. A group is kept if these held-out tracks are predicted significantly better, with
photos as the unit of resampling, and if its effect is significant by its own standard deviation. A lens that needs
nothing more stays as it is, bit for bit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.sfm.lenses.carried_over import carry_over
from splatpipe.pipeline.sfm.lenses.focal import UNOBSERVED, focal_sigmas
from splatpipe.pipeline.sfm.lenses.held_out import of_photos, tracks_of
from splatpipe.pipeline.sfm.lenses.lens_adjustment import BASE, LensFreedom, adjust_lenses, weak_prior
from splatpipe.pipeline.sfm.lenses.lens_model import (
    StatedLens,
    apart_px,
    is_known,
    named_params,
    narrow,
    set_lens,
    widen,
)
from splatpipe.pipeline.sfm.lenses.lens_trial import LensState, LensTrial
from splatpipe.pipeline.sfm.lenses.track_choice import MIN_TRACKS, decision_tracks, with_only
from splatpipe.pipeline.sfm.mapping.retriangulation import MAX_ERROR_PX, retriangulate
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

MIN_PHOTOS = 8  # photos of a camera: fewer cannot separate its lens from their poses
HELD_OUT = 0.25
MAX_STATED_DEVIATION = 2e-3  # deviation from a calibration over the width that is reported: twice the usual
WORDS = {
    "cx cy": "principal point",
    "k2": "second radial coefficient",
    "k3": "third radial coefficient",
    "k4": "fourth radial coefficient",
    "p1 p2": "tangential distortion",
    "fisheye": "a fisheye's projection",
    "stated": "as it is stated",
}


def calibrate(
    model: pycolmap.Reconstruction, verified: ViewGraph, stated: Mapping[int, StatedLens], how: str, seed: int = 0
) -> tuple[pycolmap.Reconstruction, tuple[JSON, ...]]:
    """Free the lens parameters that the photos determine.

    Args:
        model: The result of mapping, with simple lenses; not modified.
        verified: Its view graph, with the cameras as they were before mapping.
        stated: Lenses from files or metadata, in each camera's own pixels, by COLMAP's camera id.
        how: ``auto``; ``simple`` changes nothing; ``held`` uses stated lenses without refining them.
        seed: For the choice of held-out tracks.

    Returns:
        The model itself if every lens stays simple, otherwise a new one; and a row per camera for ``models.json``.
    """
    usable = {number: lens for number, lens in stated.items() if number in model.cameras}
    chosen = decision_tracks(model, seed)
    if how == "simple" or (len(chosen) < MIN_TRACKS and not usable):
        return model, ()
    if len(chosen) < MIN_TRACKS:
        return _with_held(model, verified, usable, seed)
    held_out, deciding = np.split(chosen, [round(HELD_OUT * len(chosen))])
    within = with_only(model, set(deciding.tolist()))
    states = _states(within, model)
    if not usable and not any(state.freedom.free for state in states.values()):
        return model, _rows(model, model, states)
    tracks = of_photos(tracks_of(model, np.sort(held_out)), set(within.reg_image_ids()))
    trial = LensTrial(within, tracks, states, seed)
    del within  # the trial's, which replaces it by better ones
    trial.take_stated(usable, held=how == "held")
    trial.free_steps()
    trial.try_fisheye()
    if not any(state.changed for state in trial.states.values()):
        return model, _rows(model, model, trial.states)
    result = _finished(model, verified, trial.model, trial.states, seed)
    return result, _rows(model, result, trial.states, usable)


def _with_held(
    model: pycolmap.Reconstruction, verified: ViewGraph, stated: Mapping[int, StatedLens], seed: int
) -> tuple[pycolmap.Reconstruction, tuple[JSON, ...]]:
    """Return the model with its stated lenses fixed, for when there are too few tracks to test them."""
    lensed = with_only(model, set(model.points3D))
    states = {}
    for number, camera in lensed.cameras.items():
        states[number] = LensState(LensFreedom((), weak_prior(camera)), focal_determined=False)
        if number in stated:
            lens = stated[number].colmap(number)
            widen(lens)
            set_lens(camera, lens.model_name, named_params(lens))
            states[number] = replace(states[number], changed=True, stated=stated[number].source, freed=("stated",))
    adjust_lenses(lensed, {number: state.freedom for number, state in states.items()})
    result = _finished(model, verified, lensed, states, seed)
    return result, _rows(model, result, states, stated)


def _states(within: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> dict[int, LensState]:
    """Return the initial state of each camera after mapping.

    Cameras of few photos are held, and so are those whose focal length the photos do not determine. In the latter case,
    over flat ground from one height, distortion could bend the ground, and held-out tracks would bend with it and not
    show it.
    """
    counts = Counter(model.images[number].camera_id for number in model.reg_image_ids())
    fewer = math.sqrt(within.compute_num_observations() / max(model.compute_num_observations(), 1))
    sigmas = focal_sigmas(within)
    states = {}
    for number, camera in sorted(within.cameras.items()):
        determined = fewer * sigmas.get(number, math.inf) <= UNOBSERVED
        free = BASE if determined and counts[number] >= MIN_PHOTOS and is_known(camera.model_name) else ()
        states[number] = LensState(LensFreedom(free, weak_prior(camera)), determined)
    return states


def _finished(
    model: pycolmap.Reconstruction,
    verified: ViewGraph,
    lensed: pycolmap.Reconstruction,
    states: Mapping[int, LensState],
    seed: int,
) -> pycolmap.Reconstruction:
    """Apply the calibrated lenses to the whole model: carry them over, retriangulate, and adjust."""
    return_free_heap()  # of the trials
    result = carry_over(model, lensed, verified)
    retriangulate(result, verified, seed)
    adjust_lenses(result, {number: state.freedom for number, state in states.items()})
    pycolmap.ObservationManager(result).filter_all_points3D(MAX_ERROR_PX, 0.0)
    for camera in result.cameras.values():
        if is_known(camera.model_name):
            narrow(camera)
    result.update_point_3d_errors()
    return result


def _rows(
    before: pycolmap.Reconstruction,
    after: pycolmap.Reconstruction,
    states: Mapping[int, LensState],
    stated: Mapping[int, StatedLens] = MappingProxyType({}),
) -> tuple[JSON, ...]:
    rows = []
    for number, state in sorted(states.items()):
        camera = after.cameras[number]
        row = {
            "camera": number,
            "model": camera.model_name,
            "width": camera.width,
            "freed": list(state.freed),
            "stated": state.stated,
            "focal_told": state.focal_determined,
            "tried": list(state.tried),
            "moved_px": _rms(apart_px(camera, before.cameras[number], turn=True)),
        }
        if state.stated:
            row["off_stated_px"] = _rms(apart_px(camera, stated[number].colmap(), turn=True))
        rows.append(row)
    return tuple(rows)


def _rms(distances: Float64[np.ndarray, " n"]) -> float | None:
    """Return the RMS of the finite distances, pixels; None if there are none."""
    known = distances[np.isfinite(distances)]
    return round(float(np.sqrt(np.mean(known**2))), 3) if len(known) else None


def report_lenses(summary: Mapping[str, JSON], report: Reporter) -> None:
    """Report the outcome of the lens calibration."""
    for row in summary["lenses"]:
        if row["freed"]:
            what = ", ".join(WORDS.get(name, name) for name in row["freed"])
            report.note(
                f"The lens of camera {row['camera']} needs more than the simple model: {what} ({row['model']})."
            )
        if row["stated"] and (row["off_stated_px"] or 0.0) > MAX_STATED_DEVIATION * row["width"]:
            report.warning(
                f"The photos move the lens of camera {row['camera']} {row['off_stated_px']:.1f} pixels (RMS) from the"
                " one that is stated.",
                hint="Is it for this camera, at this focus and image size? --set sparse.lens=held keeps it fixed.",
            )
        refused = [each for each in row["tried"] if each["freed"] == "stated" and not each["kept"]]
        if refused:
            report.warning(
                f"The lens that is stated for camera {row['camera']} is not the one these photos were taken with: they"
                f" are predicted {-refused[0]['held_out_gain']:.0%} worse with it, so it is not used.",
                hint="Give the calibration of this camera, or use it anyway with --set sparse.lens=held.",
            )
