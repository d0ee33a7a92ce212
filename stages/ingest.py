"""Ingest: the checked photo list, its cameras and positions, and what was left out and why."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter, Summary
from splatpipe.pipeline.photos.camera_groups import (
    CameraGroup,
    cameras_json,
    describe_cameras,
    group_cameras,
    refused_calibrations,
    tell_cameras,
)
from splatpipe.pipeline.photos.check import CheckedPhoto, Limits, check_photo
from splatpipe.pipeline.photos.convert import convert_photo, save_png, scale_of
from splatpipe.pipeline.photos.doubts import FAR_M, median_distance_m
from splatpipe.pipeline.photos.duplicates import split_duplicates
from splatpipe.pipeline.photos.masks import MaskError, MaskFile, find_masks, match_masks, read_mask
from splatpipe.pipeline.photos.names import NAMES_SHOWN, printable, some
from splatpipe.pipeline.photos.options import IngestConfig
from splatpipe.pipeline.photos.photo_list import (
    CONVERTED_DIR,
    MASK_DIR,
    SKY_DIR,
    Photo,
    PhotoList,
    colmap_model,
    photo_root,
    save_photo_list,
)
from splatpipe.pipeline.photos.scan import MASK_FOLDER, SKY_FOLDER, LeftOut, Scan, scan_folder
from splatpipe.pipeline.sfm.known_lenses import lenses_json, state_lenses
from splatpipe.pipeline.sfm.lens_model import StatedLens
from splatpipe.pipeline.survey.photo_positions import (
    DATUM_STEP_M,
    NOWHERE,
    PositionList,
    is_on_earth,
    positions_json,
    read_positions,
)
from splatpipe.pipeline.survey.stated_positions import FilePlace, read_places

MIN_PHOTOS = 2
MOSTLY_IGNORED = 0.99  # of a mask's pixels: hardly meant
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class _Kind:
    """What masks are for: the name of the user's folders, and of the folder in the part."""

    folder: str
    part: str


_MASKS, _SKIES = _Kind(MASK_FOLDER, MASK_DIR), _Kind(SKY_FOLDER, SKY_DIR)


@dataclass(frozen=True)
class _Work:
    """What every step needs."""

    config: IngestConfig
    threads: int
    part: Path
    report: Reporter

    @property
    def max_pixels(self) -> int:
        return int(self.config.max_megapixels * 1e6)


def run(config: IngestConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Check every photo of the user's folder and write the parts photos, cameras, positions and left_out.

    Raises:
        SplatpipeError: if fewer than two photos are left.
    """
    root = photo_root(inputs.photos_dir)
    part = out / "photos"
    part.mkdir(parents=True, exist_ok=True)
    work = _Work(config, inputs.machine.threads, part, report)
    # Libraries warn of odd metadata tags in a text of their own; filters are process wide, so they are set only here.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scan = scan_folder(root)
        checked, broken = _check(scan, work)
        photos, duplicates = split_duplicates(checked)
        left_out = sorted([*scan.left_out, *broken, *duplicates], key=lambda entry: entry.name)
        _require_photos(inputs.photos_dir, scan, photos, left_out)
        _tell_left_out(left_out, report)
        groups, camera_of = group_cameras(photos)
        groups, lenses = _lenses(inputs, groups, camera_of, photos, report)
        opacity = _convert(photos, camera_of, work)
        others = [entry.name for entry in left_out]
        masked = _mask(_MASKS, root, photos, others, opacity, work)
        skies = _mask(_SKIES, root, photos, others, {}, work)
    places = _places(inputs, photos, report)
    positions = read_positions(photos, places)
    _tell_positions(positions, report)
    described = describe_cameras(photos, groups, camera_of)
    tell_cameras(described, report)
    if colmap_model(inputs.photos_dir) is None:  # a given model has its calibration
        _tell_focal(groups, refused_calibrations(photos), report)
    save_photo_list(PhotoList(tuple(_photo(photo, camera_of, masked, skies) for photo in photos)), part)
    _write_json(out / "cameras.json", cameras_json(groups))
    _write_json(out / "lenses.json", lenses_json(lenses))
    _write_json(out / "positions.json", positions_json(positions))
    _write_json(out / "left_out.json", {"left_out": [{"name": e.name, "reason": e.reason} for e in left_out]})
    return {
        "photos": len(photos),
        "left_out": len(left_out),
        "cameras": len(groups),
        "camera_groups": described,
        "focal_sources": sorted({group.focal_source for group in groups}),
        **_accuracy(positions),
        "masks": len(masked),
        "sky_masks": len(skies),
        "megapixels": round(sum(photo.width * photo.height for photo in photos) / 1e6, 3),
    }


def _check(scan: Scan, work: _Work) -> tuple[list[CheckedPhoto], list[LeftOut]]:
    limits = Limits(work.config.min_size, work.max_pixels)
    results = _in_threads(
        lambda candidate: check_photo(candidate, limits), scan.candidates, work, "checking photos", "photos"
    )
    checked = [result for result in results if isinstance(result, CheckedPhoto)]
    return checked, [result for result in results if isinstance(result, LeftOut)]


def _convert(
    photos: Sequence[CheckedPhoto], camera_of: Mapping[str, int], work: _Work
) -> dict[str, UInt8[np.ndarray, "h w"]]:
    """Write the PNGs of photos that are not plain; returns the masks of transparent ones by name."""
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


def _mask(
    kind: _Kind,
    root: Path,
    photos: Sequence[CheckedPhoto],
    left_out: Sequence[str],
    opacity: Mapping[str, UInt8[np.ndarray, "h w"]],
    work: _Work,
) -> set[str]:
    """Write the masks of a kind, from its folder and from transparency; returns the names of masked photos."""
    files = find_masks(root, kind.folder) if work.config.masks else []
    matched, unused = match_masks(files, [*(photo.name for photo in photos), *left_out])
    if unused:
        names = some([mask.label for mask in unused])
        work.report.warning(f"No photo is found for the mask {names}.", "A mask has its photo's name: NAME.png.")
    masked = [photo for photo in photos if photo.name in matched or photo.name in opacity]

    def write(photo: CheckedPhoto) -> str | None:
        problem, values = _read(matched.get(photo.name), photo, work.max_pixels)
        clear = opacity.get(photo.name)
        if clear is not None:
            values = clear if values is None else np.minimum(values, clear)
        if values is None:
            return problem
        save_png(values, work.part / mask_path(photo.name, kind.part))
        if kind is _MASKS and np.mean(values == 0) > MOSTLY_IGNORED:
            return f"The mask of {printable(photo.name)} leaves hardly anything of it: black is what is ignored."
        return problem

    problems = _in_threads(write, masked, work, "preparing masks", "masks")
    for problem in dict.fromkeys(problem for problem in problems if problem is not None):
        work.report.warning(problem)
    return {photo.name for photo in masked if (work.part / mask_path(photo.name, kind.part)).is_file()}


def _read(
    mask: MaskFile | None, photo: CheckedPhoto, max_pixels: int
) -> tuple[str | None, UInt8[np.ndarray, "h w"] | None]:
    if mask is None:
        return None, None
    try:
        return None, read_mask(mask, photo, max_pixels)
    except MaskError as error:
        return f"The mask {printable(mask.label)} {error}; it is not used.", None


def converted_path(name: str) -> str:
    """Where a photo's conversion lies in the part."""
    return f"{CONVERTED_DIR}/{name}.png"


def mask_path(name: str, folder: str) -> str:
    """Where a photo's mask lies in the part: as COLMAP looks for it below a mask folder."""
    return f"{folder}/{name}.png"


def _photo(checked: CheckedPhoto, camera_of: Mapping[str, int], masked: set[str], skies: set[str]) -> Photo:
    return Photo(
        name=checked.name,
        sha256=checked.sha256,
        width=checked.width,
        height=checked.height,
        camera=camera_of[checked.name],
        time=checked.exif.time,
        orientation=checked.exif.orientation,
        converted=None if checked.plain else converted_path(checked.name),
        mask=mask_path(checked.name, MASK_DIR) if checked.name in masked else None,
        sky_mask=mask_path(checked.name, SKY_DIR) if checked.name in skies else None,
    )


def _require_photos(folder: Path, scan: Scan, photos: Sequence[CheckedPhoto], left_out: Sequence[LeftOut]) -> None:
    if len(photos) >= MIN_PHOTOS:
        return
    listing = "".join(f"\n  {printable(entry.name)} {entry.reason}" for entry in left_out[:NAMES_SHOWN])
    more = f"\n  … and {len(left_out) - NAMES_SHOWN} more" if len(left_out) > NAMES_SHOWN else ""
    if photos:
        message = f"There is only one usable photo in {folder}: {printable(photos[0].name)}."
        hint = "A reconstruction needs many overlapping photos of one place, at least two."
    elif left_out:
        message = f"None of the {len(left_out)} pictures in {folder} can be used."
        hint = "Give JPEG, PNG or TIFF photos."
    elif scan.others:
        message = f"There are no photos in {folder}, only {scan.others} other file{'s' if scan.others > 1 else ''}."
        hint = "Name the folder that has the JPEG, PNG or TIFF photos."
    else:
        message = f"The folder {folder} is empty."
        hint = "Name the folder that has the JPEG, PNG or TIFF photos."
    raise SplatpipeError(message + (f" Left out:{listing}{more}" if left_out else ""), hint=hint)


def _tell_left_out(left_out: Sequence[LeftOut], report: Reporter) -> None:
    """One warning a reason, naming the photos."""
    by_reason: dict[str, list[str]] = {}
    for entry in left_out:
        by_reason.setdefault(entry.reason, []).append(entry.name)
    for reason, names in by_reason.items():
        report.warning(f"Left out: {some(names)} {reason}.")


def _lenses(
    inputs: Inputs,
    groups: Sequence[CameraGroup],
    camera_of: Mapping[str, int],
    photos: Sequence[CheckedPhoto],
    report: Reporter,
) -> tuple[list[CameraGroup], list[StatedLens | None]]:
    """The groups with the lenses that are stated; a given model has its own."""
    if colmap_model(inputs.photos_dir) is not None:
        return list(groups), [None] * len(groups)
    members: dict[int, list[CheckedPhoto]] = {}
    for photo in photos:
        members.setdefault(camera_of[photo.name], []).append(photo)
    path = inputs["source.lens"]
    return state_lenses(groups, members, path if path.is_file() else None, report)


def _places(inputs: Inputs, photos: Sequence[CheckedPhoto], report: Reporter) -> Mapping[str, FilePlace]:
    """What the file of positions says, where there is one."""
    path = inputs["source.geo"]
    if not path.is_file():
        return {}
    approximate = bool(inputs.settings.get("georef.approximate_crs", False))
    places = read_places(path, [photo.name for photo in photos], approximate=approximate)
    report.note(f"{path.name}: positions of {len(places.by_name)} of {len(photos)} photos, in {places.note}.")
    if places.unknown:
        report.warning(
            f"{path.name} names photos that are not there, or twice: {some(places.unknown)}.",
            "Names are compared without folders and letter case; correct them, or leave the photos out of the file.",
        )
    others = [photo.name for photo in photos if photo.name not in places.by_name and photo.exif.gps is not None]
    if others:
        report.warning(
            f"{path.name} does not name {some(others)}: their own positions count, as a flight of its own.",
            "Add them to the file if it has better ones.",
        )
    both = [(places.by_name[photo.name], photo.exif.gps) for photo in photos if photo.name in places.by_name]
    known = [(place, gps) for place, gps in both if gps is not None and is_on_earth(gps.latitude, gps.longitude)]
    apart = median_distance_m(
        [(place.latitude, place.longitude) for place, _ in known], [(gps.latitude, gps.longitude) for _, gps in known]
    )
    if apart > FAR_M:
        report.warning(
            f"{path.name} places the photos {apart / 1000.0:,.1f} km from where they say themselves.",
            "Check its CRS (the zone, too), and that east or longitude comes first; or set ingest.positions=none.",
        )
    return places.by_name


def _accuracy(positions: PositionList) -> dict[str, JSON]:
    """How many positions there are, in how many flights, from where, and how accurate they count as."""
    stated = positions.positions
    if not stated:
        return {"positions": 0}
    return {
        "positions": len(stated),
        "position_sources": sorted({each.source for each in stated}),
        "flights": len({each.flight for each in stated}),
        "sigma_horizontal_m": float(np.median([each.sigma_horizontal_m for each in stated])),
        "sigma_vertical_m": float(np.median([each.sigma_vertical_m for each in stated])),
        "sigma_sources": sorted({each.sigma_source for each in stated}),
    }


def _tell_positions(positions: PositionList, report: Reporter) -> None:
    if positions.impossible:
        report.warning(
            f"The position is none that can be on Earth: {some(positions.impossible)}.",
            "These photos take part without their position.",
        )
    elsewhere = [f"{printable(name)} {why}" for name, why in positions.wrong.items() if why != NOWHERE]
    if elsewhere:
        more = f"; and {len(elsewhere) - NAMES_SHOWN} more" if len(elsewhere) > NAMES_SHOWN else ""
        report.warning(
            f"Positions that cannot be right: {'; '.join(elsewhere[:NAMES_SHOWN])}{more}.",
            "These photos take part without their position.",
        )
    step = positions.altitude_step_m
    if step is not None and abs(step) > DATUM_STEP_M:
        report.warning(
            f"The altitudes in EXIF and in the drone's XMP differ by {step:.1f} m: they have different datums.",
            "EXIF's are used.",
        )


def _tell_focal(groups: Sequence[CameraGroup], refused: Sequence[str], report: Reporter) -> None:
    if refused:
        report.warning(
            f"The calibrated focal length in {some(refused)} is far from what lens and sensor give; it is not used.",
            "Was the picture cropped or resized, or its metadata copied?",
        )
    unknown = sum(group.photos for group in groups if not group.has_prior)
    if unknown:
        report.warning(
            f"Nothing is known of the focal length of {unknown} photos; calibration has to find it.",
            "Photos as the camera wrote them, with their EXIF, give a better result.",
        )


def _in_threads(function: Callable[[T], R], items: Sequence[T], work: _Work, what: str, unit: str) -> list[R]:
    """``function`` of each item, in their order; Pillow and hashlib work outside Python's lock."""
    results: list[R] = []
    pool = ThreadPoolExecutor(max_workers=max(1, work.threads))
    try:
        for result in pool.map(function, items):
            results.append(result)
            work.report.progress(len(results), len(items), what, unit)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return results


def _write_json(path: Path, value: JSON) -> None:
    path.write_text(json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
