"""The trained scene of a run: the artifacts that its splat was made from, and cameras between its two frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.stages.line import CLEAN, EXPORT, FLYTHROUGH, LINE, TRAIN

READ = (*FLYTHROUGH.reads, "georef.frame")


def scene_parts(out: Path) -> dict[str, Path]:
    """The parts from which OUT's splat was made; those of the newest training if nothing was exported.

    Raises:
        UsageError: if training is not done.
    """
    found = {name: part.path for name, part in open_run_folder(out, LINE).lineage(EXPORT, CLEAN, TRAIN).items()}
    if "train.model" in found:
        found.setdefault("clean.model", found["train.model"])  # not cleaned yet, or by an older version
    missing = [name for name in READ if name not in found]
    if missing and "train.model" in found:
        raise UsageError(
            f"{out} was trained by an earlier version of splatpipe: {missing[0]} is missing.",
            hint=f"Run it again with this version: splatpipe run PHOTOS {out}",
        )
    if missing:
        raise UsageError(
            f"{out} has no trained splat: {missing[0]} is missing.",
            hint=f"Run the pipeline first: splatpipe run PHOTOS {out}",
        )
    return found


def in_model_frame(camera: Camera, world_from_model: Similarity) -> Camera:
    """A camera of the world frame of `splat.ply`, in the model frame."""
    pose = np.eye(4)
    pose[:3, :3] = camera.cam_from_world[:3, :3] @ world_from_model.rotation
    offset = camera.cam_from_world[:3, :3] @ world_from_model.translation + camera.cam_from_world[:3, 3]
    pose[:3, 3] = offset / world_from_model.scale
    return replace(camera, cam_from_world=pose)


def in_world_frame(camera: Camera, world_from_model: Similarity) -> Camera:
    """The inverse of ``in_model_frame``."""
    return replace(camera, cam_from_world=world_from_model.camera_pose(camera.cam_from_world))
