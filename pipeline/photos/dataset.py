"""The dataset that `undistort` leaves and training reads: `images/`, `masks/` and `sky_masks/` if any, `sparse/0`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64, UInt8

from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.names import NameFinder

IMAGES = "images"
MASKS = "masks"
SKY_MASKS = "sky_masks"
MODEL = "sparse/0"
NAMES_SHOWN = 5  # of a list in a message


@dataclass(frozen=True)
class View:
    """A photo of the dataset with its camera.

    Attributes:
        camera: Its pinhole camera; ``camera.name`` is the photo's name.
        image_path: The undistorted photo, in the camera's grid.
        mask_path: Its mask (8-bit, 0 = ignored, same grid), or None.
        sky_path: The mask of its sky (8-bit, 0 = something else, same grid), or None where nobody drew one.
    """

    camera: Camera
    image_path: Path
    mask_path: Path | None
    sky_path: Path | None = None


@dataclass(frozen=True)
class Points:
    """The sparse points, in the model's frame, in the order of their ids.

    Attributes:
        xyz: Positions, world units.
        rgb: Colours.
        track_lengths: How many photos each was seen in.
        errors_px: Mean reprojection error of each, pixels of the undistorted photos; -1 where not known.
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    track_lengths: Int64[np.ndarray, " n"]
    errors_px: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz)


def image_path(dataset: Path, name: str) -> Path:
    """Where the undistorted photo of that name lies."""
    return dataset / IMAGES / PurePosixPath(name)


def mask_path(dataset: Path, name: str, folder: str = MASKS) -> Path:
    """Where its mask lies, if it has one: COLMAP's convention, the photo's whole name with `.png` after it."""
    return dataset / folder / PurePosixPath(f"{name}.png")


def load_model(dataset: Path) -> pycolmap.Reconstruction:
    """Read `sparse/0`.

    Raises:
        StageError: if it is not there or broken.
    """
    try:
        return pycolmap.Reconstruction(dataset / MODEL)
    except (OSError, ValueError, RuntimeError) as error:
        raise StageError(
            f"The dataset's {MODEL} cannot be read: {error}", hint="Run again with --rerun-from undistort."
        ) from error


def load_views(dataset: Path) -> list[View]:
    """The dataset's photos with their cameras, sorted by name.

    Args:
        dataset: The folder that `undistort` left.

    Raises:
        StageError: if the model is broken or not PINHOLE.
    """
    model = load_model(dataset)
    views = [_view(dataset, image) for image in model.images.values() if image.has_pose]
    return sorted(views, key=lambda view: view.camera.name)


def _view(dataset: Path, image: pycolmap.Image) -> View:
    camera = image.camera
    if camera.model_name not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise StageError(f"The dataset's camera of {image.name} is {camera.model_name}, not PINHOLE.")
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    mask, sky = (mask_path(dataset, image.name, folder) for folder in (MASKS, SKY_MASKS))
    return View(
        Camera(
            image.name,
            int(camera.width),
            int(camera.height),
            float(camera.focal_length_x),
            float(camera.focal_length_y),
            float(camera.principal_point_x),
            float(camera.principal_point_y),
            pose,
        ),
        image_path(dataset, image.name),
        mask if mask.is_file() else None,
        sky_path=sky if sky.is_file() else None,
    )


def load_points(dataset: Path) -> Points:
    """The dataset's sparse points.

    Args:
        dataset: The folder that `undistort` left.

    Raises:
        StageError: if the model is broken.
    """
    return _points(load_model(dataset))


def load_points_and_tracks(dataset: Path) -> tuple[Points, dict[str, Int64[np.ndarray, " _"]]]:
    """The sparse points, and which of them each photo observes: rows by the photo's name, ascending, each once.

    Args:
        dataset: The folder that `undistort` left.

    Raises:
        StageError: if the model is broken.
    """
    model = load_model(dataset)
    numbers = np.array(sorted(model.points3D), np.int64)
    tracks = {}
    for image in model.images.values():
        observed = [point.point3D_id for point in image.points2D if point.has_point3D()]
        tracks[image.name] = np.searchsorted(numbers, np.unique(np.array(observed, np.int64)))
    return _points(model), tracks


def _points(model: pycolmap.Reconstruction) -> Points:
    points = [model.points3D[number] for number in sorted(model.points3D)]
    return Points(
        xyz=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        rgb=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        track_lengths=np.array([point.track.length() for point in points], np.int64),
        errors_px=np.array([point.error for point in points], np.float64),
    )


def split_views(names: Sequence[str], every: int, views: str) -> tuple[list[str], list[str]]:
    """Divide photos into those to train on and those held out for evaluation.

    Args:
        names: Names of all views.
        every: Every n-th in name order, starting with the first, is held out; 0 for none.
        views: Names to hold out instead, separated by commas; empty for the rule above. Case, suffix and folder may be
            left out where one photo alone is alike.

    Returns:
        Names to train on and names held out, each in name order.

    Raises:
        SplatpipeError: if a name is unknown or not clear, or if nothing is left to train on.
    """
    ordered = sorted(names)
    if views.strip():
        find = NameFinder(ordered)
        stated = {name.strip() for name in views.split(",")} - {""}
        found = {name: find(name) for name in sorted(stated)}
        if unknown := [name for name, photo in found.items() if photo is None]:
            raise SplatpipeError(
                f"evaluate.views names {some(unknown)}, which the model does not have, or more than once.",
                hint=f"Its photos are called like {some(ordered)}.",
            )
        wanted = {photo for photo in found.values() if photo is not None}
    else:
        wanted = set(ordered[::every]) if every else set()
    training = [name for name in ordered if name not in wanted]
    if not training:
        raise SplatpipeError(
            f"All {len(ordered)} photos are held out, so none is left to train on.",
            hint="Raise evaluate.every, or set it to 0.",
        )
    return training, [name for name in ordered if name in wanted]


def some(names: Sequence[str]) -> str:
    """A list of names for a message: the first few, and how many more."""
    shown = ", ".join(names[:NAMES_SHOWN])
    return shown + (f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else "")
