"""Masks of ignored pixels: found by name, and converted to the photo's stored grid at full size."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from splatpipe.pipeline.engine.digests import is_real_file
from splatpipe.pipeline.engine.machine import pseudo_devices
from splatpipe.pipeline.photos.files.picture_file import (
    LARGE_PIXELS,
    STRIP_ROWS,
    load_stored,
    open_picture,
    turn_to_decode,
    undo_orientation,
)
from splatpipe.pipeline.photos.files.scan import MASK_FOLDER, PHOTO_SUFFIXES, PhotoMask
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.exif import read_exif

ASPECT_TOLERANCE = 0.01
IMAGE_FOLDER = "images"
FEW_LABELS = 128  # a lossless mask with only lower values contains labels (0 and 1, or classes): all but 0 count
HALF = 128
MANY_TIMES = 2  # a mask has its photo's size; a larger one may be of photos that were reduced later
MASK_TAGS = ("_mask", ".mask")  # as other programs end a mask's name
QUARTER_TURNS = (5, 6, 7, 8)


class MaskError(Exception):
    """A mask that cannot be used; the text says why and ends a sentence that starts with its name."""


@dataclass(frozen=True)
class MaskFile:
    """A mask: a file below a ``masks/`` or ``sky_masks/`` folder, or beside its photo.

    Attributes:
        label: Its name in messages.
        key: Its name without the last suffix: a photo's name with or without its own suffix.
        path: Where it is.
    """

    label: str
    key: str
    path: Path


def find_masks(root: Path, called: str = MASK_FOLDER) -> list[MaskFile]:
    """Find every file below a ``masks/`` folder inside or beside the photo folder.

    ``masks/a/x.png`` inside or beside it and ``a/masks/x.png`` inside it belong to the photo ``a/x``.

    Args:
        root: The photo folder, which photo names are relative to.
        called: The name of the folders.
    """
    found: list[MaskFile] = []
    beside = root.parent / called
    if beside.is_dir() and beside != root:
        found += _mask_files(beside, PurePosixPath(), "../")
    for folder, folders, _ in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in [name for name in folders if name.casefold() == called]:
            folders.remove(name)
            above = PurePosixPath(Path(folder).relative_to(root).as_posix())
            found += _mask_files(Path(folder) / name, above, "" if str(above) == "." else f"{above}/")
    return found


def with_masks_beside(matched: Mapping[str, MaskFile], masks: Sequence[PhotoMask]) -> dict[str, MaskFile]:
    """Masks by photo name, with those that lie among the photos where a photo has no other."""
    return {**{mask.owner: MaskFile(mask.name, mask.owner, mask.path) for mask in masks}, **matched}


def match_masks(masks: Sequence[MaskFile], names: Sequence[str]) -> tuple[dict[str, MaskFile], list[MaskFile]]:
    """Match masks with photos.

    Args:
        masks: As found.
        names: Of all photos, including those left out.

    Returns:
        The masks by photo name, and the masks without a photo. ``NAME.ext.png`` takes precedence over ``NAME.png``,
        and this over ``NAME_mask.png``.
        A mask that matches no photo this way is matched with ``images/NAME``, as in COLMAP's folders.
    """
    by_key: dict[str, MaskFile] = {}
    for mask in masks:
        by_key.setdefault(mask.key, mask)
    matched = {name: by_key[key] for name in names if (key := _key(name, by_key)) is not None}
    used = {mask.path for mask in matched.values()}
    free = {key: mask for key, mask in by_key.items() if mask.path not in used}
    for name in names:
        short = _name_beside_images(name)
        if name not in matched and short is not None and (key := _key(short, free)) is not None:
            matched[name] = free[key]
    used = {mask.path for mask in matched.values()}
    return matched, [mask for mask in masks if mask.path not in used]


def _key(name: str, by_key: Mapping[str, MaskFile]) -> str | None:
    keys = (name, str(PurePosixPath(name).with_suffix("")))
    return next((key for key in (*keys, *(key + tag for key in keys for tag in MASK_TAGS)) if key in by_key), None)


def _name_beside_images(name: str) -> str | None:
    """A photo's name without the last folder called ``images``, as masks beside that folder are named; else None."""
    *folders, last = PurePosixPath(name).parts
    places = [place for place, folder in enumerate(folders) if folder.casefold() == IMAGE_FOLDER]
    if not places:
        return None
    return str(PurePosixPath(*folders[: places[-1]], *folders[places[-1] + 1 :], last))


def read_mask(mask: MaskFile, photo: CheckedPhoto, max_pixels: int) -> UInt8[np.ndarray, "h w"]:
    """Decode a mask and convert it to its photo's stored grid at full size.

    A mask may be drawn in the stored grid or in the one that EXIF rotates it to; its aspect ratio decides. Where both
    grids have the same one (a half turn, a square), it counts as stored unless it has an orientation of its own.

    Args:
        mask: The file.
        photo: Its photo.
        max_pixels: Refuse a larger mask.

    Returns:
        The mask: 0 where ignored, else 255.

    Raises:
        MaskError: if it cannot be decoded or has a different aspect ratio than the photo.
    """
    try:
        with open_picture(mask.path, max_pixels=max_pixels) as picture:
            _require_size(picture, photo)
            exif = read_exif(picture)
            lossless = picture.format in ("PNG", "TIFF")
            with turn_to_decode(picture.width * picture.height):
                grey = _grey(load_stored(picture, exif.orientation))
    except MaskError:
        raise
    except Exception as error:  # Pillow's readers raise almost anything on broken images
        raise MaskError(_problem(mask.path, error)) from error
    drawn = grey if exif.orientation == photo.exif.orientation else _to_stored(grey, exif.orientation, photo)
    if not _same_shape(drawn.size, (photo.width, photo.height)):
        raise _other_shape(grey)
    values = np.asarray(drawn)
    threshold = 1 if lossless and int(values.max()) < FEW_LABELS else HALF
    binary = Image.fromarray(np.where(values >= threshold, np.uint8(255), np.uint8(0)))
    return np.asarray(binary.resize((photo.width, photo.height), Image.Resampling.NEAREST))


def _problem(path: Path, error: Exception) -> str:
    """Why a mask cannot be read, without its path."""
    if isinstance(error, UnidentifiedImageError):
        return "is empty" if path.stat().st_size == 0 else "cannot be read: it is no picture, or its header is damaged"
    text = (error.strerror if isinstance(error, OSError) else None) or str(error)
    return f"cannot be read ({' '.join(text.split())[:120].replace(str(path), path.name)})"


def _require_size(picture: Image.Image, photo: CheckedPhoto) -> None:
    """Compare the size in a mask's header with its photo's, before any pixel is decoded.

    Raises:
        MaskError: if its aspect ratio is another, upright or turned, or it is far larger than its photo.
    """
    size = (photo.width, photo.height)
    if not any(_same_shape(picture.size, each) for each in (size, size[::-1])):
        raise _other_shape(picture)
    if picture.width * picture.height > max(LARGE_PIXELS, MANY_TIMES * photo.width * photo.height):
        raise MaskError(f"is far larger ({picture.width} × {picture.height}) than its photo")


def _other_shape(picture: Image.Image) -> MaskError:
    return MaskError(f"has another aspect ratio ({picture.width} × {picture.height}) than its photo")


def _to_stored(grey: Image.Image, own_orientation: int, photo: CheckedPhoto) -> Image.Image:
    """From the mask's own grid to the photo's stored one."""
    size = (photo.width, photo.height)
    orientation = photo.exif.orientation
    turned = size[::-1] if orientation in QUARTER_TURNS else size
    if own_orientation != 1:  # it was drawn on the photo as displayed
        upright = _apply_orientation(grey, own_orientation)
        if _same_shape(upright.size, turned):
            return undo_orientation(upright, orientation)
    if not _same_shape(grey.size, size) and _same_shape(grey.size, turned):
        return undo_orientation(grey, orientation)
    return grey


def _apply_orientation(picture: Image.Image, orientation: int) -> Image.Image:
    inverse = {6: 8, 8: 6}.get(orientation, orientation)
    return undo_orientation(picture, inverse)


def _same_shape(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Whether the aspect ratios are equal, except for the smaller image's rounding to whole pixels."""
    scale = first[0] / second[0]
    return abs(first[1] - scale * second[1]) <= max(1.0, ASPECT_TOLERANCE * first[1])


def _grey(picture: Image.Image) -> Image.Image:
    """Convert a mask to grey over black: transparent pixels are ignored ones."""
    if picture.mode.startswith("I") or picture.mode == "F":
        values = np.nan_to_num(np.asarray(picture))
        factor = 255.0 / 65535.0 if values.max() > 255.0 else 1.0
        grey = np.empty(values.shape, np.uint8)
        for top in range(0, len(values), STRIP_ROWS):
            strip = values[top : top + STRIP_ROWS].astype(np.float64)
            grey[top : top + STRIP_ROWS] = np.clip(np.ceil(strip * factor), 0, 255).astype(np.uint8)
        return Image.fromarray(grey)
    if picture.mode == "1":
        return picture.convert("L")
    if picture.has_transparency_data:
        rgba = picture.convert("RGBA")
        picture = Image.alpha_composite(Image.new("RGBA", rgba.size, (0, 0, 0, 255)), rgba)
    if picture.mode == "L":
        return picture
    rgb = np.asarray(picture.convert("RGB"))
    return Image.fromarray(rgb.max(axis=2))  # any colour counts: only black is ignored


def _mask_files(folder: Path, above: PurePosixPath, prefix: str) -> Iterator[MaskFile]:
    pseudo = pseudo_devices()
    for inner, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            path = Path(inner) / name
            if name.startswith(".") or path.suffix.casefold() not in PHOTO_SUFFIXES or not is_real_file(path, pseudo):
                continue
            relative = PurePosixPath(path.relative_to(folder).as_posix())
            label = os.fsencode(f"{prefix}{folder.name}/{relative}").decode("utf-8", errors="backslashreplace")
            yield MaskFile(label, str((above / relative).with_suffix("")), path)
