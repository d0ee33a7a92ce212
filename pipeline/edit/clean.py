"""Cleaning as an edit step: uses the run's cameras if the splat is a run's and nothing was merged into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from splatpipe.pipeline.edit.floaters.cleaning import clean_scene
from splatpipe.pipeline.edit.floaters.visibility import TrainingPhotos
from splatpipe.pipeline.edit.options import SEEN_MEGAPIXELS
from splatpipe.pipeline.edit.workpiece import Workpiece
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import reduced_camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.scene import turn_of


@dataclass(frozen=True)
class Clean:
    """Removes what is not part of the scene; see ``edit.floaters.cleaning``.

    Attributes:
        cameras: Cameras of the training photos, in the splat's frame as read, z up; empty if unknown.
    """

    cameras: Sequence[Camera] = ()

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Clean the splat; returns the record of the step.

        Raises:
            SplatpipeError: if nothing is left.
        """
        gaussians = piece.with_motion_applied()
        photos = None
        if self.cameras and not piece.merged:
            options = rasterizer.RenderOptions(sh_degree=gaussians.sh_degree, antialias=piece.facts.antialias)
            photos = TrainingPhotos([_seen_by(camera, piece) for camera in self.cameras], options)
        elif self.cameras:
            piece.notes.append(
                "A merged splat is cleaned without the run's photos, which do not cover all of it. Put --clean "
                "before --merge."
            )
        cleaned = clean_scene(gaussians, photos)
        if not bool(cleaned.keep.any()):
            raise SplatpipeError("Cleaning would remove the whole splat.", hint="Omit --clean.")
        piece.keep(cleaned.keep.numpy())
        return {"step": "clean", "photos": 0 if photos is None else len(photos.cameras), "removed": cleaned.removed}


def _seen_by(camera: Camera, piece: Workpiece) -> Camera:
    """The camera at reduced size, moved with the splat, in the splat's own axes."""
    pose = piece.travelled.camera_pose(camera.cam_from_world)
    pose[:3, :3] = pose[:3, :3] @ turn_of("z up", piece.facts.axes).numpy()
    return replace(reduced_camera(camera, SEEN_MEGAPIXELS), cam_from_world=pose)
