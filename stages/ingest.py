"""ingest: the checked photo list, its cameras and positions, and which photos were left out and why."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import write_json
from splatpipe.pipeline.engine.runs.colmap_folder import has_model
from splatpipe.pipeline.engine.runs.source import is_film
from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter, Summary
from splatpipe.pipeline.photos.files.names import NAMES_SHOWN, hint_of_several, list_names, printable
from splatpipe.pipeline.photos.files.photo_list import (
    MASK_DIR,
    SKY_DIR,
    Photo,
    PhotoList,
    photo_root,
    save_photo_list,
)
from splatpipe.pipeline.photos.files.scan import by_reason, with_reason
from splatpipe.pipeline.photos.intake.bands import ALL, AUTO
from splatpipe.pipeline.photos.intake.camera_groups import (
    CameraGroup,
    cameras_json,
    describe_cameras,
    group_cameras,
    refused_calibrations,
    report_cameras,
)
from splatpipe.pipeline.photos.intake.capture_issues import CaptureIssue
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.intake.preparation import (
    MASKS,
    SKIES,
    Preparation,
    Selection,
    convert_unusual,
    converted_path,
    mask_path,
    prepare_masks,
    select_photos,
)
from splatpipe.pipeline.photos.intake.too_few import explain_too_few
from splatpipe.pipeline.photos.options import IngestConfig
from splatpipe.pipeline.photos.video.film_times import save_film_times
from splatpipe.pipeline.photos.video.frames import FRAMES_DIR, extract_frames
from splatpipe.pipeline.sfm.lenses.known_lenses import lenses_json, state_lenses
from splatpipe.pipeline.sfm.lenses.lens_model import StatedLens
from splatpipe.pipeline.survey.plausibility.position_issues import find_position_issues
from splatpipe.pipeline.survey.positions.photo_positions import PositionList, positions_json, read_positions
from splatpipe.pipeline.survey.positions.position_sources import stated_places
from splatpipe.pipeline.survey.positions.stated_positions import FilePlaces, read_places

MEASURES = "film.measures"  # of a film, from which a killed run goes on; no part, so that it does not outlast the stage


def run(config: IngestConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Check every photo of the user's folder, or of the frames of the film that was given instead.

    Writes the parts photos, cameras, lenses, positions and left_out.

    Raises:
        SplatpipeError: if fewer than two photos are left.
    """
    given = photo_root(inputs.photos_dir)
    part = out / "photos"
    part.mkdir(parents=True, exist_ok=True)
    filmed = is_film(given)
    root = part / FRAMES_DIR if filmed else given
    _remove_leftovers(out, part, {root, out / MEASURES} if filmed else set())
    if filmed:
        issues, times = extract_frames(given, root, config, inputs.machine.threads, report, out / MEASURES)
        save_film_times(times, part)
        _report_film(issues, report)
    if config.bands == AUTO and has_model(inputs.photos_dir):
        config = config.model_copy(update={"bands": ALL})  # a given model says which photos it is of
    work = Preparation(config, inputs.machine.threads, part, report)
    # Libraries print their own warnings about odd metadata tags. Filters are process-wide, so they are set only here.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        chosen = select_photos(root, work)
        photos, left_out = chosen.photos, chosen.left_out
        _require_photos(inputs.photos_dir, chosen)
        _report_excluded(chosen, config, report)
        groups, camera_of = group_cameras(photos)
        groups, lenses = _lenses(inputs, groups, camera_of, photos, report)
        opacity = convert_unusual(photos, camera_of, work)
        masked = prepare_masks(MASKS, given, chosen, opacity, work)
        skies = prepare_masks(SKIES, given, chosen, {}, work)
    places = _places(inputs, photos, report)
    positions = read_positions(photos, places.by_name)
    for issue in find_position_issues(photos, positions, places):
        if issue.severity == "warning":
            report.warning(issue.message, issue.hint)
    described = describe_cameras(photos, groups, camera_of)
    report_cameras(described, report)
    if not has_model(inputs.photos_dir):  # a given model comes with its calibration
        _warn_of_focal(groups, refused_calibrations(photos), report)
    listed = [_photo(photo, camera_of, masked, skies) for photo in photos]
    if filmed:
        listed = [replace(photo, converted=f"{FRAMES_DIR}/{photo.name}") for photo in listed]
    save_photo_list(PhotoList(tuple(listed)), part)
    write_json(out / "cameras.json", cameras_json(groups))
    write_json(out / "lenses.json", lenses_json(lenses))
    write_json(out / "positions.json", positions_json(positions))
    write_json(out / "left_out.json", {"left_out": [{"name": e.name, "reason": e.reason} for e in left_out]})
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


def _remove_leftovers(out: Path, part: Path, kept: AbstractSet[Path]) -> None:
    """Remove what a killed run left, except for what is whole."""
    for path in [*out.iterdir(), *part.iterdir()]:
        if path in kept or path == part:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _report_film(issues: Sequence[CaptureIssue], report: Reporter) -> None:
    for issue in issues:
        if issue.severity == "warning":
            report.warning(issue.message, issue.hint)
        else:
            report.note(f"{issue.message} {issue.hint}".rstrip())


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


def _require_photos(folder: Path, chosen: Selection) -> None:
    left_out = chosen.left_out
    names = [photo.name for photo in chosen.photos]
    few = explain_too_few(folder, folder, names, chosen.pictures_left_out, chosen.scan.others)
    if few is None:
        return
    message, hint = few
    listing = "".join(f"\n  {printable(entry.name)} {entry.reason}" for entry in left_out[:NAMES_SHOWN])
    more = f"\n  … and {len(left_out) - NAMES_SHOWN} more" if len(left_out) > NAMES_SHOWN else ""
    raise SplatpipeError(message + (f" Left out:{listing}{more}" if left_out else ""), hint=hint)


def _report_excluded(chosen: Selection, config: IngestConfig, report: Reporter) -> None:
    """Issue one warning, or for files that belong to photos one note, per reason, naming the files."""
    reports = {"unusable": report.warning, "duplicate": report.warning, "companion": report.note}
    for kind, say in (reports | {"products": report.note}).items():
        for reason, names in by_reason(entry for entry in chosen.left_out if entry.kind == kind).items():
            say(f"Left out: {with_reason(names, reason)}.")
    if chosen.note:
        report.note(chosen.note)
    if chosen.masks:
        listed = list_names(mask.name for mask in chosen.masks)
        use = "used as masks" if config.masks else "not used, by ingest.masks=false"
        report.note(f"Masks beside their photos, {use}: {listed}.")


def _lenses(
    inputs: Inputs,
    groups: Sequence[CameraGroup],
    camera_of: Mapping[str, int],
    photos: Sequence[CheckedPhoto],
    report: Reporter,
) -> tuple[list[CameraGroup], list[StatedLens | None]]:
    """Return the groups with the given lens calibrations, if any; a given model has its own."""
    if has_model(inputs.photos_dir):
        return list(groups), [None] * len(groups)
    members: dict[int, list[CheckedPhoto]] = {}
    for photo in photos:
        members.setdefault(camera_of[photo.name], []).append(photo)
    path = inputs["source.lens"]
    return state_lenses(groups, members, path if path.is_file() else None, report)


def _places(inputs: Inputs, photos: Sequence[CheckedPhoto], report: Reporter) -> FilePlaces:
    """Return the positions from the position file; empty without a file."""
    path = inputs["source.geo"]
    if not path.is_file():
        return FilePlaces({}, (), "")
    approximate = bool(inputs.settings.get("georef.approximate_crs", False))
    places = read_places(path, [photo.name for photo in photos], stated_places(photos), approximate=approximate)
    report.note(f"{path.name}: positions of {len(places.by_name)} of {len(photos)} photos, in {places.note}.")
    if places.unknown:
        report.warning(
            f"{path.name} names photos that are missing, or names them twice: {list_names(places.unknown)}.",
            hint_of_several(places.unknown, [photo.name for photo in photos])
            or "Names are compared without folders and letter case; correct them, or leave the photos out of the file.",
        )
    others = [photo.name for photo in photos if photo.name not in places.by_name and photo.exif.gps is not None]
    if others:
        report.warning(
            f"{path.name} does not name {list_names(others)}: their own positions are used, as a separate flight.",
            "Add better positions for them to the file, if you have any.",
        )
    return places


def _accuracy(positions: PositionList) -> dict[str, JSON]:
    """Summarise the positions: their number, sources, flights, and assumed accuracy."""
    stated = positions.positions
    if not stated:
        return {"positions": 0}
    vertical = [each.sigma_vertical_m for each in stated if each.altitude_m is not None]
    return {
        "positions": len(stated),
        "position_sources": sorted({each.source for each in stated}),
        "flights": len({each.flight for each in stated}),
        "sigma_horizontal_m": float(np.median([each.sigma_horizontal_m for each in stated])),
        "sigma_vertical_m": float(np.median(vertical)) if vertical else None,
        "sigma_sources": sorted({each.sigma_source for each in stated}),
    }


def _warn_of_focal(groups: Sequence[CameraGroup], refused: Sequence[str], report: Reporter) -> None:
    if refused:
        report.warning(
            f"The calibrated focal length in {list_names(refused)} is far from the value of lens and sensor; "
            "it is not used.",
            "Was the photo cropped or resized, or its metadata copied?",
        )
    unknown = sum(group.photos for group in groups if not group.has_prior)
    if unknown:
        report.warning(
            f"The focal length of {unknown} photos is unknown; it must be calibrated from scratch.",
            "Original photos, with their EXIF, give a better result.",
        )
