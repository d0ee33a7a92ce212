"""Undistort photos to pinhole cameras, and convert the sparse model accordingly."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap

from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.stage import Inputs, Reporter
from splatpipe.pipeline.geometry.camera import reduced_size
from splatpipe.pipeline.photos.files.names import list_names, match_names
from splatpipe.pipeline.photos.files.photo_list import Photo, decode_mask, decode_sky_mask, open_decoded
from splatpipe.pipeline.photos.pixels.dataset import MASKS, SKY_MASKS, image_path, mask_path
from splatpipe.pipeline.photos.pixels.jpeg_strips import write_jpeg
from splatpipe.pipeline.photos.pixels.resampling import Places, kept_places, resample, resampled_strips

SHAPE_TOLERANCE = 0.01  # between the aspect ratios of a photo and of its camera in the model
WHITE = 254.5  # mask value, 0 to 255, above which a pixel counts (or is sky): none of it is masked, all of it is sky
MIN_VIEWS = 2


@dataclass(frozen=True)
class RegisteredPhoto:
    """A photo with its camera in the model.

    Attributes:
        photo: The photo.
        image: Its image in the model.
        source: The model's camera, scaled to the photo's stored grid.
        target: The pinhole camera at training resolution; photos with equal cameras share its id.
    """

    photo: Photo
    image: pycolmap.Image
    source: pycolmap.Camera
    target: pycolmap.Camera


def plan_views(
    model: pycolmap.Reconstruction, photos: Sequence[Photo], max_megapixels: float, report: Reporter
) -> list[RegisteredPhoto]:
    """Find each image's photo and both its cameras, sorted by photo name.

    Raises:
        SplatpipeError: if fewer than two images of the model can be used.
    """
    by_name = {photo.name: photo for photo in photos}
    targets: dict[tuple[int, int, int], pycolmap.Camera] = {}
    placed: dict[str, RegisteredPhoto] = {}
    unusable: list[str] = []
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    matched = match_names((image.name for image in images), by_name)
    for image in images:
        name = matched.get(image.name)
        if name is None or name in placed:  # georef has told it
            continue
        photo = by_name[name]
        source = _camera_for(image, photo)
        if source is None:
            unusable.append(image.name)
            continue
        key = (image.camera_id, photo.width, photo.height)
        if key not in targets:
            targets[key] = pinhole_camera(source, max_megapixels, len(targets) + 1)
        placed[photo.name] = RegisteredPhoto(photo, image, source, targets[key])
    if len(placed) < MIN_VIEWS:
        raise SplatpipeError(
            f"Of the {len(images)} photos in the sparse model, {len(placed)} can be used.",
            hint="images/ must contain them, with the names and aspect ratios of the model.",
        )
    if unusable:
        names = list_names(unusable)
        report.warning(
            f"{len(unusable)} photos do not fit their cameras in the sparse model and are left out: {names}.",
            hint="Their aspect ratio differs, or their camera or pose is not finite.",
        )
    return [placed[name] for name in sorted(placed)]


def _camera_for(image: pycolmap.Image, photo: Photo) -> pycolmap.Camera | None:
    """The model's camera scaled to the photo's grid; None if they cannot belong together."""
    camera = pycolmap.Camera(image.camera.todict())
    if not np.isfinite(camera.params).all() or camera.mean_focal_length() <= 0 or camera.width * camera.height == 0:
        return None
    if not np.isfinite(image.cam_from_world().matrix()).all():
        return None
    by_x, by_y = photo.width / camera.width, photo.height / camera.height
    if abs(by_x / by_y - 1.0) > SHAPE_TOLERANCE:
        return None
    if (photo.width, photo.height) != (camera.width, camera.height):
        camera.rescale(photo.width, photo.height)
    return camera


def pinhole_camera(source: pycolmap.Camera, max_megapixels: float, number: int) -> pycolmap.Camera:
    """Return the largest pinhole camera without blank borders (COLMAP's choice), reduced to training resolution.

    Args:
        source: Any camera model.
        max_megapixels: Of the result, in 10⁶ pixels.
        number: The camera id to give it.
    """
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0
    camera = pycolmap.undistort_camera(options, source)
    size = reduced_size(camera.width, camera.height, max_megapixels)
    if size != (camera.width, camera.height):
        camera.rescale(*size)
    camera.camera_id = number
    return camera


def with_places(placed: Sequence[RegisteredPhoto]) -> Iterator[tuple[RegisteredPhoto, Places | None]]:
    """Yield the photos by camera, each with its camera's places, which are computed once if several photos share them.

    Only the places of the photos that are being worked on are held.
    """
    photos = Counter(view.target.camera_id for view in placed)
    of, places = 0, None
    for view in sorted(placed, key=lambda view: view.target.camera_id):
        if view.target.camera_id != of:
            of = view.target.camera_id
            places = kept_places(view.source, view.target) if photos[of] > 1 else None
        yield view, places


def write_view(view: RegisteredPhoto, places: Places | None, inputs: Inputs, dataset: Path) -> None:
    """Write a photo and its masks, undistorted.

    Args:
        view: The photo.
        places: Those of its cameras, or None.
        inputs: Of the stage.
        dataset: The folder of the dataset.
    """
    part = inputs["ingest.photos"]
    photo = open_decoded(view.photo, part, inputs.photos_dir)
    strips = resampled_strips(photo.rows, view.source, view.target, places)
    _write(image_path(dataset, view.photo.name), (strip[:, :, ::-1] for strip in strips), view.target.height)
    for folder, decoded in ((MASKS, decode_mask), (SKY_MASKS, decode_sky_mask)):
        mask = decoded(view.photo, part)
        if mask is not None:
            white = resample(mask, view.source, view.target, places) > WHITE
            _write(mask_path(dataset, view.photo.name, folder), [white.astype(np.uint8) * 255], len(white))


def _write(path: Path, strips: Iterable[npt.NDArray[np.uint8]], height: int) -> None:
    """Write an image in the format of its suffix: lossless PNG or TIFF at once; anything else as JPEG in strips."""
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".tif", ".tiff"):
        write_jpeg(path, strips, height)
        return
    done, encoded = cv2.imencode(suffix, np.concatenate(list(strips)))
    if not done:
        raise StageError(f"{path.name} could not be encoded.")
    write_file(path, encoded.data)


def pinhole_model(model: pycolmap.Reconstruction, placed: Sequence[RegisteredPhoto]) -> pycolmap.Reconstruction:
    """Convert the model to the pinhole cameras, with only the observations inside the undistorted photos.

    Points that other programs export without observations are kept.

    Args:
        model: The original model.
        placed: The photos in use.
    """
    result = pycolmap.Reconstruction()
    observed: dict[int, list[tuple[int, int]]] = {}
    for camera in {view.target.camera_id: view.target for view in placed}.values():
        result.add_camera_with_trivial_rig(camera)
    known = set(model.points3D)
    for view in placed:
        points, places = _observations(known, view)
        number = view.image.image_id
        image = pycolmap.Image(view.photo.name, places, view.target.camera_id, number)
        result.add_image_with_trivial_frame(image, view.image.cam_from_world())
        for index, point in enumerate(points):
            observed.setdefault(point, []).append((number, index))
    for number, old in sorted(model.points3D.items()):
        seen = observed.get(number, [])
        unobserved = old.track.length() < MIN_VIEWS
        if (len(seen) < MIN_VIEWS and not unobserved) or not all(map(math.isfinite, old.xyz)):
            continue
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in seen])
        result.add_point3D(old.xyz, track, old.color)
    result.update_point_3d_errors()
    for point in result.points3D.values():
        if point.track.length() == 0:
            point.error = -1.0  # COLMAP's "not known"
    return result


def _observations(known: Set[int], view: RegisteredPhoto) -> tuple[list[int], npt.NDArray[np.float64]]:
    """Which of the known points a photo observes, and their positions (n, 2) in the pinhole image, if inside it."""
    keypoints = view.image.points2D
    observations = [keypoints[index] for index in view.image.get_observation_point2D_idxs()]
    points = [observation.point3D_id for observation in observations]
    if not points:
        return [], np.zeros((0, 2))
    distorted = np.array([observation.xy for observation in observations], np.float64)
    target = view.target
    in_camera = view.image.camera.cam_from_img(distorted)
    focal = [target.focal_length_x, target.focal_length_y]
    places = in_camera * focal + [target.principal_point_x, target.principal_point_y]
    inside = np.isfinite(places).all(axis=1) & (places >= 0).all(axis=1)
    inside &= (places <= [target.width, target.height]).all(axis=1)
    keep = np.flatnonzero(inside & [point in known for point in points])
    return [points[index] for index in keep], places[keep]
