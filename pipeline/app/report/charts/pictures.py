"""The report's images: held-out photos beside their renders, crops around GCP marks, and places that may be doubles."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.photo_list import Photo, decode, load_photo_list

VIEW_SIDE = 960  # pixels of the longer side of a held-out photo in the report
VIEW_QUALITY = 82
MAX_VIEWS = 12  # the worst and the best; the table has the figures of all
CROP_SIDE_PX = 48  # photo pixels across a crop: a mark, its surroundings, and a large reprojection error
MAX_CROP_SIDE_PX = 768  # if the reprojection error is larger than that
CROP_OUTPUT_PX = 96  # most pixels across in the report; the browser enlarges smaller crops
CROP_QUALITY = 80
MAX_CROPS = 600  # about two megabytes; if there are more, the worst of each point have priority
MAX_DECODED = 1_500_000_000  # pixels of photos decoded for them: about fifteen seconds on one core
DOUBLE_SHARE = 0.3  # side of the crop of a possible double, as a share of the photo's longer side
DOUBLE_PIXELS = 420  # most pixels across in the report
ROTATIONS_DEG = {3: 180, 6: 90, 8: 270}  # degrees, clockwise, by EXIF orientation; mirrored ones are left as they are
ROTATION_CODES = {180: cv2.ROTATE_180, 90: cv2.ROTATE_90_CLOCKWISE, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


@dataclass(frozen=True)
class ViewPictures:
    """A held-out photo, its render and their difference, as data URLs, rotated upright."""

    photo: Markup
    render: Markup
    error: Markup
    width: int
    height: int


@dataclass(frozen=True)
class PhotoCrop:
    """A crop of a photo around a mark.

    Attributes:
        picture: The image as a data URL; None if the photo could not be read.
        turn_deg: Clockwise rotation that makes it upright.
        marked: Position of the mark, x and y in per cent of the crop's side.
        reprojected: The model's point reprojected, likewise; None if unknown.
        side_px: Photo pixels across.
    """

    picture: Markup | None
    turn_deg: int
    marked: tuple[float, float]
    reprojected: tuple[float, float] | None
    side_px: int


def view_pictures(stem: Path, orientation: int) -> ViewPictures | None:
    """The images of one held-out view, reduced for the page; None if they are missing.

    Args:
        stem: Path of the images that `evaluate` wrote, without suffixes.
        orientation: EXIF orientation.
    """
    made = []
    shape = (0, 0)
    for kind in ("photo", "render", "error"):
        try:
            data = np.frombuffer(stem.with_name(f"{stem.name}.{kind}.png").read_bytes(), np.uint8)
        except OSError:
            return None
        pixels = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        if pixels is None:
            return None
        small = _rotated(shrunk(np.asarray(pixels, np.uint8), VIEW_SIDE), orientation)
        made.append(jpeg(small, VIEW_QUALITY))
        shape = (small.shape[1], small.shape[0])
    photo, render, error = made
    return ViewPictures(photo, render, error, *shape)


def chosen_views(views: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The views to show, worst first; if there are many, the worst and the best."""
    if len(views) <= MAX_VIEWS:
        return list(views)
    return [*views[: MAX_VIEWS - 1], views[-1]]


def cut_crops(
    points: Sequence[Mapping[str, Any]], photos_part: Path | None, photos_dir: Path | None
) -> dict[tuple[int, int], PhotoCrop]:
    """Make a crop for each observation of the surveyed points.

    Args:
        points: The points of `control.json`.
        photos_part: The part ``ingest.photos``; None leaves the images out.
        photos_dir: The user's folder.

    Returns:
        Crops by point and observation index; if too many, the worst of each point and those in the same photos.
    """
    photos = {} if photos_part is None else load_photo_list(photos_part).by_name()
    by_photo: dict[str, list[tuple[int, int]]] = {}
    for place in _worst_first(points)[:MAX_CROPS]:
        by_photo.setdefault(str(points[place[0]]["observations"][place[1]]["photo"]), []).append(place)
    crops: dict[tuple[int, int], PhotoCrop] = {}
    decoded = 0
    for name, places in by_photo.items():  # the photos with the worst marks first
        photo, pixels = photos.get(name), None
        if photo is not None and photos_part is not None and photos_dir is not None:
            decoded += photo.width * photo.height
            if decoded > MAX_DECODED:
                continue
            pixels = _decoded(photo, photos_part, photos_dir)
        for place in places:
            seen = points[place[0]]["observations"][place[1]]
            crops[place] = _mark_crop(seen, pixels, 1 if photo is None else photo.orientation)
    return crops


def double_crops(
    found: Mapping[str, Any], photos_part: Path | None, photos_dir: Path | None
) -> list[tuple[str, Markup]]:
    """Crop two photos around the place that should show the same in both.

    Args:
        found: ``doubles`` of `models.json`.
        photos_part: The part ``ingest.photos``; None leaves the images out.
        photos_dir: The user's folder.

    Returns:
        Name and image, as a data URL, of each; empty if a photo cannot be read.
    """
    if photos_part is None or photos_dir is None:
        return []
    photos = load_photo_list(photos_part).by_name()
    crops = []
    for name, (x, y) in zip(found.get("photos", []), found.get("places_px", []), strict=True):
        photo = photos.get(name)
        pixels = None if photo is None else _decoded(photo, photos_part, photos_dir)
        if photo is None or pixels is None:
            return []
        side = max(1, round(DOUBLE_SHARE * max(photo.width, photo.height)))
        cut = shrunk(_cut(pixels, round(x - side / 2), round(y - side / 2), side), DOUBLE_PIXELS)
        crops.append(
            (str(name), jpeg(np.ascontiguousarray(_rotated(cut, photo.orientation)[:, :, ::-1]), CROP_QUALITY))
        )
    return crops


def jpeg(pixels: UInt8[np.ndarray, "h w 3"], quality: int) -> Markup:
    """Encode an image as a JPEG data URL.

    Args:
        pixels: The image, BGR.
        quality: JPEG quality.
    """
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError("a picture could not be coded as JPEG")
    return Markup("data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode())


def _decoded(photo: Photo, part: Path, photos_dir: Path) -> UInt8[np.ndarray, "h w 3"] | None:
    try:
        return decode(photo, part, photos_dir)
    except SplatpipeError:  # the user's folder may be gone by now
        return None


def _worst_first(points: Sequence[Mapping[str, Any]]) -> list[tuple[int, int]]:
    """Every point's worst observation, then every point's second worst, and so on."""
    by_rank = []
    for i, point in enumerate(points):
        sizes = [(-_size(seen), j) for j, seen in enumerate(point.get("observations", []))]
        by_rank += [(rank, i, j) for rank, (_, j) in enumerate(sorted(sizes))]
    return [(i, j) for _, i, j in sorted(by_rank)]


def _size(seen: Mapping[str, Any]) -> float:
    residual = seen.get("residual_px")
    return float(np.hypot(*residual)) if residual else 0.0


def _mark_crop(seen: Mapping[str, Any], pixels: UInt8[np.ndarray, "h w 3"] | None, orientation: int) -> PhotoCrop:
    mark = np.array(seen["pixel"], np.float64)
    residual = seen.get("residual_px")
    side = CROP_SIDE_PX
    while residual and max(abs(residual[0]), abs(residual[1])) > 0.4 * side and side < MAX_CROP_SIDE_PX:
        side *= 2
    corner = np.floor(mark - side / 2).astype(int)
    picture = None
    if pixels is not None and np.all(mark > -side) and np.all(mark < np.array(pixels.shape[1::-1]) + side):
        cut = _cut(pixels, int(corner[0]), int(corner[1]), side)
        if side > CROP_OUTPUT_PX:
            cut = np.asarray(cv2.resize(cut, (CROP_OUTPUT_PX, CROP_OUTPUT_PX), interpolation=cv2.INTER_AREA), np.uint8)
        picture = jpeg(np.ascontiguousarray(cut[:, :, ::-1]), CROP_QUALITY)
    marked = (mark - corner) / side * 100.0
    found = None
    if residual:
        x, y = (mark + residual - corner) / side * 100.0
        found = (float(x), float(y)) if 0.0 <= x <= 100.0 and 0.0 <= y <= 100.0 else None
    return PhotoCrop(picture, ROTATIONS_DEG.get(orientation, 0), (float(marked[0]), float(marked[1])), found, side)


def _cut(pixels: UInt8[np.ndarray, "h w 3"], left: int, top: int, side: int) -> UInt8[np.ndarray, "side side 3"]:
    """Crop a square from a photo; grey outside the photo."""
    height, width = pixels.shape[:2]
    square = np.full((side, side, 3), 128, np.uint8)
    x0, x1, y0, y1 = max(left, 0), min(left + side, width), max(top, 0), min(top + side, height)
    if x1 > x0 and y1 > y0:
        square[y0 - top : y1 - top, x0 - left : x1 - left] = pixels[y0:y1, x0:x1]
    return square


def shrunk(pixels: UInt8[np.ndarray, "h w 3"], side: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Reduce an image so that its longer side has at most ``side`` pixels."""
    height, width = pixels.shape[:2]
    factor = side / max(width, height)
    if factor >= 1.0:
        return pixels
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def _rotated(pixels: UInt8[np.ndarray, "h w 3"], orientation: int) -> UInt8[np.ndarray, "_ _ 3"]:
    turn = ROTATIONS_DEG.get(orientation)
    return pixels if turn is None else np.asarray(cv2.rotate(pixels, ROTATION_CODES[turn]), np.uint8)
