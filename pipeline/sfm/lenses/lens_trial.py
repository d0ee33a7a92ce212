"""Test which lens parameters to free per camera: adjust with and without them, and compare on held-out tracks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.sfm.lenses.focal import UNOBSERVED
from splatpipe.pipeline.sfm.lenses.held_out import TrackObservations, improves, predicted_errors, rows_by_camera
from splatpipe.pipeline.sfm.lenses.lens_adjustment import (
    BASE,
    LensAdjustment,
    LensFreedom,
    adjust_lenses,
    corner_effects,
    corner_sigma_px,
    stated_prior,
    weak_prior,
)
from splatpipe.pipeline.sfm.lenses.lens_model import (
    NAMES,
    WIDE,
    WIDE_FISHEYE,
    StatedLens,
    named_params,
    picture_rays,
    set_lens,
    widen,
)

MIN_GAIN = 0.002  # relative reduction of the squared held-out errors; noise gives a tenth of it
MIN_SIGMAS = 3.0
MIN_EFFECT = 0.25  # effect at the corner over the held-out error: smaller ones do not change any later measurement
STEPS = {
    WIDE: (("k2",), ("cx", "cy"), ("p1", "p2"), ("k3",)),
    WIDE_FISHEYE: (("k2",), ("cx", "cy"), ("k3",), ("k4",)),
}
PASSES = 2  # a group rejected with a wrong lens may be justified with a better one
WIDE_ANGLE = 1.2  # tangent of the widest angle off the axis at which photos have points: above, it may be a fisheye


@dataclass(frozen=True)
class LensState:
    """Calibration state of a camera.

    Attributes:
        freedom: Its free parameters.
        focal_determined: Whether the photos determine its focal length.
        freed: The groups that were kept, in order.
        tried: A row for every group that was tried.
        changed: Whether the lens differs from the result of mapping.
        stated: Source of the stated lens; empty if none is used.
    """

    freedom: LensFreedom
    focal_determined: bool
    freed: tuple[str, ...] = ()
    tried: tuple[JSON, ...] = ()
    changed: bool = False
    stated: str = ""


class LensTrial:
    """Trial adjustments of a subset of tracks: the best so far, and its errors on the held-out tracks."""

    def __init__(
        self, model: pycolmap.Reconstruction, tracks: TrackObservations, states: Mapping[int, LensState], seed: int
    ) -> None:
        """Start with the simple lenses, adjusted to the same tracks as all later trials.

        Args:
            model: Model of the adjusted tracks, with cameras of wide models; changed in place.
            tracks: The held-out tracks, observed by photos of the model.
            states: States of all its cameras.
            seed: For the bootstrap over photos.
        """
        self.states = dict(states)
        self._tracks, self._seed = tracks, seed
        self._rows = dict(rows_by_camera(model, tracks))
        self._best = adjust_lenses(model, self._freedoms())
        self._errors = predicted_errors(self._best.model, tracks)

    @property
    def model(self) -> pycolmap.Reconstruction:
        """The best model so far."""
        return self._best.model

    def take_stated(self, stated: Mapping[int, StatedLens], held: bool) -> None:
        """Use stated lenses, refined under their prior or held as they are.

        Unless ``held``, a stated lens is rejected if the held-out tracks are predicted worse with it.
        """
        if not stated:
            return
        model = pycolmap.Reconstruction(self.model)
        wanted: dict[int, LensState] = {}
        for number, lens in sorted(stated.items()):
            camera = lens.colmap(number)
            widen(camera)
            set_lens(model.cameras[number], camera.model_name, named_params(camera))
            state = self.states[number]
            names = (*BASE, *sum(STEPS[camera.model_name], ())) if state.focal_determined and not held else ()
            freedom = LensFreedom(names, stated_prior(camera))
            wanted[number] = replace(state, freedom=freedom, changed=True, stated=lens.source, freed=("stated",))
        solved, errors = self._solve(model, wanted)
        kept = {}
        for number, state in wanted.items():
            gain, _ = self._gain(number, errors)
            row = {"freed": "stated", "held_out_gain": round(gain, 4)}
            good = held or gain > -MIN_GAIN
            kept[number] = good
            chosen = state if good else self.states[number]
            wanted[number] = replace(chosen, tried=(*self.states[number].tried, {**row, "kept": good}))
        self._keep(solved, errors, wanted, kept)

    def free_steps(self) -> None:
        """Free the groups that help: first all together to see whether any does, then one by one."""
        open_ = {number for number, state in self.states.items() if state.freedom.free and not state.stated}
        if not open_:
            return
        wanted = {number: self._with(number, sum(self._steps(number), ())) for number in open_}
        _, errors = self._solve(pycolmap.Reconstruction(self.model), wanted)
        hopeful = set()
        for number in sorted(open_):
            gain, sure = self._gain(number, errors)
            row = {"freed": "all", "held_out_gain": round(gain, 4), "kept": sure}
            self.states[number] = replace(self.states[number], tried=(*self.states[number].tried, row))
            if sure:
                hopeful.add(number)
        for _ in range(PASSES):
            for step in range(max(map(len, STEPS.values())) if hopeful else 0):
                self._free_group({n: names for n in sorted(hopeful) if (names := self._open(n, step))})

    def try_fisheye(self) -> None:
        """Switch cameras whose photos show a wide angle to the fisheye model if it predicts the held-out tracks better.

        It must be better than the best lens so far, and than a pinhole lens with everything free: more free parameters
        alone are no reason.
        """
        wanted, full = {}, {}
        model = pycolmap.Reconstruction(self.model)
        for number, state in sorted(self.states.items()):
            camera = model.cameras[number]
            if state.stated or not state.freedom.free or camera.model_name != WIDE or not self._is_wide(number, camera):
                continue
            full[number] = self._with(number, tuple(sorted(set(sum(STEPS[WIDE], ())) - set(state.freedom.free))))
            _as_fisheye(camera)
            free = (*BASE, *sum(STEPS[WIDE_FISHEYE], ()))
            freedom = replace(state.freedom, free=free, prior=weak_prior(camera))
            wanted[number] = replace(state, freedom=freedom, changed=True, freed=("fisheye",))
        if not wanted:
            return
        solved, errors = self._solve(model, wanted)
        _, pinhole = self._solve(pycolmap.Reconstruction(self.model), full)
        kept = {}
        for number in wanted:
            gain, sure = self._gain(number, errors)
            over, clear = self._gain(number, errors, pinhole)
            wide = self._is_wide(number, solved.model.cameras[number])
            row = {
                "freed": "fisheye",
                "held_out_gain": round(gain, 4),
                "over_pinhole": round(over, 4) if math.isfinite(over) else None,
                "kept": sure and clear and wide,
            }
            kept[number] = sure and clear and wide
            chosen = wanted[number] if kept[number] else self.states[number]
            wanted[number] = replace(chosen, tried=(*self.states[number].tried, row))
        self._keep(solved, errors, wanted, kept)

    def _is_wide(self, number: int, camera: pycolmap.Camera) -> bool:
        """Whether a camera's lens shows a wide angle where its photos have points.

        Beyond them, as around an object that was cut out, a polynomial may run anywhere.
        """
        pixels = self._tracks.pixels[self._rows.get(number, np.zeros(0, np.int64))]
        tangent = np.linalg.norm(np.asarray(camera.cam_from_img(pixels), np.float64).reshape(-1, 2), axis=1)
        return len(tangent) > 0 and float(np.where(np.isfinite(tangent), tangent, np.inf).max()) > WIDE_ANGLE

    def _free_group(self, groups: Mapping[int, tuple[str, ...]]) -> None:
        if not groups:
            return
        wanted = {number: self._with(number, names) for number, names in groups.items()}
        solved, errors = self._solve(pycolmap.Reconstruction(self.model), wanted, with_covariances=True)
        kept = {}
        for number, names in groups.items():
            gain, sure = self._gain(number, errors)
            effect, sigma, focal = self._effect_and_uncertainty(number, names, solved, wanted[number])
            least = MIN_EFFECT * self._typical(number)
            observable = effect >= max(least, MIN_SIGMAS * sigma) and focal <= UNOBSERVED
            kept[number] = sure and observable
            row = {
                "freed": " ".join(names),
                "held_out_gain": round(gain, 4),
                "corner_px": round(effect, 3),
                "sigma_px": round(sigma, 3) if math.isfinite(sigma) else None,
                "kept": kept[number],
            }
            state = wanted[number] if kept[number] else self.states[number]
            state = replace(state, tried=(*self.states[number].tried, row))
            if kept[number]:
                state = replace(state, freed=(*state.freed, " ".join(names)), changed=True)
            wanted[number] = state
        self._keep(solved, errors, wanted, kept)

    def _effect_and_uncertainty(
        self, number: int, names: tuple[str, ...], solved: LensAdjustment, state: LensState
    ) -> tuple[float, float, float]:
        """Return a group's corner effect and its sigma, pixels, and the relative sigma of the focal length."""
        camera, covariance = solved.model.cameras[number], solved.covariances.get(number)
        now, was = named_params(camera), named_params(self.model.cameras[number])
        effects = corner_effects(camera)
        moved = np.sum([effects[name] * (now[name] - was[name]) for name in names], axis=0)
        effect = float(np.linalg.norm(moved, axis=1).max())
        if covariance is None:
            return effect, math.inf, math.inf
        noise = max(self._typical(number), 1.0)
        sigma = noise * corner_sigma_px(camera, names, covariance, state.freedom.free)
        focal = noise * math.sqrt(max(float(covariance[0, 0]), 0.0)) / now["fx"]
        return effect, sigma, focal

    def _open(self, number: int, step: int) -> tuple[str, ...]:
        """Return a camera's group of a step; empty if it is free already, or nothing was kept since it was tried."""
        steps, state = self._steps(number), self.states[number]
        names = steps[step] if step < len(steps) else ()
        tried = [row["freed"] for row in state.tried]
        if " ".join(names) not in tried:
            return names
        since = state.tried[len(tried) - tried[::-1].index(" ".join(names)) :]
        return names if " ".join(names) not in state.freed and any(row["kept"] for row in since) else ()

    def _steps(self, number: int) -> tuple[tuple[str, ...], ...]:
        """Return the groups for a camera's model."""
        return STEPS[self.model.cameras[number].model_name]

    def _with(self, number: int, names: tuple[str, ...]) -> LensState:
        state = self.states[number]
        return replace(state, freedom=replace(state.freedom, free=(*state.freedom.free, *names)))

    def _freedoms(self) -> dict[int, LensFreedom]:
        return {number: state.freedom for number, state in self.states.items()}

    def _solve(
        self, model: pycolmap.Reconstruction, wanted: Mapping[int, LensState], with_covariances: bool = False
    ) -> tuple[LensAdjustment, Float64[np.ndarray, " n"]]:
        freedoms = {**self._freedoms(), **{number: state.freedom for number, state in wanted.items()}}
        solved = adjust_lenses(model, freedoms, with_covariances)
        return solved, predicted_errors(solved.model, self._tracks)

    def _gain(
        self, number: int, errors: Float64[np.ndarray, " n"], before: Float64[np.ndarray, " n"] | None = None
    ) -> tuple[float, bool]:
        """How much a camera's held-out errors are less than those of another solution, or of the best so far."""
        rows = self._rows.get(number, np.zeros(0, np.int64))
        was = (self._errors if before is None else before)[rows]
        if before is not None and not math.isfinite(float(np.median(was))):
            return math.inf, True  # a solution that predicts nothing
        return improves(was, errors[rows], self._tracks.image[rows], MIN_GAIN, self._seed)

    def _typical(self, number: int) -> float:
        """Return the typical held-out error along one axis, pixels."""
        return float(np.median(self._errors[self._rows[number]])) / math.sqrt(2.0 * math.log(2.0))

    def _keep(
        self,
        solved: LensAdjustment,
        errors: Float64[np.ndarray, " n"],
        wanted: Mapping[int, LensState],
        kept: Mapping[int, bool],
    ) -> None:
        """Adopt the result if all changes are kept; otherwise revert the rejected lenses and adjust again."""
        self.states.update(wanted)
        if all(kept.values()):
            self._best, self._errors = solved, errors
        elif any(kept.values()):
            model = solved.model
            for number in sorted(kept):
                if not kept[number]:
                    camera = self.model.cameras[number]
                    set_lens(model.cameras[number], camera.model_name, named_params(camera))
            self._best, self._errors = self._solve(model, {})


def _as_fisheye(camera: pycolmap.Camera) -> None:
    """Convert a camera in place to the one-coefficient fisheye that is nearest to its lens within the image."""
    named = named_params(camera)
    rays = picture_rays(camera.width, camera.height, camera)
    tangent = np.linalg.norm(rays, axis=1)
    good = np.isfinite(tangent) & (tangent > 0.0)
    angle = np.arctan(tangent[good])
    flat = np.stack([tangent[good], np.zeros(int(good.sum())), np.ones(int(good.sum()))], axis=1)
    radius = np.asarray(camera.img_from_cam(flat))[:, 0] - named["cx"]
    solved, *_ = np.linalg.lstsq(np.stack([angle, angle**3], axis=1), radius, rcond=None)
    focal, k = float(solved[0]), float(solved[1] / solved[0])
    shape = {**dict.fromkeys(NAMES[WIDE_FISHEYE], 0.0), "cx": named["cx"], "cy": named["cy"]}
    set_lens(camera, WIDE_FISHEYE, {**shape, "fx": focal, "fy": focal, "k1": k})
