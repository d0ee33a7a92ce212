"""Writes COLMAP models, and makes sure that they are there: pycolmap does not say so when the disk is full."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pycolmap

CAMERA_BYTES = 24  # id, model, width, height; then 8 a parameter
IMAGE_BYTES = 73  # id, pose, camera id, the name's end, number of points; then the name, and 24 a point
POINT_BYTES = 51  # id, place, colour, error, length of the track; then 8 an element


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model as .bin files into a new folder, and read it back.

    Sizes are compared first: pycolmap ends the whole process when it reads a file of points that was cut off.

    Raises:
        OSError: ENOSPC, if the files are not whole.
    """
    folder.mkdir(parents=True)
    model.write_binary(folder)
    expected = {
        "cameras.bin": sum(CAMERA_BYTES + 8 * len(camera.params) for camera in model.cameras.values()),
        "images.bin": sum(
            IMAGE_BYTES + len(model.images[number].name.encode()) + 24 * model.images[number].num_points2D()
            for number in model.reg_image_ids()
        ),
        "points3D.bin": sum(POINT_BYTES + 8 * point.track.length() for point in model.points3D.values()),
    }
    for name, size in expected.items():
        path = folder / name
        if not path.is_file() or path.stat().st_size < 8 + size:  # 8: how many there are
            raise _full(path)
    try:
        read = pycolmap.Reconstruction(folder)
    except (OSError, ValueError, RuntimeError, IndexError) as error:
        raise _full(folder) from error
    if (read.num_reg_images(), read.num_points3D()) != (model.num_reg_images(), model.num_points3D()):
        raise _full(folder)


def _full(path: Path) -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
