"""Duplicate photos: they would count double in matching, and a held-out photo could be among the training photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpipe.pipeline.photos.check import CheckedPhoto
from splatpipe.pipeline.photos.convert import read_8bit
from splatpipe.pipeline.photos.scan import ExcludedPhoto


def split_duplicates(photos: Sequence[CheckedPhoto]) -> tuple[list[CheckedPhoto], list[ExcludedPhoto]]:
    """Keep the first of equal photos.

    Args:
        photos: Sorted by name.

    Returns:
        The photos that are kept, and the duplicates, with the name of the photo that each one equals.
    """
    kept: list[CheckedPhoto] = []
    left_out: list[ExcludedPhoto] = []
    by_sha: dict[str, CheckedPhoto] = {}
    by_fingerprint: dict[str, CheckedPhoto] = {}
    for photo in photos:
        twin = by_sha.get(photo.sha256)
        if twin is not None:
            left_out.append(ExcludedPhoto(photo.name, f"is the same file as {twin.name}"))
            continue
        by_sha[photo.sha256] = photo
        twin = by_fingerprint.get(photo.fingerprint)
        if twin is not None and _equal_pixels(photo, twin):
            left_out.append(ExcludedPhoto(photo.name, f"has the same pixels as {twin.name}"))
            continue
        by_fingerprint.setdefault(photo.fingerprint, photo)
        kept.append(photo)
    return kept, left_out


def _equal_pixels(first: CheckedPhoto, second: CheckedPhoto) -> bool:
    scale = first.deep_range
    return np.array_equal(read_8bit(first, scale)[0], read_8bit(second, scale)[0])
