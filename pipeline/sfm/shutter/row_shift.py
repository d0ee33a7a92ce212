"""Where keypoints of a rolling shutter would be if all rows had been exposed when the middle one was."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.sfm.shutter.film_motion import FrameMotion, pose_later

MAX_SHIFT_SHARE = 0.05  # of the width: a larger shift is a point behind or beside the camera, not a shutter's


def row_shifts(
    camera: pycolmap.Camera,
    rotation: Float64[np.ndarray, "3 3"],
    motion: FrameMotion,
    points_cam: Float64[np.ndarray, "n 3"],
    pixels: Float64[np.ndarray, "n 2"],
    readout_s: float,
) -> Float64[np.ndarray, "n 2"]:
    """Compute by how much a rolling shutter moved keypoints.

    Row ``y`` is exposed ``readout_s * (y / height - 0.5)`` seconds after the middle one. The shift is the projection at
    that time minus that at the middle row's, both through the lens.

    Args:
        camera: The film's.
        rotation: The frame's at its middle row, cam_from_world.
        motion: The frame's.
        points_cam: What each keypoint shows, in the camera at the middle row's time, model units.
        pixels: The keypoints as they are in the frame.
        readout_s: From the first row to the last, seconds; negative if the last comes first.

    Returns:
        The shifts, pixels; zero where the lens has no projection.
    """
    late_s = readout_s * (pixels[:, 1] / camera.height - 0.5)
    with np.errstate(invalid="ignore", over="ignore"):
        still = np.asarray(camera.img_from_cam(points_cam), np.float64).reshape(-1, 2)
        moved = np.asarray(camera.img_from_cam(pose_later(points_cam, rotation, motion, late_s)), np.float64)
        shifts = moved.reshape(-1, 2) - still
        sound = np.isfinite(shifts).all(axis=1) & (np.abs(shifts) <= MAX_SHIFT_SHARE * camera.width).all(axis=1)
    return np.where(sound[:, None], shifts, 0.0)


def points_of_keypoints(
    model: pycolmap.Reconstruction, number: int, pixels: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 3"]:
    """Return what a frame's keypoints show, in its camera: their points, else as far away as the median of these."""
    image = model.images[number]
    camera = model.cameras[image.camera_id]
    pose = np.asarray(image.cam_from_world().matrix(), np.float64)
    rays = np.ones((len(pixels), 3))
    rays[:, :2] = np.nan_to_num(np.asarray(camera.cam_from_img(pixels), np.float64).reshape(-1, 2))
    rows = observed_rows(image)
    if not len(rows):
        return np.zeros((len(pixels), 3))
    points = np.stack([model.points3D[image.points2D[row].point3D_id].xyz for row in rows.tolist()])
    seen = points @ pose[:, :3].T + pose[:, 3]
    result = rays * float(np.median(seen[:, 2]))
    result[rows] = seen
    return result


def observed_rows(image: pycolmap.Image) -> Int64[np.ndarray, " k"]:
    """The rows of a photo's keypoints that observe points, ascending."""
    return np.array(sorted(image.get_observation_point2D_idxs()), np.int64)


def shifts_of_frames(
    model: pycolmap.Reconstruction,
    motions: Mapping[int, FrameMotion],
    keypoints: Mapping[int, Float64[np.ndarray, "_ 2"]],
    readout_s: float,
) -> dict[int, Float64[np.ndarray, "_ 2"]]:
    """Compute the shifts of all keypoints of the frames whose motion is known.

    Args:
        model: Poses at the middle rows, lenses, and points.
        motions: By COLMAP's image id.
        keypoints: As they are in the frames.
        readout_s: As in ``row_shifts``.
    """
    result = {}
    for number, motion in sorted(motions.items()):
        image = model.images[number]
        pixels = np.asarray(keypoints[number], np.float64)
        rotation = np.asarray(image.cam_from_world().matrix(), np.float64)[:, :3]
        points = points_of_keypoints(model, number, pixels)
        result[number] = row_shifts(model.cameras[image.camera_id], rotation, motion, points, pixels, readout_s)
    return result
