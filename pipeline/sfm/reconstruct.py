"""Cameras from the view graph: which mapper, and which of two answers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import pycolmap

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.sfm.capture import Capture, Found
from splatpipe.pipeline.sfm.focal import UNOBSERVED, adjust_within, focal_sigmas
from splatpipe.pipeline.sfm.mapping import MappingOptions, map_incremental
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.verified import read_verified

Model: TypeAlias = pycolmap.Reconstruction

LEAST_SHARE = 0.1  # of the photos; a model of fewer is an accident
ENOUGH_SHARE = 0.5  # below it a second attempt is worth its time
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


def reconstruct(capture: Capture, config: SparseConfig, report: Reporter) -> Found:
    """Find the cameras.

    Raises:
        SplatpipeError: if too few photos can be placed.
    """
    verified = read_verified(capture.database)
    attempt = Attempt()
    models = _map(capture, config, attempt, report)
    if _registered(models) < ENOUGH_SHARE * len(verified.names):
        again = Attempt(relaxed=True)
        second = _map(capture, config, again, report)
        if _registered(second) > _registered(models):
            attempt, models = again, second
    _check_enough(models, config, len(verified.names))
    if _focal_unobserved(models[0], verified.cameras):
        again = Attempt(attempt.relaxed, hold_focal=True)
        held = _map(capture, config, again, report)
        if _registered(held) >= _registered(models):
            attempt, models = again, held
            used = {models[0].images[number].camera_id for number in models[0].reg_image_ids()}
            focals = {number: verified.cameras[number].mean_focal_length() for number in used}
            adjust_within(models[0], focals, STRAY_UNOBSERVED)
    tried = ({"mapper": "incremental", "chosen": True, "focal_held": attempt.hold_focal},)
    return Found(models[0], tuple(models[1:]), capture.database, verified, capture.colours, tried)


def _map(capture: Capture, config: SparseConfig, attempt: Attempt, report: Reporter) -> list[Model]:
    """Every sub-model that mapping finds, the largest first."""
    options = MappingOptions(config.seed, config.min_model_size, attempt.relaxed, attempt.hold_focal)

    def tell(placed: int, total: int, what: str) -> None:
        report.progress(placed, total, what, "photos")

    return map_incremental(capture.database, capture.scratch, options, tell)


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
