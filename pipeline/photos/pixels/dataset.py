"""The dataset that `undistort` writes for training: `images/`, `masks/` and `sky_masks/` if any, `sparse/0`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.engine.files.json_file import json_text, read_json
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.colmap.colmap_model import Cloud, ModelPhoto, read_cloud, read_photos
from splatpipe.pipeline.photos.files.names import NameFinder, list_names

IMAGES = "images"
MASKS = "masks"
SKY_MASKS = "sky_masks"
MODEL = "sparse/0"

Model = TypeVar("Model")


@dataclass(frozen=True)
class View:
    """A photo of the dataset with its camera.

    Attributes:
        camera: Its pinhole camera; ``camera.name`` is the photo's name.
        image_path: The undistorted photo, in the camera's grid.
        mask_path: Its mask (8-bit, 0 = ignored, same grid), or None.
        sky_path: Its sky mask (8-bit, 0 = not sky, same grid), or None if the user supplied none.
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
        track_lengths: Number of photos that observe each.
        errors_px: Mean reprojection error of each, pixels of the undistorted photos; -1 where not known.
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    track_lengths: Int64[np.ndarray, " n"]
    errors_px: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz)


def image_path(dataset: Path, name: str) -> Path:
    """Return the path of the undistorted photo of that name."""
    return dataset / IMAGES / PurePosixPath(name)


def mask_path(dataset: Path, name: str, folder: str = MASKS) -> Path:
    """Return the path of its mask, by COLMAP's convention: the photo's full name followed by `.png`."""
    return dataset / folder / PurePosixPath(f"{name}.png")


def load_views(dataset: Path) -> list[View]:
    """Load the dataset's photos with their cameras, sorted by name.

    Args:
        dataset: The folder that `undistort` left.

    Raises:
        StageError: if the model is broken or not PINHOLE.
    """
    views = [_view(dataset, photo) for photo in _read(read_photos, dataset)]
    return sorted(views, key=lambda view: view.camera.name)


def _view(dataset: Path, photo: ModelPhoto) -> View:
    mask, sky = (mask_path(dataset, photo.name, folder) for folder in (MASKS, SKY_MASKS))
    lens = photo.camera
    return View(
        Camera(photo.name, lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, photo.cam_from_world),
        image_path(dataset, photo.name),
        mask if mask.is_file() else None,
        sky_path=sky if sky.is_file() else None,
    )


def load_points(dataset: Path) -> Points:
    """Load the dataset's sparse points.

    Args:
        dataset: The folder that `undistort` left.

    Raises:
        StageError: if the model is broken.
    """
    return _points(_read(read_cloud, dataset))


def load_points_and_tracks(dataset: Path) -> tuple[Points, dict[str, Int64[np.ndarray, " _"]]]:
    """Load the sparse points, and the rows of those that each photo observes: by photo name, ascending, each once.

    Args:
        dataset: The folder that `undistort` left.

    Raises:
        StageError: if the model is broken.
    """
    cloud = _read(read_cloud, dataset)
    tracks = {photo.name: _rows(cloud, photo) for photo in _read(read_photos, dataset)}
    return _points(cloud), tracks


def _rows(cloud: Cloud, photo: ModelPhoto) -> Int64[np.ndarray, " _"]:
    """Return the rows of the points that a photo observes."""
    observed = np.unique(photo.points)
    rows = np.searchsorted(cloud.ids, observed)
    if observed.size and not np.array_equal(cloud.ids[np.minimum(rows, len(cloud.ids) - 1)], observed):
        raise _broken(f"{photo.name} observes points that are not there")
    return rows


def _points(cloud: Cloud) -> Points:
    return Points(cloud.xyz, cloud.rgb, cloud.track_lengths, cloud.errors_px)


def _read(read: Callable[[Path], Model], dataset: Path) -> Model:
    try:
        return read(dataset / MODEL)
    except (OSError, ValueError) as error:
        raise _broken(str(error)) from error


def _broken(why: str) -> StageError:
    return StageError(f"The dataset's {MODEL} cannot be read: {why}", hint="Run again with --rerun-from undistort.")


def split_views(names: Sequence[str], every: int, views: str) -> Split:
    """Divide photos into those to train on and those held out for evaluation.

    Args:
        names: Names of all views.
        every: Every n-th in name order, starting with the first, is held out; 0 for none.
        views: Names to hold out instead, separated by commas; empty for the rule above. Case, suffix and folder may be
            left out where the name still matches only one photo.

    Raises:
        SplatpipeError: if a name is unknown or ambiguous, or if nothing is left to train on.
    """
    ordered = sorted(names)
    if views.strip():
        find = NameFinder(ordered)
        stated = {name.strip() for name in views.split(",")} - {""}
        found = {name: find(name) for name in sorted(stated)}
        if unknown := [name for name, photo in found.items() if photo is None]:
            raise SplatpipeError(
                f"split.views names {list_names(unknown)}, which the model does not have, or more than once.",
                hint=f"Its photos are named like {list_names(ordered)}.",
            )
        wanted = {photo for photo in found.values() if photo is not None}
    else:
        wanted = set(ordered[::every]) if every else set()
    training = [name for name in ordered if name not in wanted]
    if not training:
        raise SplatpipeError(
            f"All {len(ordered)} photos are held out, so none is left for training.",
            hint="Raise split.every, or set it to 0.",
        )
    return Split(tuple(training), tuple(name for name in ordered if name in wanted))


@dataclass(frozen=True)
class Split:
    """The split into training and held-out photos, decided once per run.

    Attributes:
        train: Names to train on, in name order.
        held_out: Names that training never sees, in name order.
    """

    train: tuple[str, ...]
    held_out: tuple[str, ...] = ()

    def to_json(self) -> str:
        """The text of `split.json`."""
        fields = {"train": self.train, "held_out": self.held_out}
        return json_text(fields)


def load_split(path: Path) -> Split:
    """Read the split that the stage `split` wrote.

    Raises:
        StageError: if it is missing or broken.
    """
    try:
        fields = read_json(path)
        return Split(tuple(map(str, fields["train"])), tuple(map(str, fields["held_out"])))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun-from split.") from error
