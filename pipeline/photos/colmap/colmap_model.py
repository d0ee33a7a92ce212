"""Read COLMAP's binary model of pinhole photos without pycolmap, which training and rendering may lack."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from splatpipe.pipeline.photos.colmap.colmap_file import (
    CAMERA,
    CAMERAS,
    COUNT,
    ELEMENT_BYTES,
    IMAGE,
    IMAGES,
    OBSERVATION,
    POINT,
    POINTS,
    ModelFile,
)

SIMPLE_PINHOLE, PINHOLE = 0, 1  # COLMAP's ids of the camera models, with 3 and 4 parameters
UNMATCHED = -1  # a keypoint without a point: all 64 bits set


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera: its size, focal lengths and principal point, in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, eq=False)
class ModelPhoto:
    """A photo of the model.

    Attributes:
        name: Its name.
        camera: Its camera.
        cam_from_world: Its pose.
        points: Ids of the points that it observes, one per keypoint, in the order of its keypoints.
    """

    name: str
    camera: Pinhole
    cam_from_world: Float64[np.ndarray, "4 4"]
    points: Int64[np.ndarray, " _"]


@dataclass(frozen=True, eq=False)
class Cloud:
    """The sparse points, by ascending id.

    Attributes:
        ids: COLMAP's ids.
        xyz: Positions, world units.
        rgb: Colours.
        errors_px: Mean reprojection errors, pixels; -1 where not known.
        track_lengths: Number of photos that observe each.
    """

    ids: Int64[np.ndarray, " n"]
    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    errors_px: Float64[np.ndarray, " n"]
    track_lengths: Int64[np.ndarray, " n"]


def read_photos(folder: Path) -> list[ModelPhoto]:
    """Read the posed photos of a model, by ascending id.

    Args:
        folder: With `cameras.bin` and `images.bin`.

    Raises:
        OSError: if a file cannot be read.
        ValueError: if one is broken, or a camera is not a pinhole camera.
    """
    cameras = _read_cameras(ModelFile(folder / CAMERAS))
    file = ModelFile(folder / IMAGES)
    photos: dict[int, ModelPhoto] = {}
    for _ in range(file.count(IMAGE.size + 1 + COUNT.size)):
        number, *pose, camera = file.take(IMAGE)
        name = file.name()
        if camera not in cameras:
            raise ValueError(f"{IMAGES}: {name} has a camera that is not there")
        observed = file.array(OBSERVATION)["point"]
        photos[number] = ModelPhoto(name, cameras[camera], _matrix(np.array(pose)), observed[observed != UNMATCHED])
    file.end()
    return [photo for _, photo in sorted(photos.items())]


def read_cloud(folder: Path) -> Cloud:
    """Read the sparse points of a model.

    Args:
        folder: With `points3D.bin`.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is broken.
    """
    file = ModelFile(folder / POINTS)
    rows: dict[int, tuple[float, ...]] = {}
    for _ in range(file.count(POINT.size)):
        number, *values, length = file.take(POINT)
        file.skip(length * ELEMENT_BYTES)
        rows[number] = (*values, length)
    file.end()
    ids = sorted(rows)
    table = np.array([rows[number] for number in ids], np.float64).reshape(-1, 8)
    return Cloud(
        np.array(ids, np.uint64).astype(np.int64),
        table[:, :3].copy(),
        table[:, 3:6].astype(np.uint8),
        table[:, 6].copy(),
        table[:, 7].astype(np.int64),
    )


def _read_cameras(file: ModelFile) -> dict[int, Pinhole]:
    cameras = {}
    for _ in range(file.count(CAMERA.size)):
        number, kind, width, height = file.take(CAMERA)
        if kind not in (SIMPLE_PINHOLE, PINHOLE):
            raise ValueError(f"camera {number} is not PINHOLE (COLMAP's model {kind})")
        *focal, cx, cy = file.take(struct.Struct("<4d" if kind == PINHOLE else "<3d"))
        cameras[number] = Pinhole(width, height, focal[0], focal[-1], cx, cy)
    file.end()
    return cameras


def _matrix(pose: Float64[np.ndarray, " 7"]) -> Float64[np.ndarray, "4 4"]:
    """Convert a pose from quaternion (w, x, y, z) and translation to a matrix.

    The sums are those of Eigen's ``toRotationMatrix``, so that the result equals COLMAP's matrices bit for bit.
    """
    if not np.isfinite(pose).all() or not pose[:4].any():
        raise ValueError(f"{IMAGES}: a pose that is zero or not finite")
    w, x, y, z = pose[:4].tolist()
    tx, ty, tz = 2.0 * x, 2.0 * y, 2.0 * z
    twx, twy, twz, txx, txy, txz = tx * w, ty * w, tz * w, tx * x, ty * x, tz * x
    tyy, tyz, tzz = ty * y, tz * y, tz * z
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1.0 - (tyy + tzz), txy - twz, txz + twy],
        [txy + twz, 1.0 - (txx + tzz), tyz - twx],
        [txz - twy, tyz + twx, 1.0 - (txx + tyy)],
    ]
    matrix[:3, 3] = pose[4:]
    return matrix
