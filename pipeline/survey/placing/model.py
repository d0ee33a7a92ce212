"""The sparse model as georef uses it (camera centres, rotations and points), and copies of its files."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.colmap_folder import find_models
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.photos.colmap.colmap_reconstruction import read_reconstruction
from splatpipe.pipeline.photos.files.names import list_names, match_names
from splatpipe.pipeline.sfm.shutter.frame_shutter import FilmShutter, FrameShutter, frame_shutter, load_film_shutter

RAY_STEP = 1e-5  # step in x/z for finite differences: about a hundredth of a pixel


@dataclass(frozen=True)
class ModelView:
    """A photo in the model.

    Attributes:
        camera: COLMAP's camera, with its distortion.
        cam_from_model: Pose.
        scale: Camera pixels per photo pixel.
        shutter: Of a film's frame whose keypoints are corrected for a rolling shutter: pixels of rays and of points
            are those of the frame as it was taken.
    """

    camera: pycolmap.Camera
    cam_from_model: Float64[np.ndarray, "3 4"]
    scale: float
    shutter: FrameShutter | None = None

    def still(self, pixel: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, " 2"]:
        """A pixel of the photo as it would be, had all rows been exposed together; but for films, the pixel itself."""
        return pixel if self.shutter is None else self.shutter.still(pixel * self.scale) / self.scale

    def ray(self, pixel: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, " 2"]:
        """x/z and y/z of the ray through a pixel of the photo; not finite where the lens model is undefined."""
        found = self.camera.cam_from_img((self.still(pixel) * self.scale)[None])
        return np.full(2, np.nan) if found is None else np.asarray(found, np.float64).reshape(2)

    def pixels_by_ray(self, ray: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, "2 2"]:
        """Derivative of the photo's pixels by a ray's x/z and y/z; not finite where the lens model is undefined."""
        around = np.tile(np.append(ray, 1.0), (4, 1))
        around[:, :2] += RAY_STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        projected = self.camera.img_from_cam(around) if np.isfinite(ray).all() else None
        if projected is None:
            return np.full((2, 2), np.nan)
        projected = np.asarray(projected, np.float64).reshape(4, 2)
        return np.asarray((projected[::2] - projected[1::2]).T / (2.0 * RAY_STEP * self.scale))

    def pixel(self, point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 2"]:
        """Project a point of the model into the photo, in pixels; not finite behind the camera."""
        pixels, _ = project_through_lens(self.camera, self.cam_from_model, point[None])
        found = pixels[0] if self.shutter is None else self.shutter.taken(pixels[0], point)
        return np.asarray(found / self.scale)


@dataclass(frozen=True)
class SparseModel:
    """The parts of a sparse model that georef uses, photos sorted by name.

    Attributes:
        names: Registered photos by ingest's names; by the model's names where ingest does not know them.
        centres: Camera centres.
        cam_from_model: Rotations.
        points: The sparse cloud.
        image_ids: COLMAP's image ids of the photos.
        reconstruction: The COLMAP reconstruction behind all this.
        shutter: The rolling shutter that a film's keypoints are corrected for.
    """

    names: list[str]
    centres: Float64[np.ndarray, "n 3"]
    cam_from_model: Float64[np.ndarray, "n 3 3"]
    points: Float64[np.ndarray, "m 3"]
    image_ids: tuple[int, ...]
    reconstruction: pycolmap.Reconstruction
    shutter: FilmShutter | None = None

    def view(self, index: int, width: int) -> ModelView:
        """A photo's camera.

        Args:
            index: Index of the photo.
            width: Width of the photo in which pixels are given; the model may have been made from smaller photos.
        """
        number = self.image_ids[index]
        image = self.reconstruction.images[number]
        camera = self.reconstruction.cameras[image.camera_id]
        shutter = None if self.shutter is None else frame_shutter(self.reconstruction, number, self.shutter)
        return ModelView(camera, np.asarray(image.cam_from_world().matrix(), np.float64), camera.width / width, shutter)

    def gsd(self, scale: float) -> float | None:
        """Ground sampling distance (GSD) in a world ``scale`` times larger: the median of the photos' medians."""
        sizes = []
        for number in self.image_ids:
            image = self.reconstruction.images[number]
            seen = [self.reconstruction.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()]
            if seen:
                pose = np.asarray(image.cam_from_world().matrix(), np.float64)
                depths = np.array(seen) @ pose[2, :3] + pose[2, 3]
                focal = self.reconstruction.cameras[image.camera_id].mean_focal_length()
                sizes.append(scale * float(np.median(depths)) / focal)
        return float(np.median(sizes)) if sizes else None


def read_model(path: Path, photos: Iterable[str]) -> SparseModel:
    """Read a sparse model.

    Args:
        path: The model's folder.
        photos: The names that ingest gave the photos.

    Raises:
        SplatpipeError: if it cannot be read or has no photo with a pose.
    """
    reconstruction = read_reconstruction(path)
    if not any(image.has_pose for image in reconstruction.images.values()):
        raise SplatpipeError("The sparse model has no photo with a pose.", "Reconstruct again, with more overlap.")
    return model_of(reconstruction, photos, load_film_shutter(path))


def model_of(
    reconstruction: pycolmap.Reconstruction, photos: Iterable[str], shutter: FilmShutter | None = None
) -> SparseModel:
    """Extract what georef uses from a reconstruction.

    Args:
        reconstruction: The model.
        photos: The names that ingest gave the photos.
        shutter: The rolling shutter that a film's keypoints are corrected for.
    """
    images = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda image: image.name)
    poses = np.stack([np.asarray(image.cam_from_world().matrix(), dtype=np.float64) for image in images])
    rotations = poses[:, :, :3]
    centres = -np.einsum("nji,nj->ni", rotations, poses[:, :, 3])
    points = [point.xyz for _, point in sorted(reconstruction.points3D.items())]
    cloud = np.array(points, dtype=np.float64).reshape(-1, 3)
    finite: Bool[np.ndarray, " n"] = np.isfinite(centres).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
    matched = match_names((image.name for image in images), photos)
    names = [matched.get(image.name, image.name) for image, good in zip(images, finite, strict=True) if good]
    ids = tuple(image.image_id for image, good in zip(images, finite, strict=True) if good)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    return SparseModel(names, centres[finite], rotations[finite], cloud, ids, reconstruction, shutter)


def report_choice(folder: Path, report: Reporter) -> None:
    """Say which of a user's models is used, if there are several."""
    models = find_models(folder)
    if models is not None and models.note:
        report.note(models.note)


def report_unmatched(names: Iterable[str], photos: Collection[str], report: Reporter) -> None:
    """Warn of cameras of a user's model without photos, and of photos without cameras.

    Args:
        names: The model's photos.
        photos: The photos that ingest found.
        report: Receives the warnings.
    """
    placed = list(names)
    missing = sorted(set(placed) - set(photos))
    if missing:
        report.warning(
            f"{len(missing)} of {len(placed)} photos of the model in sparse/ {_are(missing)} missing in images/:"
            f" {list_names(missing)}.",
            "The others are used. Copy these into images/ under their names in the model.",
        )
    unplaced = sorted(set(photos) - set(placed))
    if unplaced:
        report.warning(
            f"{len(unplaced)} of {len(photos)} photos in images/ {_are(unplaced)} not in the model in sparse/: "
            f"{list_names(unplaced)}.",
            "Those are not used: to place them, run on the photos alone.",
        )


def _are(names: Collection[str]) -> str:
    return "is" if len(names) == 1 else "are"


def copy_model(source: Path, target: Path, may_link: bool) -> None:
    """Copy the model's files unchanged; link them where that is allowed (never for a user's own) and possible."""
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
