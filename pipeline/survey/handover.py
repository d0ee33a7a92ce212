"""A splat and its cameras in the frame that people get them in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.ply import MIP_COMMENT
from splatpipe.pipeline.survey.crs import utm_of
from splatpipe.pipeline.survey.frames import Frame


def in_world(gaussians: Gaussians, frame: Frame) -> Gaussians:
    """The model in the world frame: finite, its quaternions of unit length.

    Args:
        gaussians: In the model's frame.
        frame: georef's.
    """
    similarity = frame.world_from_model
    moved = gaussians.transformed(
        float(similarity.scale),
        torch.from_numpy(np.ascontiguousarray(similarity.rotation, np.float64)),
        torch.from_numpy(np.ascontiguousarray(similarity.translation, np.float64)),
    )
    length = torch.linalg.vector_norm(moved.quats, dim=1, keepdim=True)
    moved.quats = moved.quats / length.clamp(min=1e-30)
    return moved.select(moved.finite() & (length[:, 0] > 0.0))


def ply_comments(frame: Frame, antialias: bool) -> list[str]:
    """Header lines that say in which frame the splat is."""
    comments = [MIP_COMMENT] if antialias else []
    if frame.origin is None:
        return [*comments, "frame: z up, arbitrary scale and heading"]
    origin = frame.origin
    where = f"{origin.latitude:.9f} {origin.longitude:.9f} {origin.height_m:.4f}"
    return [
        *comments,
        "frame: local east north up, metres",
        f"origin: {where} (latitude longitude in degrees, WGS 84; height in metres, in the vertical datum)",
        f"vertical datum: {frame.vertical_datum}",
        f"crs: {frame.crs or utm_of(origin.latitude, origin.longitude).text} (see georef.json)",
    ]


def cameras_json(cameras: Sequence[Camera], frame: Frame) -> list[dict[str, Any]]:
    """The cameras as 3DGS viewers read them: world-from-camera rotation and centre, in the splat's frame."""
    listed = []
    for index, camera in enumerate(cameras):
        rotation, centre = pose_in_world(camera, frame)
        listed.append(
            {
                "id": index,
                "img_name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "position": centre.tolist(),
                "rotation": rotation.tolist(),
                "fx": camera.fx,
                "fy": camera.fy,
            }
        )
    return listed


def pose_in_world(camera: Camera, frame: Frame) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """A camera's world-from-camera rotation (3, 3) and centre (3,) in the world frame."""
    similarity = frame.world_from_model
    rotation = np.asarray(similarity.rotation) @ camera.cam_from_world[:3, :3].T
    return np.asarray(rotation), np.asarray(similarity.apply(camera.centre()[None])[0])
