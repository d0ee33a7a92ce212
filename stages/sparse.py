"""sparse: incremental structure from motion, one deterministic model out of it, and what became of every photo."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pycolmap

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter, Summary
from splatpipe.pipeline.scene.dataset import some
from splatpipe.pipeline.scene.parallel import watched
from splatpipe.pipeline.sfm.focal import UNOBSERVED, adjust_within, focal_sigmas
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.sparse_model import write_model

Model: TypeAlias = pycolmap.Reconstruction

LEAST_SHARE = 0.1  # of the photos; a model of fewer is an accident
ENOUGH_SHARE = 0.5  # below it a second attempt is worth its time
STRAY = 0.1  # of a focal length from its prior: worth a warning
STRAY_UNOBSERVED = 0.03  # which it may have where the photos cannot tell it


@dataclass(frozen=True)
class Attempt:
    """How to map.

    Attributes:
        relaxed: Accept fewer and worse inliers for a photo's pose.
        hold_focal: Keep focal lengths at their priors.
    """

    relaxed: bool = False
    hold_focal: bool = False


def run(config: SparseConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write ``sparse/0``, normalised, and ``models.json``.

    Raises:
        SplatpipeError: if too few photos can be placed.
    """
    database = inputs["matches.database"]
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        priors = {camera.camera_id: camera for camera in opened.read_all_cameras()}
    attempt = Attempt()
    models = _map(inputs, config, attempt, out, report)
    if _registered(models) < ENOUGH_SHARE * len(names):
        again = Attempt(relaxed=True)
        second = _map(inputs, config, again, out, report)
        if _registered(second) > _registered(models):
            attempt, models = again, second
    _check_enough(models, config, len(names))
    if _focal_unobserved(models[0], priors):
        again = Attempt(attempt.relaxed, hold_focal=True)
        held = _map(inputs, config, again, out, report)
        if _registered(held) >= _registered(models):
            attempt, models = again, held
            used = {models[0].images[number].camera_id for number in models[0].reg_image_ids()}
            focals = {number: priors[number].mean_focal_length() for number in used}
            adjust_within(models[0], focals, STRAY_UNOBSERVED)
    model = canonical(models[0], np.load(inputs["features.colours"]), _keypoint_counts(database))
    write_model(model, out / "sparse" / "0")
    summary = _summary(model, models[1:], names, priors, attempt)
    (out / "models.json").write_text(json.dumps(summary, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
    _warn(summary, report)
    return {**summary, "unregistered": len(summary["unregistered"]), "other_models": len(summary["other_models"])}


def _options(config: SparseConfig, attempt: Attempt, threads: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = config.min_model_size
    options.extract_colors = False  # the keypoints have theirs
    options.random_seed = config.seed
    options.mapper.random_seed = config.seed
    options.triangulation.random_seed = config.seed
    # With several threads COLMAP's and Ceres' sums depend on which ends first.
    options.num_threads = threads if config.parallel_adjustment else 1
    if attempt.relaxed:
        options.mapper.init_min_num_inliers = 50
        options.mapper.init_min_tri_angle = 6.0
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.abs_pose_min_inlier_ratio = 0.15
    if attempt.hold_focal:
        options.ba_refine_focal_length = False
        options.mapper.abs_pose_refine_focal_length = False
    return options


def _map(inputs: Inputs, config: SparseConfig, attempt: Attempt, out: Path, report: Reporter) -> list[Model]:
    """Every sub-model that mapping finds, the largest first."""
    database = inputs["matches.database"]
    with pycolmap.Database.open(database) as opened:
        total = opened.num_images()
    placed, begun = 0, 0
    stop = pycolmap.CancellationToken()

    def begin() -> None:
        nonlocal placed, begun
        placed, begun = 2, begun + 1

    def place() -> None:
        nonlocal placed
        placed += 1

    def look() -> None:
        what = "placing photos" if begun < 2 else f"placing photos (model {begun})"
        report.progress(min(placed, total), total, what, "photos")

    pycolmap.set_random_seed(config.seed)
    with tempfile.TemporaryDirectory(prefix="scratch-", dir=out, ignore_cleanup_errors=True) as scratch:
        found: Mapping[int, Model] = watched(
            lambda: pycolmap.incremental_mapping(
                database,
                scratch,
                scratch,
                _options(config, attempt, inputs.machine.threads),
                initial_image_pair_callback=begin,
                next_image_callback=place,
                cancellation_token=stop,
            ),
            look,
            stop.cancel,
        )
    return sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _registered(models: Sequence[Model]) -> int:
    return models[0].num_reg_images() if models else 0


def _check_enough(models: Sequence[Model], config: SparseConfig, total: int) -> None:
    count = _registered(models)
    if count < max(config.min_model_size, math.ceil(LEAST_SHARE * total)):
        raise SplatpipeError(
            f"Only {count} of {total} photos could be placed." if count else f"None of {total} photos could be placed.",
            hint="Photos must overlap by two thirds and be taken from different places."
            " Add overlap, or try --set matches.pairing=exhaustive.",
        )


def _focal_unobserved(model: Model, priors: Mapping[int, pycolmap.Camera]) -> bool:
    """Whether a focal length left its prior although the photos cannot tell it; control may, later."""
    used = {model.images[number].camera_id for number in model.reg_image_ids()}
    strayed = [number for number in sorted(used) if _stray(model.cameras[number], priors[number]) >= STRAY_UNOBSERVED]
    if not strayed or not all(priors[number].has_prior_focal_length for number in used):
        return False
    sigmas = focal_sigmas(model)
    return any(sigmas.get(number, math.inf) > UNOBSERVED for number in strayed)


def _stray(camera: pycolmap.Camera, prior: pycolmap.Camera) -> float:
    return float(abs(camera.mean_focal_length() / prior.mean_focal_length() - 1.0))


def _keypoint_counts(database: Path) -> npt.NDArray[np.int64]:
    with pycolmap.Database.open(database) as opened:
        count = opened.num_images()
        return np.array([opened.num_keypoints_for_image(number) for number in range(1, count + 1)], np.int64)


def canonical(model: Model, colours: npt.NDArray[np.uint8], counts: npt.NDArray[np.int64]) -> Model:
    """The same model, normalised, coloured, its points numbered in one fixed order.

    Args:
        model: Normalised in place.
        colours: (n, 3) RGB of all keypoints, image after image.
        counts: Keypoints of each image, by id from 1.
    """
    model.normalize()
    starts = np.concatenate([[0], np.cumsum(counts)])
    result = Model()
    for number in sorted({model.images[image].camera_id for image in model.reg_image_ids()}):
        result.add_camera_with_trivial_rig(model.cameras[number])
    for number in sorted(model.reg_image_ids()):
        old = model.images[number]
        places = np.array([point.xy for point in old.points2D], np.float64).reshape(-1, 2)
        image = pycolmap.Image(old.name, places, old.camera_id, number)
        result.add_image_with_trivial_frame(image, old.cam_from_world())
    tracks = [
        (sorted((element.image_id, element.point2D_idx) for element in point.track.elements), point)
        for point in model.points3D.values()
    ]
    for elements, point in sorted(tracks, key=lambda entry: entry[0]):
        rows = [starts[image - 1] + keypoint for image, keypoint in elements]
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
        result.add_point3D(point.xyz, track, np.rint(colours[rows].mean(axis=0)).astype(np.uint8))
    result.update_point_3d_errors()
    return result


def _summary(
    model: Model, others: Sequence[Model], names: Mapping[int, str], priors: Mapping[int, pycolmap.Camera], how: Attempt
) -> dict[str, JSON]:
    registered = set(model.reg_image_ids())
    return {
        "photos": len(names),
        "registered": len(registered),
        "points3d": model.num_points3D(),
        "mean_reprojection_error_px": round(model.compute_mean_reprojection_error(), 4),
        "mean_track_length": round(model.compute_mean_track_length(), 3),
        "relaxed": how.relaxed,
        "focal_held": how.hold_focal,
        "cameras": [
            {
                "id": number,
                "model": camera.model_name,
                "focal_px": round(camera.mean_focal_length(), 2),
                "prior_focal_px": round(priors[number].mean_focal_length(), 2),
                "has_prior": priors[number].has_prior_focal_length,
            }
            for number, camera in sorted(model.cameras.items())
        ],
        "unregistered": [name for number, name in sorted(names.items()) if number not in registered],
        "other_models": [sorted(other.images[number].name for number in other.reg_image_ids()) for other in others],
    }


def _warn(summary: Mapping[str, JSON], report: Reporter) -> None:
    left = summary["unregistered"]
    for other in summary["other_models"]:
        elsewhere = [name for name in other if name in set(left)]
        if elsewhere:
            report.warning(
                f"{len(elsewhere)} photos form another model that could not be joined: {some(elsewhere)}.",
                hint="They show another place, or the overlap with the others is missing.",
            )
    alone = sorted(set(left).difference(*summary["other_models"]))
    if alone:
        report.warning(f"{len(alone)} of {summary['photos']} photos could not be placed: {some(alone)}.")
    for camera in summary["cameras"]:
        if camera["has_prior"] and abs(camera["focal_px"] / camera["prior_focal_px"] - 1.0) > STRAY:
            report.warning(
                f"Calibration took the focal length from {camera['prior_focal_px']:.0f} to {camera['focal_px']:.0f}"
                " pixels, more than 10 % from what the metadata say.",
                hint="Heights and scale may be off: check them against known ones.",
            )
    if summary["focal_held"]:
        report.warning(
            "Photos of flat ground from one height cannot tell the focal length: it is held to 3 % of the metadata's.",
            hint="Add oblique photos, or a second height, for heights to be trusted.",
        )
