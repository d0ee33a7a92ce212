"""Write COLMAP models and verify them: pycolmap does not report a full disk."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pycolmap

CAMERA_BYTES = 24  # id, model, width, height; plus 8 per parameter
IMAGE_BYTES = 73  # id, pose, camera id, the name's terminator, number of points; plus the name, and 24 per point
POINT_BYTES = 51  # id, position, colour, error, track length; plus 8 per track element


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model as .bin files to a new folder, and read it back.

    Sizes are compared first: pycolmap aborts the whole process when it reads a truncated points file.

    Raises:
        OSError: ENOSPC, if the files are incomplete.
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
        if not path.is_file() or path.stat().st_size < 8 + size:  # 8: the element count
            raise _full(path)
    try:
        read = pycolmap.Reconstruction(folder)
    except (OSError, ValueError, RuntimeError, IndexError) as error:
        raise _full(folder) from error
    if (read.num_reg_images(), read.num_points3D()) != (model.num_reg_images(), model.num_points3D()):
        raise _full(folder)


def _full(path: Path) -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
