"""Prepare photos for every reader: check them, convert unusual ones, and bring masks into the stored grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.files.names import list_names
from splatpipe.pipeline.photos.files.photo_list import (
    CONVERTED_DIR,
    MASK_DIR,
    SKY_DIR,
)
from splatpipe.pipeline.photos.files.scan import (
    MASK_FOLDER,
    SKY_FOLDER,
    ExcludedPhoto,
    PhotoMask,
    Scan,
    scan_folder,
    with_reason,
)
from splatpipe.pipeline.photos.intake.bands import choose_band
from splatpipe.pipeline.photos.intake.capture_issues import CaptureIssue
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, PictureLimits, check_photo
from splatpipe.pipeline.photos.intake.convert import convert_photo, save_png, scale_of
from splatpipe.pipeline.photos.intake.duplicates import split_duplicates, split_maps
from splatpipe.pipeline.photos.intake.masks import (
    MaskError,
    MaskFile,
    find_masks,
    match_masks,
    read_mask,
    with_masks_beside,
)
from splatpipe.pipeline.photos.options import IngestConfig

MAX_MASKED_SHARE = 0.99  # share of masked pixels in a photo above which its mask is hardly intended
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class MaskKind:
    """A kind of mask: the name of the user's folders, and of the folder in the part."""

    folder: str
    part: str


MASKS = MaskKind(MASK_FOLDER, MASK_DIR)
SKIES = MaskKind(SKY_FOLDER, SKY_DIR)


@dataclass(frozen=True)
class Preparation:
    """What every preparation step needs.

    Attributes:
        config: Ingest's options.
        threads: Number of threads.
        part: The folder of the part `photos`.
        report: Receives progress and warnings.
    """

    config: IngestConfig
    threads: int
    part: Path
    report: Reporter

    @property
    def max_pixels(self) -> int:
        return int(self.config.max_megapixels * 1e6)


@dataclass(frozen=True)
class Selection:
    """The photos of a folder.

    Attributes:
        scan: What lies in the folder.
        photos: The photos in use, sorted by name.
        left_out: All other pictures, sorted by name, each with the reason.
        masks: Masks that lie beside their photos, sorted by name.
        note: Which band was chosen; empty where the photos are of one.
    """

    scan: Scan
    photos: list[CheckedPhoto]
    left_out: list[ExcludedPhoto]
    masks: list[PhotoMask]
    note: str

    @property
    def pictures_left_out(self) -> int:
        """The number of pictures among what is left out, without whole folders."""
        return sum(entry.kind != "products" for entry in self.left_out)


def select_photos(root: Path, work: Preparation) -> Selection:
    """Check the pictures of a folder, and choose those that are used.

    Raises:
        SplatpipeError: if there are no photos of the band that `ingest.bands` names.
    """
    scan = scan_folder(root)
    limits = PictureLimits(work.config.min_size, work.max_pixels)
    results = _in_threads(
        lambda candidate: check_photo(candidate, limits), scan.candidates, work, "checking photos", "photos"
    )
    broken = [result for result in results if isinstance(result, ExcludedPhoto)]
    photos, duplicates = split_duplicates([result for result in results if isinstance(result, CheckedPhoto)])
    chosen = choose_band(photos, work.config.bands)
    photos, maps, masks = split_maps(chosen.photos)
    left_out = sorted([*scan.left_out, *broken, *duplicates, *chosen.left_out, *maps], key=lambda entry: entry.name)
    return Selection(scan, photos, left_out, sorted([*scan.masks, *masks], key=lambda mask: mask.name), chosen.note)


def convert_unusual(
    photos: Sequence[CheckedPhoto], camera_of: Mapping[str, int], work: Preparation
) -> dict[str, UInt8[np.ndarray, "h w"]]:
    """Write the PNGs of photos that are not plain; return the masks of transparent ones by name."""
    odd = [photo for photo in photos if not photo.plain]
    if not odd:
        return {}
    ranges: dict[int, list[tuple[float, float]]] = {}
    for photo in odd:
        if photo.deep_range is not None:
            ranges.setdefault(camera_of[photo.name], []).append(photo.deep_range)
    scales = {camera: scale_of(values) for camera, values in ranges.items()}

    def convert(photo: CheckedPhoto) -> UInt8[np.ndarray, "h w"] | None:
        scale = scales[camera_of[photo.name]] if photo.deep_range is not None else None
        return convert_photo(photo, scale, work.part / converted_path(photo.name))

    masks = _in_threads(convert, odd, work, "converting to 8-bit RGB", "photos")
    return {photo.name: mask for photo, mask in zip(odd, masks, strict=True) if mask is not None}


def prepare_masks(
    kind: MaskKind, root: Path, chosen: Selection, opacity: Mapping[str, UInt8[np.ndarray, "h w"]], work: Preparation
) -> set[str]:
    """Write the masks of a kind: from its folder, beside the photos, from transparency; return the masked photos."""
    matched, unmatched = _match(kind, root, chosen, work)
    masked = [photo for photo in chosen.photos if photo.name in matched or photo.name in opacity]

    def write(photo: CheckedPhoto) -> _MaskFault | None:
        fault, values = _read(matched.get(photo.name), photo, work.max_pixels)
        clear = opacity.get(photo.name)
        if clear is not None:
            values = clear if values is None else np.minimum(values, clear)
        if values is None:
            return fault
        save_png(values, work.part / mask_path(photo.name, kind.part))
        return fault or _too_much(kind, photo, values)

    faults = _in_threads(write, masked, work, "preparing masks", "masks")
    for issue in [*unmatched, *_mask_issues(faults)]:
        work.report.warning(issue.message, issue.hint)
    return {photo.name for photo in masked if (work.part / mask_path(photo.name, kind.part)).is_file()}


def find_mask_issues(kind: MaskKind, root: Path, chosen: Selection, work: Preparation) -> list[CaptureIssue]:
    """Read the masks of a kind as ``prepare_masks`` does, and write none; return what it would warn of."""
    matched, unmatched = _match(kind, root, chosen, work)
    masked = [photo for photo in chosen.photos if photo.name in matched]

    def read(photo: CheckedPhoto) -> _MaskFault | None:
        fault, values = _read(matched[photo.name], photo, work.max_pixels)
        return fault if values is None else _too_much(kind, photo, values)

    return [*unmatched, *_mask_issues(_in_threads(read, masked, work, "checking masks", "masks"))]


@dataclass(frozen=True)
class _MaskFault:
    """A mask that cannot be used, and why; without a reason, one that hides almost the whole photo."""

    photo: str
    label: str = ""
    reason: str = ""


def _match(
    kind: MaskKind, root: Path, chosen: Selection, work: Preparation
) -> tuple[Mapping[str, MaskFile], list[CaptureIssue]]:
    """The masks by photo name, and a warning of those without a photo."""
    files = find_masks(root, kind.folder) if work.config.masks else []
    names = [photo.name for photo in chosen.photos] + [entry.name for entry in chosen.left_out]
    matched, unused = match_masks(files, names)
    if kind is MASKS and work.config.masks:
        matched = with_masks_beside(matched, chosen.masks)
    if not unused:
        return matched, []
    text = f"There is no photo for the mask {list_names([mask.label for mask in unused])}."
    return matched, [CaptureIssue("masks", text, "A mask must have its photo's name: NAME.png.")]


def _read(
    mask: MaskFile | None, photo: CheckedPhoto, max_pixels: int
) -> tuple[_MaskFault | None, UInt8[np.ndarray, "h w"] | None]:
    if mask is None:
        return None, None
    try:
        return None, read_mask(mask, photo, max_pixels)
    except MaskError as error:
        return _MaskFault(photo.name, mask.label, str(error)), None


def _too_much(kind: MaskKind, photo: CheckedPhoto, values: UInt8[np.ndarray, "h w"]) -> _MaskFault | None:
    return _MaskFault(photo.name) if kind is MASKS and np.mean(values == 0) > MAX_MASKED_SHARE else None


def _mask_issues(faults: Sequence[_MaskFault | None]) -> list[CaptureIssue]:
    """One warning for each reason."""
    of_reason: dict[str, list[_MaskFault]] = {}
    for fault in faults:
        if fault is not None:
            of_reason.setdefault(fault.reason, []).append(fault)
    issues = []
    for reason, of_one in of_reason.items():
        photos = tuple(fault.photo for fault in of_one)
        if reason:
            text = f"Masks not used: {with_reason([fault.label for fault in of_one], reason)}."
        else:
            hide = "mask of {} hides" if len(photos) == 1 else "masks of {} hide"
            text = f"The {hide.format(list_names(photos))} almost the whole photo: black areas are ignored."
        issues.append(CaptureIssue("masks", text, photos=photos))
    return issues


def converted_path(name: str) -> str:
    """Path of a photo's converted PNG, relative to the part."""
    return f"{CONVERTED_DIR}/{name}.png"


def mask_path(name: str, folder: str) -> str:
    """Path of a photo's mask, relative to the part, by COLMAP's convention."""
    return f"{folder}/{name}.png"


def _in_threads(function: Callable[[T], R], items: Sequence[T], work: Preparation, what: str, unit: str) -> list[R]:
    """Apply ``function`` to each item, in order; Pillow and hashlib release Python's global lock."""
    results: list[R] = []
    pool = ThreadPoolExecutor(max_workers=max(1, work.threads))
    try:
        for result in pool.map(function, items):
            results.append(result)
            work.report.progress(len(results), len(items), what, unit)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return results
