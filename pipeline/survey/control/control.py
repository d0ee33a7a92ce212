"""Georeferencing by control: the frame, and the model adjusted to the control if SfM deformed it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.geometry.joint_fit import SIMILARITY, JointFit, fit_jointly
from splatpipe.pipeline.survey.adjustment.adjusted_positions import block_json
from splatpipe.pipeline.survey.adjustment.adjustment import (
    NO_BARS,
    ControlAdjustment,
    ControlStart,
    Target,
    TargetDistances,
    adjust,
    can_adjust,
    moved_px,
)
from splatpipe.pipeline.survey.adjustment.block_accuracy import accuracy_of
from splatpipe.pipeline.survey.adjustment.block_adjustment import ROUNDS, PositionObservations
from splatpipe.pipeline.survey.adjustment.block_lens import Lens
from splatpipe.pipeline.survey.adjustment.georef_input import GeorefInput
from splatpipe.pipeline.survey.adjustment.position_adjustment import (
    UNKNOWN_LENS,
    LensKnowledge,
    doubted,
    lens_with_positions,
    simple_lens,
)
from splatpipe.pipeline.survey.adjustment.tie_points import (
    MIN_SIGMA_PX,
    block_of,
    sizes_of,
    spread_points,
    tie_sigma,
    tie_table,
)
from splatpipe.pipeline.survey.control.accuracy import GeoreferencedModel
from splatpipe.pipeline.survey.control.blunders import (
    require_near,
    tell_heights_apart,
    warn_of_weak_control,
)
from splatpipe.pipeline.survey.control.control_fit import fit_control
from splatpipe.pipeline.survey.control.local_survey import (
    MIN_CONTROL,
    LocalSurvey,
    observed_in,
    stations_of,
    with_sigmas_times,
)
from splatpipe.pipeline.survey.crs.crs import UNKNOWN, parse_vertical
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.files.control_file import titled
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.model import model_of
from splatpipe.pipeline.survey.points.located_points import SurveyPoint, locate
from splatpipe.pipeline.survey.points.surveyed_points import Survey
from splatpipe.pipeline.survey.targets.target_survey import FoundBars

MIN_DEFORMATION_PX = 0.5  # RMS shift in the images; if control deforms the model by less, it is not adjusted
MAX_QUIET_SIGMAS = 2.0  # residual over the stated sigmas up to which control keeps its sigmas
MISTAKEN_SIGMAS = 100.0  # over the stated sigmas: no receiver, but mistakes; hand-held ones reach some 50 times 2 cm
MAX_FOCAL_DEVIATION = 0.1  # relative deviation of a focal length from its prior that is worth a warning
SUSPICIOUS_SIGMAS = 1.0  # noise over sigmas; sound control with realistic sigmas stays well below
SINGLE_BLUNDER_GAIN = 3.0  # a single point is the blunder if leaving it out reduces the noise by this factor
MANY_OFF_SIGMAS = 3.0  # sigmas: if half of the points are off by more, it is not a single blunder
SUSPECT_ROUNDS = 20  # steps that show whether the others agree: without a blunder they do after a few
MAX_SUSPECTS = 3  # points with the largest residuals that are tried as the blunder
MAX_ROUNDS = 4  # adjustments, each without a blunder found in the one before, or with larger sigmas


@dataclass(frozen=True)
class ControlResult:
    """Result of georeferencing by control.

    Attributes:
        frame: The frame.
        survey: The points with their final roles, triangulated in the resulting model.
        site: The survey in the world frame.
        placed: The resulting model in the world frame.
        adjusted: The resulting model if the adjustment changed it; None if it is unchanged.
        moved_px: How far the adjustment moved the images' content, RMS; None if nothing was adjusted.
        sigma_factor: Factor applied to the control's stated or assumed sigmas.
        focal_held: COLMAP ids of cameras whose focal length neither photos nor control determine.
        block: Lens and heights after the adjustment, for ``accuracy.json``; None without one.
        bar_ends: Ends of scale bars in the adjusted model, model frame, by name; empty if it is unchanged.
    """

    frame: Frame
    survey: Survey
    site: LocalSurvey
    placed: GeoreferencedModel
    adjusted: pycolmap.Reconstruction | None
    moved_px: float | None
    sigma_factor: float
    focal_held: tuple[int, ...] = ()
    block: JSON = None
    bar_ends: Mapping[str, Float64[np.ndarray, " 3"]] = field(default_factory=dict)


def place_by_control(
    survey: Survey,
    capture: GeorefInput,
    frame: Frame | None,
    config: GeorefConfig,
    report: Reporter,
    bars: FoundBars | None = None,
) -> ControlResult:
    """Georeference a model by surveyed points.

    Args:
        survey: The surveyed points.
        capture: The model and its photos.
        frame: The frame from the positions alone; None if there is none.
        config: Options.
        report: Receives warnings.
        bars: Scale bars; they take part in the adjustment.

    Raises:
        FrameUndeterminedError: if there are neither positions nor enough control.
        SplatpipeError: if the control is elsewhere, or its geometry contradicts the model's.
    """
    model = capture.model
    stations = stations_of(model, capture.positions, frame)
    geodetic = require_near(survey, config, stations)
    fitted = fit_control(survey, geodetic, stations, (model, capture.positions, frame), config, report)
    site, survey, start, observed, fit = fitted.site, fitted.survey, fitted.start, fitted.observed, fitted.fit
    factor = fit.noise if fit.noise > MAX_QUIET_SIGMAS else 1.0
    tell_heights_apart(fit, survey, stations, report)
    warn_of_weak_control(fit, observed, model, report)
    placed = GeoreferencedModel(model, fit.similarity, fit.offsets)
    result = ControlResult(_frame(frame, survey, site, fit, config), survey, site, placed, None, None, factor)
    needed = MIN_CONTROL if capture.adjusted is None else 1
    if config.adjust == "auto" and int(observed.is_control.sum()) >= needed:
        if can_adjust(model.reconstruction):
            result = _adjusted(result, capture, config, report, bars)
        else:
            report.warning("A model with camera rigs is georeferenced by control, but not adjusted to it.")
    if result.adjusted is None:  # refit with the adjustment's roles and sigmas of control
        observed = observed_in(site, result.survey, model, start[0].scale, config.mark_sigma_px)
        observed = with_sigmas_times(observed, result.sigma_factor)
        fit = fit_jointly(fit.similarity, observed, start[1])
        placed = GeoreferencedModel(model, fit.similarity, fit.offsets)
        result = replace(result, placed=placed, frame=_frame(frame, result.survey, site, fit, config))
    return result


def _frame(frame: Frame | None, survey: Survey, site: LocalSurvey, fit: JointFit, config: GeorefConfig) -> Frame:
    control = survey.of_role("control")
    heights = any(point.surveyed.z is not None for point in control)
    vertical = survey.crs.vertical if heights else UNKNOWN if frame is None else frame.vertical_datum
    if vertical == UNKNOWN and config.vertical != "auto":
        vertical = parse_vertical(config.vertical)
    by = [f"{len(control)} control point{'s' if len(control) > 1 else ''}"] if control else []
    by += [f"the positions of {len(site.stations)} photos"] if len(site.stations) else []
    note = f"From {' and '.join(by)}."
    if not heights:
        note += " Heights are the positions'." if len(site.stations) else " Heights are relative to the control points."
    residuals = dict(frame.residuals) if frame is not None else {}
    residuals.pop("uncertainty", None)  # applies to the positions alone
    left_out = frame.left_out if frame is not None else ()
    return Frame("enu", fit.similarity, site.origin, vertical, residuals, left_out, note)


@dataclass(frozen=True)
class _Case:
    """What all adjustments of a capture start from."""

    result: ControlResult
    capture: GeorefInput
    config: GeorefConfig
    start: ControlStart
    bars: FoundBars | None


@dataclass(frozen=True)
class _TrustedAdjustment:
    """An adjustment with the control points, bars and sigmas it used."""

    survey: Survey
    done: ControlAdjustment
    ends: Mapping[str, int]
    factor: float
    noise: float


def _adjust_until_consistent(case: _Case, report: Reporter) -> _TrustedAdjustment:
    """Adjust until the control agrees, leaving out single blunders or else enlarging the sigmas."""
    best = _try(case.result.survey, 1.0, case)
    for _ in range(MAX_ROUNDS):
        better = _without_one(best, case) if best.noise > SUSPICIOUS_SIGMAS else None
        if better is None:
            if best.noise <= MAX_QUIET_SIGMAS:
                break
            best = _try(best.survey, best.factor * best.noise, case)
            continue
        index, off, best = better
        point = best.survey.points[index]
        report.warning(
            f"{titled('Control', point.name)} is left out: after adjustment to the others, the photos place it "
            f"{off:.2f} m from"
            " its surveyed position.",
            "Check its coordinates and marks against the field book, correct the file, and run again.",
        )
    return best


def _try(survey: Survey, factor: float, case: _Case, rounds: int = ROUNDS) -> _TrustedAdjustment:
    chosen = _chosen(survey)
    targets = [_target(survey.points[k], k, factor, case) for k in chosen]
    bars, ends = _bars(survey, chosen, case)
    done = adjust(case.start, targets, bars, rounds)
    coordinates = np.array([3 if survey.points[k].surveyed.z is not None else 2 for k in chosen], dtype=np.int64)
    return _TrustedAdjustment(survey, done, ends, factor, _noise(done.normed, coordinates))


def _without_one(trusted: _TrustedAdjustment, case: _Case) -> tuple[int, float, _TrustedAdjustment] | None:
    """Return the point without which the others agree, its offset in metres, and that adjustment; None if there is
    none."""
    result, capture = case.result, case.capture
    chosen = _chosen(trusted.survey)
    if len(chosen) <= MIN_CONTROL or float(np.median(trusted.done.normed)) > MANY_OFF_SIGMAS:
        return None
    for worst in np.argsort(-trusted.done.normed, kind="stable")[:MAX_SUSPECTS].tolist():
        index = chosen[worst]
        points = list(trusted.survey.points)
        points[index] = points[index].left_out("adjusted to the others, the photos have it elsewhere")
        others, limit = trusted.survey.with_points(points), trusted.noise / SINGLE_BLUNDER_GAIN
        rest = _try(others, trusted.factor, case, SUSPECT_ROUNDS)
        if rest.noise <= limit and not rest.done.adjusted.converged:
            rest = _try(others, trusted.factor, case)
        if rest.noise <= limit:
            model = model_of(rest.done.reconstruction, capture.photos, capture.model.shutter)
            found = locate(trusted.survey.points[index], model, capture.photos, case.config.mark_sigma_px).found
            if found is not None:
                known = np.isfinite(result.site.targets.sigmas[index])
                place = result.placed.world_from_model.apply(found.xyz[None])[0]
                off = float(np.linalg.norm((place - result.site.targets.enu[index])[known]))
                return index, off, rest
    return None


def _adjusted(
    result: ControlResult, capture: GeorefInput, config: GeorefConfig, report: Reporter, bars: FoundBars | None
) -> ControlResult:
    """Return the result with the adjusted model, if the adjustment moves the images' content noticeably."""
    try:
        trusted = _adjust_until_consistent(_Case(result, capture, config, _start(result, capture), bars), report)
    except np.linalg.LinAlgError as error:
        report.warning(f"Control places the model, but cannot adjust it: {error}.", "Is the sparse model sound?")
        return result
    survey, done, factor = trusted.survey, trusted.done, trusted.factor
    if not done.usable:
        report.warning(
            "The adjustment to the control did not converge: the control georeferences the model without adjusting it.",
            "Check that the control is spread over the site and marked correctly.",
        )
        return replace(result, survey=survey)
    if factor > 1.0:
        far = factor > MISTAKEN_SIGMAS
        worth = factor * float(np.median(result.site.targets.sigmas[_chosen(survey), 0]))
        report.warning(
            f"The control points agree with each other and the photos to {worth:.2f} m only, {factor:.1f} times what"
            " they are stated or taken to be worth: their standard deviations are raised by that.",
            "So far apart, some are wrong: check their names, coordinates and marks against the field book."
            if far
            else "Were they measured with a hand-held receiver? --set georef.control_sigma_m=… sets their standard "
            "deviation.",
        )
    _warn_of_focal_lengths(done, capture, report)
    moved = moved_px(capture.model.reconstruction, done.reconstruction)
    adjusted_block = doubted(done.adjusted, capture.lenses) if capture.lenses_held else done.adjusted
    accuracy = accuracy_of(adjusted_block, done.observed)
    block = block_json(accuracy, capture.model.gsd(result.placed.world_from_model.scale), None)
    result = replace(result, survey=survey, moved_px=moved, sigma_factor=factor, focal_held=done.held, block=block)
    if moved < MIN_DEFORMATION_PX:
        return result
    report.note(
        f"Control moves what the photos show by {moved:.1f} px: the model is adjusted to it, and trained again."
    )
    world_from_model = result.placed.world_from_model
    adjusted = done.reconstruction
    model = model_of(adjusted, capture.photos, capture.model.shutter)
    points = [
        locate(point, model, capture.photos, config.mark_sigma_px) if point.found is not None else point
        for point in survey.points
    ]
    placed = GeoreferencedModel(model, world_from_model, done.offsets)
    every = world_from_model.inverse().apply(np.concatenate([done.places, done.bar_ends]))
    ends = {name: every[index] for name, index in trusted.ends.items()}
    return replace(result, survey=survey.with_points(points), placed=placed, adjusted=adjusted, bar_ends=ends)


def _warn_of_focal_lengths(done: ControlAdjustment, capture: GeorefInput, report: Reporter) -> None:
    """Warn of undetermined focal lengths, and of those that control moves far from the value in the metadata."""
    for number, camera in sorted(done.reconstruction.cameras.items()):
        known = capture.lenses.get(number)
        prior = None if known is None else known.focal_px
        if number in done.held:
            report.warning(
                f"Neither the photos nor the control determine the focal length (to {done.focal_sigmas[number]:.1%}):"
                " it stays within 3 % of the value in the metadata.",
                "Add control at another height, or oblique photos, for reliable heights.",
            )
        elif prior is not None and abs(camera.mean_focal_length() / prior - 1.0) > MAX_FOCAL_DEVIATION:
            report.warning(
                f"Control takes the focal length from {prior:.0f} to {camera.mean_focal_length():.0f} pixels,"
                " more than 10 % from the value in the metadata.",
                "Was another lens used, or are the photos cropped? Check heights against known ones.",
            )


def _noise(normed: Float64[np.ndarray, " n"], coordinates: Int64[np.ndarray, " n"]) -> float:
    """Return the control's RMS residual over its sigmas, with the degrees of freedom left by a similarity."""
    return math.sqrt(float((coordinates * normed**2).sum()) / max(int(coordinates.sum()) - SIMILARITY, 1))


def _chosen(survey: Survey) -> list[int]:
    return [k for k, point in enumerate(survey.points) if point.role == "control" and point.found is not None]


def _start(result: ControlResult, capture: GeorefInput) -> ControlStart:
    """The block of the model, with its positions: by the noise that their own adjustment found, else as weighted."""
    model, site = capture.model, result.site
    table = tie_table(model.reconstruction, model.image_ids)
    chosen = table.only(spread_points(table, sizes_of(table, model.reconstruction)))
    whole = capture.adjusted is not None and not capture.lenses_held
    priors = {} if capture.adjusted is not None or capture.lenses_held else _focal_priors(capture.lenses)

    def lens_of(camera: pycolmap.Camera) -> Lens:
        if whole:
            return lens_with_positions(camera, capture.lenses, table.cameras.count(camera.camera_id))
        known = capture.lenses.get(camera.camera_id, UNKNOWN_LENS)
        return simple_lens(camera, model.reconstruction.cameras[camera.camera_id], known, capture.lenses_held)

    start = result.placed.world_from_model
    block = block_of(chosen, model.reconstruction, start, lens_of, MIN_SIGMA_PX)
    sigma = tie_sigma(block)
    block = replace(block, sigmas=np.full_like(block.sigmas, sigma))
    return ControlStart(model.reconstruction, start, table, block, _positions(site, capture), priors)


def _focal_priors(lenses: Mapping[int, LensKnowledge]) -> dict[int, float]:
    return {number: known.focal_px for number, known in lenses.items() if known.focal_px is not None}


def _positions(site: LocalSurvey, capture: GeorefInput) -> PositionObservations:
    """The photos' positions, with an offset for each flight: control need not share their datum."""
    stations = site.stations
    count, groups = len(stations), stations.offset_sigmas()
    precision = np.zeros((3, count, count))
    for axis in range(3):
        precision[axis] = np.diag(1.0 / stations.sigmas[:, axis] ** 2)
    if capture.adjusted is None:
        return PositionObservations(stations.indices, site.station_enu, precision, stations.group, groups)
    done = capture.adjusted.done
    place = {name: k for k, name in enumerate(stations.names)}
    order = np.array([place[name] for name in done.names if name in place], dtype=np.int64)
    used = np.array([name in place for name in done.names])
    kept = replace(done.noise, of=done.noise.of[used])
    return PositionObservations(
        stations.indices[order],
        site.station_enu[order],
        kept.precision(done.positions.only(used)),
        stations.group[order],
        groups,
    )


def _target(point: SurveyPoint, index: int, factor: float, case: _Case) -> Target:
    """A point as the adjustment takes it, with its sigmas times a factor; without coordinates for infinite ones."""
    assert point.found is not None
    site, start = case.result.site, case.start.world_from_model
    marks = [(seen.index, seen.photo, seen.pixel) for seen in point.sightings if seen.index is not None and seen.agrees]
    place = start.apply(point.found.xyz[None])[0]
    return Target(site.targets.enu[index], factor * site.targets.sigmas[index], place, *_marks(marks, case))


def _marks(
    seen: Sequence[tuple[int, str, tuple[float, float]]], case: _Case
) -> tuple[list[tuple[int, Float64[np.ndarray, " 2"]]], Float64[np.ndarray, " m"]]:
    """Marks, given by the model's photo, its name and the photo's pixel, in the model's pixels; with their sigmas."""
    model = case.capture.model
    views = [model.view(index, case.capture.photos[photo].width) for index, photo, _ in seen]
    marks = [
        (model.image_ids[index], view.still(np.array(pixel)) * view.scale)
        for (index, _, pixel), view in zip(seen, views, strict=True)
    ]
    scales = [view.scale for view in views]
    return marks, case.config.mark_sigma_px * np.array(scales)


def _bars(survey: Survey, chosen: Sequence[int], case: _Case) -> tuple[TargetDistances, dict[str, int]]:
    """The scale bars, and the index of each end by name: control points first, then points without coordinates."""
    if case.bars is None:
        return NO_BARS, {}
    points = {point.name: point for point in survey.points if point.found is not None}
    index = {name: k for k, name in enumerate(case.capture.model.names)}
    places = {survey.points[k].name: place for place, k in enumerate(chosen)}
    ends: list[Target] = []
    unknown = np.full(3, np.inf)
    for name in sorted({name for bar in case.bars.bars for name in (bar.a, bar.b)} - set(places)):
        if name in points:
            target = _target(points[name], survey.points.index(points[name]), 1.0, case)
        else:
            pixels = case.bars.pixels[name]
            seen = [(index[photo], photo, pixel) for photo, pixel in sorted(pixels.items()) if photo in index]
            start = case.start.world_from_model.apply(case.bars.places[name][None])[0]
            target = Target(start, unknown, start, *_marks(seen, case))
        places[name] = len(chosen) + len(ends)
        ends.append(replace(target, place=target.start, sigmas=unknown))
    used = [case.bars.bars[k] for k in case.bars.used]
    pairs = np.array([[places[bar.a], places[bar.b]] for bar in used], dtype=np.int64).reshape(-1, 2)
    lengths, sigmas = (np.array([getattr(bar, key) for bar in used]) for key in ("metres", "sigma_m"))
    own = {name: places[name] for bar in case.bars.bars for name in (bar.a, bar.b)}
    return TargetDistances(tuple(ends), pairs, lengths, sigmas), own
