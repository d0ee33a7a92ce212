"""A film's rolling shutter beside its model: where marks in a frame would be, had all rows been exposed together.

``rolling_shutter.json`` lies beside COLMAP's files of a model whose keypoints are corrected, and beside no other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json
from splatpipe.pipeline.sfm.shutter.film_motion import FrameMotion
from splatpipe.pipeline.sfm.shutter.row_shift import observed_rows, row_shifts

SHUTTER_NAME = "rolling_shutter.json"
NEAR = 5  # keypoints around a mark, the median of whose depths is taken for the mark's
ROUNDS = 4  # a row's shift changes the row: after two rounds by a thousandth of the shift


@dataclass(frozen=True, eq=False)
class FilmShutter:
    """A determined readout time, and the motions that the keypoints were corrected with.

    Attributes:
        readout_s: From the first row to the last, seconds; negative if the last is exposed first.
        motions: By the photo's name, in the model's frame.
    """

    readout_s: float
    motions: Mapping[str, FrameMotion]


@dataclass(frozen=True, eq=False)
class FrameShutter:
    """The shutter of one frame.

    Attributes:
        camera: The film's.
        cam_from_model: The frame's pose at its middle row.
        motion: Its motion.
        readout_s: As in ``FilmShutter``.
        seen_px: Keypoints that observe points, as corrected.
        seen_cam: These points in the camera.
    """

    camera: pycolmap.Camera
    cam_from_model: Float64[np.ndarray, "3 4"]
    motion: FrameMotion
    readout_s: float
    seen_px: Float64[np.ndarray, "n 2"]
    seen_cam: Float64[np.ndarray, "n 3"]

    def still(self, pixel: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, " 2"]:
        """Where something marked in the frame would be; as far away as the keypoints around it."""
        ray = self.camera.cam_from_img(pixel[None])
        if ray is None or not len(self.seen_px) or not np.isfinite(ray).all():
            return pixel
        near = np.argsort(np.linalg.norm(self.seen_px - pixel, axis=1), kind="stable")[:NEAR]
        point = float(np.median(self.seen_cam[near, 2])) * np.append(np.asarray(ray, np.float64).reshape(2), 1.0)
        return np.asarray(pixel - self._shift(point, pixel))

    def taken(self, pixel: Float64[np.ndarray, " 2"], point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 2"]:
        """Where the frame shows a point of the model whose projection at the middle row's time is given."""
        in_camera = self.cam_from_model[:, :3] @ point + self.cam_from_model[:, 3]
        if not np.isfinite(pixel).all() or in_camera[2] <= 0.0:
            return pixel
        found = pixel
        for _ in range(ROUNDS):
            found = pixel + self._shift(in_camera, found)
        return np.asarray(found)

    def _shift(self, in_camera: Float64[np.ndarray, " 3"], pixel: Float64[np.ndarray, " 2"]) -> np.ndarray:
        rotation = self.cam_from_model[:, :3]
        shifts = row_shifts(self.camera, rotation, self.motion, in_camera[None], pixel[None], self.readout_s)
        return np.asarray(shifts[0])


def frame_shutter(model: pycolmap.Reconstruction, number: int, film: FilmShutter) -> FrameShutter | None:
    """The shutter of a photo of a model; None if its motion is not known."""
    image = model.images[number]
    motion = film.motions.get(image.name)
    if motion is None:
        return None
    pose = np.asarray(image.cam_from_world().matrix(), np.float64)
    seen = [image.points2D[row] for row in observed_rows(image).tolist()]
    pixels = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
    points = np.array([model.points3D[point.point3D_id].xyz for point in seen], np.float64).reshape(-1, 3)
    in_camera = points @ pose[:, :3].T + pose[:, 3]
    return FrameShutter(model.cameras[image.camera_id], pose, motion, film.readout_s, pixels, in_camera)


def save_film_shutter(film: FilmShutter, folder: Path) -> None:
    """Write ``rolling_shutter.json`` beside a model's files."""
    frames = {
        name: {"velocity": motion.velocity.tolist(), "turning": motion.turning.tolist()}
        for name, motion in sorted(film.motions.items())
    }
    write_json(folder / SHUTTER_NAME, {"readout_s": film.readout_s, "frames": frames})


def load_film_shutter(folder: Path) -> FilmShutter | None:
    """Read what ``save_film_shutter`` wrote; None if the folder has none.

    Raises:
        SplatpipeError: if it is broken.
    """
    path = folder / SHUTTER_NAME
    if not path.is_file():
        return None
    try:
        read = read_json(path)
        motions = {
            str(name): FrameMotion(_vector(frame["velocity"]), _vector(frame["turning"]))
            for name, frame in read["frames"].items()
        }
        return FilmShutter(float(read["readout_s"]), motions)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SplatpipeError(
            f"The film's shutter in {folder} cannot be read: {error}", hint="Run again with --rerun sparse."
        ) from error


def _vector(values: object) -> Float64[np.ndarray, " 3"]:
    vector = np.asarray(values, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError("a motion that is not three numbers")
    return vector
