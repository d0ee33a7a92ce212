"""sparse: reconstruct cameras and points from the verified matches, and report what became of every photo."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pycolmap

from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter, Summary
from splatpipe.pipeline.photos.files.names import list_names
from splatpipe.pipeline.photos.files.photo_list import load_photo_list
from splatpipe.pipeline.photos.video.film_times import FilmTimes, load_film_times
from splatpipe.pipeline.sfm.by_camera import camera_rows, report_cameras, reset_underdetermined_focals
from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.judging.doubles import doubles_reasons, find_doubles
from splatpipe.pipeline.sfm.judging.external_evidence import outside_reasons
from splatpipe.pipeline.sfm.judging.judging import FEW_PAIRS, judge
from splatpipe.pipeline.sfm.lenses.lens_model import stated_lenses
from splatpipe.pipeline.sfm.lenses.lenses import calibrate, report_lenses
from splatpipe.pipeline.sfm.model.sparse_model import write_model
from splatpipe.pipeline.sfm.model.structure import read_structure
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.reconstruct import reconstruct
from splatpipe.pipeline.sfm.recovery.ladder import run_ladder
from splatpipe.pipeline.sfm.recovery.ladder_pairs import tried_pairs
from splatpipe.pipeline.sfm.shutter.frame_shutter import save_film_shutter
from splatpipe.pipeline.sfm.shutter.rolling_shutter import (
    Corrected,
    correct_rolling_shutter,
    film_shutter,
    report_shutter,
    shutter_summary,
)

Model: TypeAlias = pycolmap.Reconstruction


def run(config: SparseConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write ``sparse/0``, normalised, and ``models.json``.

    Raises:
        SplatpipeError: if too few photos can be placed.
    """
    with tempfile.TemporaryDirectory(prefix="scratch-", dir=out, ignore_cleanup_errors=True) as scratch:
        capture = _capture(inputs, Path(scratch))
        found = run_ladder(capture, reconstruct(capture, config, report), config, report)
        return_free_heap()
        reset_underdetermined_focals(found.model, found.verified, capture.cameras)
        film = load_film_times(inputs["ingest.photos"])
        shutter = None if film is None else _correct_shutter(found, film, config, report)
        if shutter is not None:
            found = replace(found, model=shutter.model, verified=shutter.verified)
        stated = stated_lenses(read_json(inputs["ingest.lenses"])["lenses"])
        model, lenses = calibrate(found.model, found.verified, stated, config.lens, config.seed)
        found = replace(found, model=model)
        tried = capture.tried | tried_pairs(found.database)
    found = replace(found, model=canonical(found.model, found.verified, found.colours))
    model = found.model
    return_free_heap()
    write_model(model, out / "sparse" / "0")
    if film is not None and shutter is not None and shutter.readout.determined:
        save_film_shutter(film_shutter(model, film, shutter.readout.estimate_s), out / "sparse" / "0")
    outside = outside_reasons(model, found.verified, capture.cameras, capture.positions)
    doubles = find_doubles(model, tried.union(found.verified.matches))
    verdict = judge(model, found.verified, capture.cameras)
    reasons = [*outside, *doubles_reasons(found.verified, doubles)]
    summary = {
        **_summary(model, found, capture.cameras),
        **({} if shutter is None else {"rolling_shutter": shutter_summary(shutter)}),
        "lenses": list(lenses),
        "alike": [[found.verified.names[number] for number in pair] for pair in verdict.alike],
        "doubles": doubles.as_json(found.verified),
        "verdict": verdict.joined(reasons).as_json(),
    }
    text = json.dumps(_without_times(summary), ensure_ascii=False, indent=1) + "\n"
    write_file(out / "models.json", text)
    _warn(summary, report)
    report_cameras(summary["cameras"], report)
    report_lenses(summary, report)
    counts = {key: len(summary[key]) for key in ("unregistered", "other_models", "alike")}
    return {**summary, **counts}


def _correct_shutter(found: MappingResult, film: FilmTimes, config: SparseConfig, report: Reporter) -> Corrected:
    """Correct a film's rolling shutter, if it has one, and say so."""
    held = any(row.get("focal_held") for row in found.tried if row["chosen"])
    priors = {number: camera.mean_focal_length() for number, camera in found.verified.cameras.items()} if held else {}
    corrected = correct_rolling_shutter(found.model, found.verified, film, priors, config.seed)
    report_shutter(corrected, report)
    return corrected


def _capture(inputs: Inputs, scratch: Path) -> MappingInput:
    photos = load_photo_list(inputs["ingest.photos"])
    numbers = {photo.name: number for number, photo in enumerate(photos.photos, start=1)}
    pairs = read_json(inputs["matches.pairs"])["pairs"]
    return MappingInput(
        database=inputs["matches.database"],
        features=inputs["features.database"],
        colours=np.load(inputs["features.colours"]),
        photos=photos,
        photos_part=inputs["ingest.photos"],
        photos_dir=inputs.photos_dir,
        positions=read_json(inputs["ingest.positions"])["positions"],
        cameras=read_json(inputs["ingest.cameras"])["cameras"],
        scratch=scratch,
        threads=inputs.machine.threads,
        tried=frozenset((numbers[first], numbers[second]) for first, second, _ in pairs),
    )


def _without_times(value: JSON) -> JSON:
    """Return the value without CPU seconds: the part's bytes must depend only on the result, not on timings."""
    if isinstance(value, dict):
        return {key: _without_times(entry) for key, entry in value.items() if key != "cpu_s"}
    return [_without_times(entry) for entry in value] if isinstance(value, list | tuple) else value


def canonical(model: Model, verified: ViewGraph, colours: npt.NDArray[np.uint8]) -> Model:
    """Return the model normalised, with coloured points numbered in a fixed order.

    Args:
        model: Normalised in place.
        verified: Its view graph.
        colours: (n, 3) RGB of all keypoints, image after image.
    """
    model.normalize()
    result = Model()
    for number in sorted({model.images[image].camera_id for image in model.reg_image_ids()}):
        result.add_camera_with_trivial_rig(model.cameras[number])
    for number in sorted(model.reg_image_ids()):
        old = model.images[number]
        places = verified.keypoints[number].astype(np.float64)
        image = pycolmap.Image(old.name, places, old.camera_id, number)
        result.add_image_with_trivial_frame(image, old.cam_from_world())
    structure = read_structure(model)
    own = np.split(colours, np.cumsum([len(verified.keypoints[number]) for number in sorted(verified.keypoints)])[:-1])
    for place, elements in zip(structure.points, structure.tracks, strict=True):
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
        seen = np.array([own[image - 1][keypoint] for image, keypoint in elements])
        result.add_point3D(place, track, np.rint(seen.mean(axis=0)).astype(np.uint8))
    result.update_point_3d_errors()
    return result


def _summary(model: Model, found: MappingResult, cameras: Sequence[JSON]) -> dict[str, JSON]:
    registered = set(model.reg_image_ids())
    names = found.verified.names
    return {
        "photos": len(names),
        "registered": len(registered),
        "points3d": model.num_points3D(),
        "mean_reprojection_error_px": round(model.compute_mean_reprojection_error(), 4),
        "mean_track_length": round(model.compute_mean_track_length(), 3),
        "tried": list(found.tried),
        "ladder": list(found.rungs),
        "cameras": camera_rows(model, found.verified, cameras),
        "unregistered": [name for number, name in sorted(names.items()) if number not in registered],
        "other_models": [
            sorted(other.images[number].name for number in other.reg_image_ids()) for other in found.others
        ],
    }


def _warn(summary: Mapping[str, JSON], report: Reporter) -> None:
    left = summary["unregistered"]
    for other in summary["other_models"]:
        elsewhere = [name for name in other if name in set(left)]
        if elsewhere:
            report.warning(
                f"{len(elsewhere)} photos form another model that could not be joined: {list_names(elsewhere)}.",
                hint="They show another scene, or do not overlap with the others.",
            )
    alone = sorted(set(left).difference(*summary["other_models"]))
    if alone:
        report.warning(f"{len(alone)} of {summary['photos']} photos could not be placed: {list_names(alone)}.")
    if len(summary["alike"]) >= FEW_PAIRS:
        report.note(
            f"{len(summary['alike'])} pairs of photos look alike without showing the same place (rows of windows?)."
        )
    for reason in summary["verdict"]["reasons"]:
        if reason["kind"] != "placed":  # reported above, by name
            bad = "The camera poses are unreliable: " if reason["level"] == "bad" else ""
            report.warning(f"{bad}{reason['text']}", reason["hint"])
    if any(row.get("focal_held") for row in summary["tried"] if row["chosen"]):
        report.warning(
            "The photos do not determine the focal length, as of flat ground from one height, or along a straight "
            "street: it is kept within 3 % of the metadata's.",
            hint="Add oblique photos, a second flying height, or photos from the other side, for reliable sizes.",
        )
