"""The first step of the preflight: reads the photos as ingest does, with all their metadata."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.app.preflight.findings import Finding, LeftOutPhoto
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.source import RunSource, is_film
from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.photos.files.names import hint_of_several, list_names, printable
from splatpipe.pipeline.photos.files.photo_list import Photo, photo_root
from splatpipe.pipeline.photos.files.scan import ExcludedPhoto, by_reason, with_reason
from splatpipe.pipeline.photos.intake.bands import ALL
from splatpipe.pipeline.photos.intake.camera_groups import CameraGroup, group_cameras
from splatpipe.pipeline.photos.intake.camera_issues import find_camera_issues
from splatpipe.pipeline.photos.intake.capture_issues import CaptureIssue
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.intake.preparation import (
    MASKS,
    SKIES,
    Preparation,
    Selection,
    find_mask_issues,
    select_photos,
)
from splatpipe.pipeline.photos.intake.too_few import explain_too_few
from splatpipe.pipeline.photos.video.frames import extract_frames
from splatpipe.pipeline.sfm.pairing.layout import make_layout, make_views
from splatpipe.pipeline.sfm.pairing.pairs import Layout
from splatpipe.pipeline.survey.plausibility.position_issues import find_position_issues
from splatpipe.pipeline.survey.positions.photo_positions import PositionList, positions_json, read_positions
from splatpipe.pipeline.survey.positions.position_sources import stated_places
from splatpipe.pipeline.survey.positions.stated_positions import FilePlaces, read_places

if TYPE_CHECKING:
    from splatpipe.stages.options import LineConfig


@dataclass(frozen=True)
class Intake:
    """The photos of a capture and their metadata.

    Attributes:
        photos: The usable photos, sorted by name.
        left_out: The excluded files.
        groups: The camera groups.
        camera_of: The camera of each photo.
        positions: The photos' stated positions.
        layout: The same in metres, as used for pair selection.
    """

    photos: tuple[CheckedPhoto, ...]
    left_out: tuple[LeftOutPhoto, ...]
    groups: tuple[CameraGroup, ...]
    camera_of: Mapping[str, int]
    positions: PositionList
    layout: Layout


def read_capture(
    source: RunSource, config: LineConfig, threads: int, report: Reporter, scratch: Path
) -> tuple[Intake, list[Finding]]:
    """Check every photo completely, including its metadata.

    Args:
        source: The user's folder or film.
        config: Configuration of the run that would follow.
        threads: Number of threads.
        report: Receives the progress.
        scratch: A folder for a film's frames.
    """
    root, filmed = photo_root(source.folder), []
    if is_film(root):
        issues, _ = extract_frames(root, scratch, config.ingest, threads, report)
        root, filmed = scratch, [finding_from_issue(issue) for issue in issues]
    work = Preparation(config.ingest, threads, root, report)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # libraries print their own warnings about unusual metadata tags
        try:
            chosen, findings = select_photos(root, work), []
        except SplatpipeError as error:  # no photo of the band that ingest.bands names
            everything = Preparation(config.ingest.model_copy(update={"bands": ALL}), threads, root, report)
            chosen = select_photos(root, everything)
            findings = [Finding("bands", "error", error.message, error.hint)]
        masked = [find_mask_issues(kind, photo_root(source.folder), chosen, work) for kind in (MASKS, SKIES)]
    photos = chosen.photos
    findings += [
        *filmed,
        *_left_out(chosen, config.ingest.masks),
        *(finding_from_issue(issue) for issues in masked for issue in issues),
    ]
    names = [photo.name for photo in photos]
    few = explain_too_few(source.folder, Path(source.folder.name), names, chosen.pictures_left_out, chosen.scan.others)
    if few is not None:
        findings.append(Finding("too-few", "error", *few))
    groups, camera_of = group_cameras(photos)
    findings += [finding_from_issue(issue) for issue in find_camera_issues(photos, groups, camera_of)]
    places, troubles = _file_places(source, config, photos)
    positions = read_positions(photos, places.by_name)
    issues = find_position_issues(photos, positions, places)
    findings += [*troubles, *(finding_from_issue(issue) for issue in issues)]
    intake = Intake(
        tuple(photos),
        tuple(LeftOutPhoto(entry.name, entry.reason) for entry in chosen.left_out),
        tuple(groups),
        camera_of,
        positions,
        _layout(photos, groups, camera_of, positions),
    )
    return intake, findings


def finding_from_issue(issue: CaptureIssue) -> Finding:
    """Convert an issue to a finding."""
    return Finding(issue.code, issue.severity, issue.message, issue.hint, issue.photos)


def ingest_photos(photos: Sequence[CheckedPhoto], camera_of: Mapping[str, int]) -> list[Photo]:
    """The photos as in ingest's list; none is converted."""
    return [
        Photo(
            photo.name,
            photo.sha256,
            photo.width,
            photo.height,
            camera_of[photo.name],
            photo.exif.time,
            photo.exif.orientation,
        )
        for photo in photos
    ]


def _layout(
    photos: Sequence[CheckedPhoto],
    groups: Sequence[CameraGroup],
    camera_of: Mapping[str, int],
    positions: PositionList,
) -> Layout:
    own = ingest_photos(photos, camera_of)
    entries: Sequence[dict[str, JSON]] = positions_json(positions)["positions"]
    sizes: Float64[np.ndarray, "n 2"] = np.array(
        [np.array([p.width, p.height]) / (2.0 * groups[camera_of[p.name]].focal_px) for p in photos]
    ).reshape(-1, 2)
    layout = make_layout(own, entries)
    views = make_views(own, entries, sizes) if entries else None
    return Layout(layout.names, layout.times, layout.positions_m, layout.sigmas_m, layout.directions, views)


def _file_places(
    source: RunSource, config: LineConfig, photos: Sequence[CheckedPhoto]
) -> tuple[FilePlaces, list[Finding]]:
    """Read the positions file, if any; its errors, which would end a run, become findings."""
    path = source.part_path("source.geo")
    if not path.is_file() or not photos:
        return FilePlaces({}, (), ""), []
    names = [photo.name for photo in photos]
    try:
        places = read_places(path, names, stated_places(photos), approximate=bool(config.georef.approximate_crs))
    except SplatpipeError as error:
        return FilePlaces({}, (), ""), [Finding("positions-file", "error", error.message, error.hint)]
    if not places.unknown:
        return places, []
    text = f"{path.name} names photos that are missing, or names them twice: {list_names(places.unknown)}."
    hint = hint_of_several(places.unknown, names) or "Correct the names, or leave them out."
    return places, [Finding("positions-file", "warning", text, hint)]


def _left_out(chosen: Selection, masks: bool) -> list[Finding]:
    """One finding per reason, for all duplicates one, and one for files that belong to photos."""
    of_kind = {
        kind: [entry for entry in chosen.left_out if entry.kind == kind]
        for kind in ("unusable", "duplicate", "companion", "products")
    }
    findings = [
        Finding("unreadable", "warning", f"{with_reason(names, reason)}.", _hint(reason, names), tuple(sorted(names)))
        for reason, names in sorted(by_reason(of_kind["unusable"]).items())
    ]
    findings += _duplicates(of_kind["duplicate"])
    for reason, names in sorted(by_reason([*of_kind["companion"], *of_kind["products"]]).items()):
        findings.append(Finding("companions", "note", f"{with_reason(names, reason)}.", "A run leaves them out."))
    if chosen.note:
        findings.append(Finding("bands", "note", chosen.note))
    if chosen.masks:
        names = [mask.name for mask in chosen.masks]
        use = "A run applies them." if masks else "A run leaves them unused, by ingest.masks=false."
        findings.append(Finding("companions", "note", f"Masks of photos: {list_names(names)}.", use))
    return findings


def _hint(reason: str, names: Sequence[str]) -> str:
    """What to do about photos that are left out: only what is broken is worth another copy."""
    it, photo = ("it", "the photo") if len(names) == 1 else ("them", "the photos")
    broken = any(word in reason for word in ("damaged", "truncated", "empty", "cannot be read", "no valid pixel"))
    return f"A run leaves {it} out" + (f": copy {it} from the card again, or retake {photo}." if broken else ".")


def _duplicates(entries: Sequence[ExcludedPhoto]) -> list[Finding]:
    if not entries:
        return []
    descriptions = [f"{printable(entry.name)} {entry.reason}" for entry in entries]
    more = f"; and {len(descriptions) - 5} more" if len(descriptions) > 5 else ""
    # The reason ends with the twin's name, so that both can be found.
    twins = {entry.reason.partition(" as ")[2] for entry in entries}
    names = tuple(sorted({entry.name for entry in entries} | twins))
    text = f"Duplicate photos: {'; '.join(descriptions[:5])}{more}."
    return [Finding("duplicate", "warning", text, "The duplicates are left out; was a card copied twice?", names)]
