"""The sparse model as georef needs it: camera centres, rotations and points, and its files as they are."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.scene.names import match_names


@dataclass(frozen=True)
class SparseModel:
    """What georef needs of a sparse model, its photos sorted by name.

    Attributes:
        names: Of the registered photos, as ingest has them; as the model has them where ingest does not know them.
        centres: Camera centres.
        cam_from_model: Rotations.
        points: Of the sparse cloud.
    """

    names: list[str]
    centres: Float64[np.ndarray, "n 3"]
    cam_from_model: Float64[np.ndarray, "n 3 3"]
    points: Float64[np.ndarray, "m 3"]


def read_model(path: Path, photos: Iterable[str]) -> SparseModel:
    """Read a sparse model.

    Args:
        path: Its folder.
        photos: The names that ingest gave the photos.

    Raises:
        SplatpipeError: if it cannot be read or has no photo with a pose.
    """
    import pycolmap

    try:
        reconstruction = pycolmap.Reconstruction(str(path))
    except Exception as error:  # pycolmap raises its C++ errors as several types
        raise SplatpipeError(
            f"The sparse model cannot be read: {' '.join(str(error).split())[:200]}",
            "It has to hold cameras, images and points3D, as COLMAP writes them (.bin or .txt).",
        ) from error
    images = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda image: image.name)
    if not images:
        raise SplatpipeError("The sparse model has no photo with a pose.", "Reconstruct again, with more overlap.")
    poses = np.stack([np.asarray(image.cam_from_world().matrix(), dtype=np.float64) for image in images])
    rotations = poses[:, :, :3]
    centres = -np.einsum("nji,nj->ni", rotations, poses[:, :, 3])
    points = [point.xyz for _, point in sorted(reconstruction.points3D.items())]
    cloud = np.array(points, dtype=np.float64).reshape(-1, 3)
    finite: Bool[np.ndarray, " n"] = np.isfinite(centres).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
    matched = match_names((image.name for image in images), photos)
    names = [matched.get(image.name, image.name) for image, good in zip(images, finite, strict=True) if good]
    return SparseModel(names, centres[finite], rotations[finite], cloud[np.isfinite(cloud).all(axis=1)])


def copy_model(source: Path, target: Path, may_link: bool) -> None:
    """The model's files as they are: linked where that is allowed (never a user's own) and possible, else copied."""
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.iterdir()):
        if path.is_file() and not path.name.startswith("."):
            copy = target / path.name
            copy.unlink(missing_ok=True)
            if may_link:
                with contextlib.suppress(OSError):  # another file system, or one without links
                    os.link(path, copy)
                    continue
            shutil.copyfile(path, copy)
