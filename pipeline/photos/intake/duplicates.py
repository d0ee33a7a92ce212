"""Duplicate photos: they would count double in matching, and a held-out photo could be among the training photos.

And pictures that belong to a photo of the same name in another format: a mask or a depth map, told by its pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from splatpipe.pipeline.photos.files.companions import stem_of
from splatpipe.pipeline.photos.files.scan import ExcludedPhoto, PhotoMask
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.intake.convert import read_8bit

BLACK, WHITE = 5, 250  # grey levels of a mask, with JPEG's noise
MASK_SHARE = 0.98  # least share of black or white pixels by which a picture is a mask


def split_duplicates(photos: Sequence[CheckedPhoto]) -> tuple[list[CheckedPhoto], list[ExcludedPhoto]]:
    """Keep one of equal photos: that of the shortest file name, as copies are named ``NAME(1).JPG`` or ``NAME - Copy``.

    Survey files name the original, which would be lost for them. Of equally long names the first is kept.

    Args:
        photos: All of them.

    Returns:
        The photos that are kept, sorted by name, and the duplicates, with the name of the photo that each one equals.
    """
    kept: list[CheckedPhoto] = []
    left_out: list[ExcludedPhoto] = []
    by_sha: dict[str, CheckedPhoto] = {}
    by_fingerprint: dict[str, CheckedPhoto] = {}
    for photo in sorted(photos, key=lambda photo: (len(PurePosixPath(photo.name).name), photo.name)):
        twin = by_sha.get(photo.sha256)
        if twin is not None:
            left_out.append(ExcludedPhoto(photo.name, f"is the same file as {twin.name}", "duplicate"))
            continue
        by_sha[photo.sha256] = photo
        twin = by_fingerprint.get(photo.fingerprint)
        if twin is not None and _equal_pixels(photo, twin):
            left_out.append(ExcludedPhoto(photo.name, f"has the same pixels as {twin.name}", "duplicate"))
            continue
        by_fingerprint.setdefault(photo.fingerprint, photo)
        kept.append(photo)
    return sorted(kept, key=lambda photo: photo.name), left_out


def split_maps(photos: Sequence[CheckedPhoto]) -> tuple[list[CheckedPhoto], list[ExcludedPhoto], list[PhotoMask]]:
    """Tell pictures apart that belong to a photo of the same name with another suffix: ``a.png`` beside ``a.jpg``.

    Args:
        photos: All of them.

    Returns:
        The photos, the depth maps (grey, of more than 8 bits, beside a colour photo), and the masks (black and white).
    """
    groups: dict[tuple[str, str], list[CheckedPhoto]] = {}
    for photo in photos:
        path = PurePosixPath(photo.name)
        groups.setdefault((str(path.parent), stem_of(path.name)), []).append(photo)
    left_out: dict[str, ExcludedPhoto] = {}
    masks: list[PhotoMask] = []
    for group in groups.values():
        coloured = [photo for photo in group if not photo.grey and not _is_mask(photo)] if len(group) > 1 else []
        for photo in (photo for photo in group if coloured and photo not in coloured):
            if photo.deep_range is not None:
                left_out[photo.name] = ExcludedPhoto(photo.name, "is a depth map of another photo", "companion")
            elif _is_mask(photo):
                masks.append(PhotoMask(photo.name, coloured[0].name, photo.path))
    apart = {*left_out, *(mask.name for mask in masks)}
    return [photo for photo in photos if photo.name not in apart], list(left_out.values()), masks


def _is_mask(photo: CheckedPhoto) -> bool:
    """Whether a picture is black and white."""
    if photo.deep_range is not None:
        return False
    pixels, _ = read_8bit(photo, None)
    grey = pixels if pixels.ndim == 2 else pixels.max(axis=2)
    return bool(np.mean((grey <= BLACK) | (grey >= WHITE)) >= MASK_SHARE)


def _equal_pixels(first: CheckedPhoto, second: CheckedPhoto) -> bool:
    scale = first.deep_range
    return np.array_equal(read_8bit(first, scale)[0], read_8bit(second, scale)[0])
