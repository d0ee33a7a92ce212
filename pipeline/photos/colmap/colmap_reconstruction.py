"""The one way to read a COLMAP model with pycolmap, which trusts the numbers in a binary file.

A count or length of 2⁶¹ in a file of a few bytes would fill the memory, and a name without an end would never end.
So binary files are stepped through first. Text files have no such numbers, and pycolmap checks their values; but it
cuts names at blanks, so these are read here.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pycolmap

from splatpipe.pipeline.engine.errors import SplatpipeError
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
from splatpipe.pipeline.photos.colmap.colmap_text import plain_text, read_photos, require_cameras

BINARIES = (CAMERAS, IMAGES, POINTS)
TEXTS = ("cameras.txt", "images.txt", "points3D.txt")
RIGS, FRAMES = "rigs.bin", "frames.bin"  # which older models lack
_RIG = struct.Struct("<II")  # number, sensors
_SENSOR = struct.Struct("<iI")
_POSED = struct.Struct("<?")
_POSE = struct.Struct("<7d")
_FRAME = struct.Struct("<II7dI")  # number, rig, pose, data
_DATUM = struct.Struct("<iIQ")


def read_reconstruction(folder: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model, binary or text, from an untrusted folder.

    Args:
        folder: With `cameras`, `images` and `points3D`, all `.bin` or all `.txt`.

    Raises:
        SplatpipeError: if it is broken, or a camera, pose, position or keypoint is not finite.
    """
    try:
        if all((folder / name).is_file() for name in BINARIES):  # then pycolmap reads no text
            elements = _check_binary(folder)
            model = pycolmap.Reconstruction(folder)
        else:
            model = _read_text(folder)
            elements = sum(point.track.length() for point in model.points3D.values())
        _check_values(model)
        if sum(image.num_points3D for image in model.images.values()) != elements:
            _forget_missing_points(model)
    except (OSError, ValueError, RuntimeError, IndexError, KeyError, MemoryError) as error:
        raise SplatpipeError(
            f"The sparse model cannot be read: {' '.join(str(error).split())[:200]}",
            hint="It must have COLMAP's cameras, images and points3D files, as .bin or .txt: export it again.",
        ) from error
    return model


def _read_text(folder: Path) -> pycolmap.Reconstruction:
    """Read a text model, with whole names.

    Raises:
        OSError, ValueError, RuntimeError, IndexError, KeyError: if it is broken or not whole.
    """
    _require_files(folder)
    photos = read_photos(folder / TEXTS[1])
    require_cameras(folder / TEXTS[0], photos)
    with plain_text(folder, photos) as plain:
        model = pycolmap.Reconstruction(plain)
    for number, name in photos.names.items():
        model.images[number].name = name
    return model


def _require_files(folder: Path) -> None:
    """Name the file that is missing, of those that the folder has more of: binary ones or texts.

    Raises:
        ValueError: if text files are missing.
    """
    lacking = [[name for name in names if not (folder / name).is_file()] for names in (BINARIES, TEXTS)]
    if lacking[1]:
        missing = min(reversed(lacking), key=len)
        raise ValueError(f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing")


def _forget_missing_points(model: pycolmap.Reconstruction) -> None:
    """Let no keypoint have a point that is not there: people thin out points3D, and leave images as it is."""
    for image in model.images.values():
        for index in image.get_observation_point2D_idxs():
            if not model.exists_point3D(image.point2D(index).point3D_id):
                image.reset_point3D_for_point2D(index)


def _check_binary(folder: Path) -> int:
    """Hold all counts and lengths against the files' sizes, and look for positions and keypoints that are not finite.

    Returns:
        The number of elements of all tracks.

    Raises:
        OSError, ValueError: if a file cannot be read or is broken.
    """
    _check_cameras(ModelFile(folder / CAMERAS))
    if (folder / RIGS).is_file():
        _check_rigs(ModelFile(folder / RIGS))
    if (folder / FRAMES).is_file():
        _check_frames(ModelFile(folder / FRAMES))
    _check_images(ModelFile(folder / IMAGES))
    file = ModelFile(folder / POINTS)
    count = 0
    for xyz in file.positions():
        if not np.isfinite(xyz).all():
            raise ValueError(f"{POINTS} has a point whose position is not finite")
        count += len(xyz)
    file.end()
    # What the file has besides the count and the points' other fields.
    return ((folder / POINTS).stat().st_size - COUNT.size - count * POINT.size) // ELEMENT_BYTES


def _check_cameras(file: ModelFile) -> None:
    for _ in range(file.count(CAMERA.size)):
        number, kind, *_ = file.take(CAMERA)
        try:
            model = pycolmap.CameraModelId(kind)
            parameters = len(pycolmap.Camera.create_from_model_id(number, model, 1.0, 1, 1).params)
        except ValueError as error:
            raise ValueError(f"{CAMERAS}: camera {number} is of an unknown model ({kind})") from error
        file.skip(parameters * 8)
    file.end()


def _check_rigs(file: ModelFile) -> None:
    for _ in range(file.count(_RIG.size)):
        _, sensors = file.take(_RIG)
        if sensors > 0:
            file.take(_SENSOR)  # the one that the others' poses refer to
        for _ in range(1, sensors):
            file.take(_SENSOR)
            (posed,) = file.take(_POSED)
            if posed:
                file.take(_POSE)
    file.end()


def _check_frames(file: ModelFile) -> None:
    for _ in range(file.count(_FRAME.size)):
        *_, data = file.take(_FRAME)
        file.skip(data * _DATUM.size)
    file.end()


def _check_images(file: ModelFile) -> None:
    for _ in range(file.count(IMAGE.size + 1 + COUNT.size)):
        file.take(IMAGE)
        name = file.name()
        if not np.isfinite(file.array(OBSERVATION)["xy"]).all():
            raise ValueError(f"{IMAGES}: a keypoint of {name[:100]} is not finite")
    file.end()


def _check_values(model: pycolmap.Reconstruction) -> None:
    """Check the numbers that both kinds of files have few of.

    Raises:
        ValueError: if a camera or pose is not finite, or a rotation has no direction.
    """
    for number, camera in model.cameras.items():
        if not np.isfinite(camera.params).all():
            raise ValueError(f"camera {number} has a parameter that is not finite")
    for image in model.images.values():
        if image.has_pose:
            pose = image.cam_from_world()
            length = float(np.linalg.norm(pose.rotation.quat))
            if not (0.0 < length < np.inf and np.isfinite(pose.translation).all()):
                raise ValueError(f"the pose of {image.name[:100]} is zero or not finite")
