"""georef: determine the model's frame and its accuracy, from control and photo positions or, without them, from how
cameras are held. The model is copied byte for byte unless the adjustment with control changes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json
from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter, Summary
from splatpipe.pipeline.photos.files.photo_list import Photo, load_photo_list
from splatpipe.pipeline.sfm.lenses.lens_model import named_params, stated_lenses
from splatpipe.pipeline.sfm.model.sparse_model import write_model
from splatpipe.pipeline.sfm.shutter.frame_shutter import save_film_shutter
from splatpipe.pipeline.survey.adjustment.adjusted_positions import (
    adjust_model,
    adjusted_frame,
    adjustment_json,
    with_adjustment,
)
from splatpipe.pipeline.survey.adjustment.georef_input import GeorefInput
from splatpipe.pipeline.survey.adjustment.position_adjustment import FOCAL_SHARES, OTHER_FOCAL_SHARE, LensKnowledge
from splatpipe.pipeline.survey.boundary import write_boundary
from splatpipe.pipeline.survey.control.accuracy import GeoreferencedModel, accuracy_json, control_json, no_control
from splatpipe.pipeline.survey.control.blunders import gsd_m
from splatpipe.pipeline.survey.control.control import ControlResult, place_by_control
from splatpipe.pipeline.survey.control.local_survey import LocalSurvey, Targets, stations_of
from splatpipe.pipeline.survey.crs.crs import parse_vertical
from splatpipe.pipeline.survey.crs.frames import Frame, Undetermined, save_frame
from splatpipe.pipeline.survey.crs.world import in_crs, report_map_crs
from splatpipe.pipeline.survey.files.scale_bars import ModelScale, scale_by
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.assumed_heights import with_assumed_heights
from splatpipe.pipeline.survey.placing.fitting import FrameUndeterminedError
from splatpipe.pipeline.survey.placing.gps import georeference, read_positions, report_fit, report_frame
from splatpipe.pipeline.survey.placing.level import Positions, arbitrary_frame
from splatpipe.pipeline.survey.placing.model import (
    SparseModel,
    copy_model,
    model_of,
    read_model,
    report_choice,
    report_unmatched,
)
from splatpipe.pipeline.survey.plausibility.last_look import Placed, report_contradictions
from splatpipe.pipeline.survey.points.surveyed_points import Survey, load_survey
from splatpipe.pipeline.survey.targets.target_finds import load_finds, load_wanted
from splatpipe.pipeline.survey.targets.target_marks import TargetMarks
from splatpipe.pipeline.survey.targets.target_survey import (
    FoundBars,
    TargetSurvey,
    compare,
    marker_of,
    scale_json,
    scale_of,
    scale_summary,
    scaled,
)

DATUM_STEP_M = 1.0  # least offset that suggests another vertical datum; less may be the receiver's error


def run(config: GeorefConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """As ``_run``, on one thread: BLAS with several threads sums in another order."""
    with threadpool_limits(limits=1):
        return _run(config, inputs, out, report)


def _run(config: GeorefConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the parts frame (``frame.json``), model, control (``control.json``), accuracy (``accuracy.json``) and
    boundary (``boundary.json``).

    Raises:
        SplatpipeError: if the model cannot be read or has no photos, the control does not belong to this capture, or
            nothing lies inside the boundary.
    """
    source = inputs["sparse.model"]
    report.progress(0, 3, "reading the model", "steps")
    photos = load_photo_list(inputs["ingest.photos"]).by_name()
    model = read_model(source, photos)
    if inputs.photos_dir in source.parents:
        report_choice(inputs.photos_dir, report)
        report_unmatched(model.names, photos, report)
    positions = with_assumed_heights(model, read_positions(inputs["ingest.positions"]))
    report.progress(1, 3, "fitting the positions", "steps")
    lenses = _lens_knowledge(inputs["ingest.cameras"], inputs["ingest.lenses"], model, photos)
    capture = GeorefInput(model, positions, photos, lenses, inputs.settings.get("sparse.lens") == "held")
    frame, capture = _by_positions(config, capture, report)
    model, found = capture.model, capture.adjusted
    report.progress(2, 3, "fitting the control", "steps")
    controlled = None
    targets = TargetSurvey(
        load_wanted(inputs["control.points"]),
        load_finds(inputs["targets.found"]),
        model,
        photos,
        frame if isinstance(frame, Frame) else None,
        config.approximate_crs,
    )
    survey, scale, bars = _survey(targets, inputs, config, report)
    if survey is not None and any(point.sightings for point in survey.points):
        try:
            known = frame if isinstance(frame, Frame) else None
            controlled = place_by_control(survey, capture, known, config, report, bars)
        except FrameUndeterminedError as error:
            frame = frame if isinstance(frame, Frame) else Undetermined(str(error))
            report.warning(
                f"Control cannot georeference the model: {error}.", "Mark more control points, each in several photos."
            )
    alone = frame if isinstance(frame, Frame) else None
    if controlled is not None:
        frame = controlled.frame
        scale = scale_by(targets.wanted.bars, controlled.bar_ends) or scale
    if isinstance(frame, Undetermined) and scale is not None:
        frame = scaled(arbitrary_frame(model, positions, frame.why), scale)
        report.note(frame.note)
    elif scale is not None and isinstance(frame, Frame):
        compare(frame, scale, report, controlled is not None and bool(controlled.bar_ends))
    if isinstance(frame, Undetermined):
        report.warning(f"Arbitrary scale: {frame.why}.", "Lengths and heights in this result are not in metres.")
        frame = arbitrary_frame(model, positions, frame.why)
    frame = _declared(frame, config, controlled, report)
    placed_points = (controlled.placed.model if controlled is not None else model).points
    bounded = write_boundary(inputs["source.boundary"], frame, placed_points, out / "boundary.json", report)
    control, accuracy = _accuracy(config, controlled, (model, positions, frame), photos, report)
    adjustment = {} if found is None else adjustment_json(found, accuracy["gsd_m"])
    if controlled is not None and controlled.block is not None:
        bent = controlled.adjusted is not None or adjustment.get("adopted", False)
        adjustment |= {**controlled.block, "adopted": bent}
    if adjustment:
        accuracy["adjustment"] = adjustment
        _report_adjustment(adjustment, report)
    if found is not None and controlled is None:
        frame = with_adjustment(frame, adjustment)
        accuracy["uncertainty"] = frame.residuals["uncertainty"]
    contradictions = report_contradictions(
        Placed(frame, controlled.placed.model if controlled else model, positions, photos, controlled, alone), report
    )
    save_frame(frame, out / "frame.json")
    accuracy |= scale_json(targets.wanted.bars, scale, frame)
    for name, value in (("control.json", control), ("accuracy.json", accuracy)):
        write_json(out / name, value)
    adjusted = found.done.reconstruction if found is not None and found.adopted else None
    adjusted = controlled.adjusted if controlled is not None and controlled.adjusted is not None else adjusted
    if adjusted is not None:
        write_model(adjusted, out / "sparse" / "0")
        if model.shutter is not None:
            save_film_shutter(model.shutter, out / "sparse" / "0")
    else:
        copy_model(source, out / "sparse" / "0", may_link=inputs.photos_dir not in source.parents)
    report.progress(3, 3, "fitting the control", "steps")
    doubts = {"contradictions": [asdict(each) for each in contradictions]} if contradictions else {}
    return {**_summary(frame, controlled, accuracy), **doubts, **scale_summary(scale), **bounded}


def _survey(
    targets: TargetSurvey, inputs: Inputs, config: GeorefConfig, report: Reporter
) -> tuple[Survey | None, ModelScale | None, FoundBars | None]:
    """Return the survey, with marks from detected targets, the scale from scale bars, and these; None if not given."""
    control = inputs["source.control"]
    seen: list[TargetMarks] = []
    survey, marked = None, {}
    if control.is_file():
        finder = marker_of(targets, control, report, seen) if targets.finds else None
        survey = load_survey(control, config, targets.photos, targets.model, report, finder)
        marked = {point.name: point.found.xyz for point in survey.points if point.found is not None}
    elif targets.finds:
        seen.append(targets.marks({}, report))
    found = seen[0] if seen else TargetMarks((), {})
    return survey, *scale_of(targets, found, marked, report)


def _by_positions(
    config: GeorefConfig, capture: GeorefInput, report: Reporter
) -> tuple[Frame | Undetermined, GeorefInput]:
    """Return the frame by positions, if they determine one, and the capture, adjusted to accurate ones."""
    model, positions, photos = capture.model, capture.positions, capture.photos
    try:
        frame, fit = georeference(model, positions, config.max_position_error_m, photos)
    except FrameUndeterminedError as error:
        return Undetermined(str(error)), capture
    found = adjust_model(capture, frame, report) if config.adjust == "auto" else None
    if found is None or not found.adopted:
        report_fit(frame, fit, model, positions, report)
        return frame, replace(capture, adjusted=found)
    frame = adjusted_frame(frame, found)
    model = model_of(found.done.reconstruction, photos, model.shutter)
    report.note(frame.note)
    report_frame(frame, model, positions, report)
    return frame, replace(capture, model=model, adjusted=found)


def _declared(frame: Frame, config: GeorefConfig, controlled: ControlResult | None, report: Reporter) -> Frame:
    """Return the frame with the declared CRS and vertical datum."""
    stated = controlled.survey.crs.text if controlled is not None else ""
    if controlled is None and config.vertical != "auto":
        frame = replace(frame, vertical_datum=parse_vertical(config.vertical))
    frame = in_crs(frame, config.crs, stated, config.approximate_crs)
    report_map_crs(frame, asked=config.crs != "auto", report=report)
    return frame


def _lens_knowledge(
    cameras: Path, lenses: Path, model: SparseModel, photos: Mapping[str, Photo]
) -> dict[int, LensKnowledge]:
    """What files and metadata say of the cameras, in the model's pixels, by COLMAP camera id."""
    try:
        groups = read_json(cameras)["cameras"]
        stated = stated_lenses(read_json(lenses)["lenses"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatpipeError(f"The cameras {cameras} cannot be read: {error}", "Run with --rerun ingest.") from error
    known = {}
    for name, number in zip(model.names, model.image_ids, strict=True):
        camera = model.reconstruction.cameras[model.reconstruction.images[number].camera_id]
        if name not in photos or camera.camera_id in known or photos[name].camera >= len(groups):
            continue
        group, lens = groups[photos[name].camera], stated.get(photos[name].camera + 1)
        scale = camera.width / group["width"]
        centre = None
        if lens is not None:
            named = named_params(lens.colmap())
            centre = (scale * named["cx"], scale * named["cy"])
        focal = scale * group["focal_px"] if group["has_prior"] else None
        known[camera.camera_id] = LensKnowledge(
            focal, FOCAL_SHARES.get(group["focal_source"], OTHER_FOCAL_SHARE), centre
        )
    return known


def _accuracy(
    config: GeorefConfig,
    controlled: ControlResult | None,
    alone: tuple[SparseModel, Positions, Frame],
    photos: Mapping[str, Photo],
    report: Reporter,
) -> tuple[JSON, dict[str, JSON]]:
    """Return the contents of ``control.json`` and ``accuracy.json``."""
    if controlled is not None:
        control = control_json(controlled.survey, controlled.site, controlled.placed, photos, config.mark_sigma_px)
        gsd = gsd_m(controlled.survey, controlled.placed.model, controlled.placed.world_from_model.scale)
        accuracy = accuracy_json(controlled.survey, controlled.site, controlled.placed, gsd or None)
        _warn_of_heights(accuracy["tables"], report)
    else:
        control = no_control()
        accuracy = _accuracy_of_positions(*alone)
    return control, dict(accuracy)


def _warn_of_heights(tables: JSON, report: Reporter) -> None:
    """Warn if the check points' heights seem to be in another datum than the positions, and no control shows which."""
    check = tables["check"]
    if tables["control"] is None and check is not None and abs(check["mean_m"][2] or 0.0) > DATUM_STEP_M:
        report.warning(
            f"The check points' heights differ from the positions' by {check['mean_m'][2]:+.1f} m on average.",
            "They may be in another vertical datum. Control points with heights would determine the offset.",
        )


def _accuracy_of_positions(model: SparseModel, positions: Positions, frame: Frame) -> JSON:
    placed = GeoreferencedModel(model, frame.world_from_model, np.zeros((0, 3)))
    if frame.kind != "enu" or frame.origin is None:
        return accuracy_json(None, None, placed, model.gsd(frame.world_from_model.scale) if frame.metres else None)
    stations = stations_of(model, positions, frame)
    nothing = Targets(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    site = LocalSurvey(frame.origin, nothing, stations, frame.origin.enu_from_geodetic(stations.geodetic))
    placed = replace(placed, offsets=_flight_offsets(frame, stations.flights))
    gsd = model.gsd(frame.world_from_model.scale)
    return accuracy_json(None, site, placed, gsd, frame.residuals["uncertainty"])


def _flight_offsets(frame: Frame, flights: tuple[int, ...]) -> np.ndarray:
    """(f, 3) offset of each flight from the fit of positions, metres."""
    found = {int(flight["flight"]): flight["offset_m"] for flight in frame.residuals.get("flights", [])}
    return np.array([found.get(flight, [0.0, 0.0, 0.0]) for flight in flights], dtype=np.float64).reshape(-1, 3)


def _report_adjustment(adjustment: JSON, report: Reporter) -> None:
    """Report how well positions that the fit did not use are predicted, and what the ground's heights are worth."""
    if "sentence" in adjustment:
        report.note(f"{adjustment['sentence'][0].upper()}{adjustment['sentence'][1:]}.")
    sentence = (adjustment["heights"] or {}).get("sentence")
    if sentence:
        heights, _, remedy = sentence.partition("; ")
        report.warning(f"{heights[0].upper()}{heights[1:]}.", f"{remedy[0].upper()}{remedy[1:]}.")


def _summary(frame: Frame, controlled: ControlResult | None, accuracy: JSON) -> Summary:
    residuals = {key: value for key, value in frame.residuals.items() if key.startswith("rmse")}
    positions = accuracy["tables"]["gps"]
    if positions is not None and positions["rmse_up_m"] is None:
        residuals.pop("rmse_vertical_m", None)
    summary: dict[str, JSON] = {
        "kind": frame.kind,
        "note": frame.note,
        "positions_used": frame.residuals.get("photos_used", 0),
        "positions_left_out": len(frame.left_out),
        **residuals,
    }
    if controlled is not None:
        roles = [point.role for point in controlled.survey.points]
        summary |= {
            "control_points": roles.count("control"),
            "check_points": roles.count("check"),
            "points_left_out": roles.count("left_out"),
            "model_bent": controlled.adjusted is not None,
            "moved_px": controlled.moved_px,
            "focal_held": list(controlled.focal_held),
            "control_sigmas_times": controlled.sigma_factor,
            "tables": accuracy["tables"],
        }
    return summary
