"""The checked photo list that ingest writes, and reading of its photos and masks.

Pixels stay in the stored grid: the EXIF orientation is kept as a number for display only, and never
applied to geometry. A photo is read from the user's folder when its file is plain 8-bit RGB or grey, else from the
PNG that ingest converted it to.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.engine.runs.colmap_folder import has_model
from splatpipe.pipeline.photos.files.names import is_plain, list_names
from splatpipe.pipeline.photos.files.picture_file import STRIP_ROWS, open_picture

LIST_NAME = "photos.json"
CONVERTED_DIR = "converted"
MASK_DIR = "masks"
SKY_DIR = "sky_masks"


@dataclass(frozen=True)
class Photo:
    """A photo in use.

    Attributes:
        name: Path relative to the photo folder, in POSIX form; also its name in COLMAP's files.
        sha256: Of the file's bytes, in hexadecimal.
        width: Of the stored grid, pixels.
        height: Of the stored grid, pixels.
        camera: Index into the camera groups of ``ingest.cameras``.
        time: When it was taken, ISO 8601 local time of the camera; None if EXIF does not state it.
        orientation: EXIF orientation, 1 to 8; for display only.
        converted: The 8-bit PNG to read instead of the file, relative to the part; None when the file itself is plain.
        mask: The 8-bit PNG mask in the stored grid at full size, 0 where ignored, else 255; relative to the part.
        sky_mask: The sky mask likewise, 255 in the sky, else 0.
    """

    name: str
    sha256: str
    width: int
    height: int
    camera: int
    time: str | None = None
    orientation: int = 1
    converted: str | None = None
    mask: str | None = None
    sky_mask: str | None = None


@dataclass(frozen=True)
class PhotoList:
    """The photos in use, sorted by name."""

    photos: tuple[Photo, ...]

    def __len__(self) -> int:
        return len(self.photos)

    def by_name(self) -> Mapping[str, Photo]:
        """The photos under their names."""
        return {photo.name: photo for photo in self.photos}


def save_photo_list(photo_list: PhotoList, part: Path) -> None:
    """Write ``photos.json`` into a part's folder (which must exist); the bytes depend on the list alone."""
    records = [asdict(photo) for photo in sorted(photo_list.photos, key=lambda photo: photo.name)]
    write_json(part / LIST_NAME, {"photos": records})


def load_photo_list(part: Path) -> PhotoList:
    """Read the photo list that ingest wrote.

    Args:
        part: The folder of the part ``ingest.photos``.

    Raises:
        SplatpipeError: if the list is missing or broken.
    """
    try:
        records: list[dict[str, Any]] = read_json(part / LIST_NAME)["photos"]
        photos = tuple(Photo(**record) for record in records)
        if odd := [photo.name for photo in photos if not is_plain(photo.name)]:
            raise ValueError(f"the name {list_names(odd[:1])} has a control character")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatpipeError(
            f"The photo list in {part} cannot be read: {error}", hint="Run again with --rerun ingest."
        ) from error
    return PhotoList(tuple(sorted(photos, key=lambda photo: photo.name)))


def photo_root(photos_dir: Path) -> Path:
    """The folder that photo names are relative to: ``images/`` in a COLMAP-style folder, else the folder itself."""
    return photos_dir / "images" if has_model(photos_dir) else photos_dir


def photo_path(photo: Photo, part: Path, photos_dir: Path) -> Path:
    """The file that a photo's pixels are read from: its own, or the one it was converted to."""
    if photo.converted is not None:
        return _inside(part, photo.converted)
    return _inside(photo_root(photos_dir), photo.name)


def photo_bytes(photo: Photo, part: Path, photos_dir: Path) -> bytes:
    """Read the file that holds a photo's pixels; the user's own file must still be the one that was checked.

    Raises:
        SplatpipeError: if the file is gone or is no longer the one that was checked.
    """
    sha256 = photo.sha256 if photo.converted is None else None
    return read_checked(photo_path(photo, part, photos_dir), photo.name, sha256)


def read_checked(path: Path, name: str, sha256: str | None = None) -> bytes:
    """Read a whole file, and refuse it if its content has changed, whatever its size and times.

    Args:
        path: The file.
        name: Its name in messages.
        sha256: Of its bytes when it was checked; None for a file that splatpipe wrote itself.

    Raises:
        SplatpipeError: if it is gone or was replaced.
    """
    try:
        with open_regular(path) as file:
            data = file.read()
    except OSError as error:
        raise _changed(name, str(error)) from error
    if sha256 not in (None, hashlib.sha256(data).hexdigest()):
        raise _changed(name, "it was replaced")
    return data


def decode(photo: Photo, part: Path, photos_dir: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read a photo's pixels.

    Args:
        photo: One of the list.
        part: The folder of the part ``ingest.photos``.
        photos_dir: The user's folder.

    Returns:
        RGB in the stored grid (EXIF orientation not applied), writable.

    Raises:
        SplatpipeError: if the file is gone or is no longer the one that was checked.
    """
    picture = open_decoded(photo, part, photos_dir)
    pixels = np.empty((photo.height, photo.width, 3), np.uint8)
    for top in range(0, photo.height, STRIP_ROWS):  # Pillow makes two more copies of what it converts at once
        pixels[top : top + STRIP_ROWS] = picture.rows(top, min(photo.height, top + STRIP_ROWS))
    return pixels


@dataclass(frozen=True, eq=False)
class DecodedPhoto:
    """A photo decoded by Pillow, four bytes per pixel, from which rows are taken as arrays."""

    picture: Image.Image

    def rows(self, top: int, bottom: int) -> UInt8[np.ndarray, "rows w 3"]:
        """Return the rows from ``top`` up to ``bottom``, RGB in the stored grid."""
        return np.asarray(self.picture.crop((0, top, self.picture.width, bottom)))


def open_decoded(photo: Photo, part: Path, photos_dir: Path) -> DecodedPhoto:
    """Decode a photo as ``decode`` does, without an array of all its pixels.

    Raises:
        SplatpipeError: as ``decode``.
    """
    return DecodedPhoto(_picture(photo_bytes(photo, part, photos_dir), "RGB", photo.name, photo))


def decode_mask(photo: Photo, part: Path) -> UInt8[np.ndarray, "h w"] | None:
    """Read a photo's mask in the stored grid at full size: 0 where ignored, else 255; None if it has none.

    Raises:
        SplatpipeError: if the mask is gone or its size differs from the photo's.
    """
    return _decode_mask(photo, photo.mask, part)


def decode_sky_mask(photo: Photo, part: Path) -> UInt8[np.ndarray, "h w"] | None:
    """Read a photo's sky mask likewise: 255 in the sky, else 0."""
    return _decode_mask(photo, photo.sky_mask, part)


def _decode_mask(photo: Photo, file: str | None, part: Path) -> UInt8[np.ndarray, "h w"] | None:
    if file is None:
        return None
    return np.array(_picture(read_checked(_inside(part, file), file), "L", file, photo))


def _picture(data: bytes, mode: str, name: str, photo: Photo) -> Image.Image:
    """Decode a file of the photo's size."""
    try:
        # Ingest wrote this file or found it plain: it is never a TIFF with an orientation.
        picture = open_picture(BytesIO(data))
        if picture.size != (photo.width, photo.height):
            raise _changed(name, f"it is {picture.width} × {picture.height} px now")
        picture.load()
        return picture if picture.mode == mode else picture.convert(mode)
    except (OSError, ValueError, SyntaxError) as error:
        raise _changed(name, str(error)) from error


def _inside(folder: Path, relative: str) -> Path:
    parts = PurePosixPath(relative)
    if parts.is_absolute() or ".." in parts.parts:
        raise SplatpipeError(
            f"The photo list names a file outside its folder: {relative}", hint="Run with --rerun ingest."
        )
    return folder / parts


def _changed(name: str, what: str) -> SplatpipeError:
    return SplatpipeError(
        f"{name} has changed since the photos were checked: {what}",
        hint="Restore the photo, or run again to check the photos again.",
    )
