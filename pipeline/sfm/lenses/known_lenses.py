"""Lenses stated by a file or the photos' metadata, converted to the pixels of the camera groups."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.photos.files.names import NameFinder
from splatpipe.pipeline.photos.intake.camera_groups import CALIBRATION_TOLERANCE, CameraGroup, picture_scale
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.sfm.lenses.lens_file import FileLens, checked_lens, fitted, read_lens_file
from splatpipe.pipeline.sfm.lenses.lens_model import StatedLens, named_params, simplest

FILE, DEWARP = "lens-file", "xmp-dewarp"
SHAPE_TOLERANCE = 0.005  # difference of the aspect ratios of the lens's images and the photos: a pixel lost in resizing
MAX_DEWARP_CHARS = 600
MAX_FOCAL_DEVIATION = 0.35  # relative deviation from the metadata's focal length: a rough 35 mm equivalent was 26 % off
SIZES_SHOWN = 4


def state_lenses(
    groups: Sequence[CameraGroup],
    members: Mapping[int, Sequence[CheckedPhoto]],
    path: Path | None,
    report: Reporter,
) -> tuple[list[CameraGroup], list[StatedLens | None]]:
    """Find each group's stated lens, and start the group's camera from it.

    Args:
        groups: The photos' camera groups.
        members: The photos of each group.
        path: The lens file; None if there is none.
        report: Receives notes.

    Returns:
        The groups, with the simple lens that is nearest to the stated one, and the stated lenses, in each group's
        pixels; None for a group without one.

    Raises:
        SplatpipeError: If the file cannot be read, fits no group, or is ambiguous for one.
    """
    lenses: list[StatedLens | None] = [None] * len(groups)
    if path is not None:
        lenses = _of_file(read_lens_file(path), groups, members, path.name)
        with_it = sum(group.photos for group, lens in zip(groups, lenses, strict=True) if lens is not None)
        total = sum(group.photos for group in groups)
        report.note(f"{path.name}: the lens of {with_it} of {total} photos.")
    for number, group in enumerate(groups):
        if lenses[number] is None:
            lenses[number] = _of_metadata(group, members[number])
    return [_starting(group, lens) for group, lens in zip(groups, lenses, strict=True)], lenses


def lenses_json(lenses: Sequence[StatedLens | None]) -> JSON:
    """Return the content of ``lenses.json``."""
    return {"lenses": [None if lens is None else asdict(lens) for lens in lenses]}


def _starting(group: CameraGroup, lens: StatedLens | None) -> CameraGroup:
    if lens is None:
        return group
    camera = lens.colmap()
    model, params = simplest(camera)
    named = named_params(camera)
    focal = 0.5 * (named["fx"] + named["fy"])
    return replace(group, model=model, params=params, focal_px=focal, focal_source=lens.source, has_prior=True)


def _of_file(
    found: Sequence[FileLens], groups: Sequence[CameraGroup], members: Mapping[int, Sequence[CheckedPhoto]], name: str
) -> list[StatedLens | None]:
    result: list[StatedLens | None] = []
    finders = [NameFinder([photo.name for photo in members[number]]) for number in range(len(groups))]
    named = [[sum(find(photo) is not None for photo in each.photos) for find in finders] for each in found]
    for number, group in enumerate(groups):
        near = [
            (each, lens, counts[number])
            for each, counts in zip(found, named, strict=True)
            if (lens := fitted(each.lens, group.width, group.height, SHAPE_TOLERANCE)) is not None
            and (counts[number] or (not any(counts) and _is_likely(lens, group)))
        ]
        result.append(_chosen(near, group, name))
    if not any(result):
        ours = sorted({f"{group.width} × {group.height}" for group in groups})[:SIZES_SHOWN]
        theirs = sorted({f"{each.lens.width:g} × {each.lens.height:g}" for each in found})[:SIZES_SHOWN]
        raise SplatpipeError(
            f"The lens in {name} does not belong to these photos: it is for pictures of {', '.join(theirs)}, they have"
            f" {', '.join(ours)} pixels.",
            hint="Its aspect ratio and focal length must match the photos. Give another with"
            " --set ingest.lens=PATH, or =none.",
        )
    return [None if lens is None else replace(lens, source=FILE) for lens in result]


def _is_likely(lens: StatedLens, group: CameraGroup) -> bool:
    """Whether a lens agrees with a group's prior focal length; rules out other cameras of the same aspect ratio."""
    named = named_params(lens.colmap())
    return not group.has_prior or abs(0.5 * (named["fx"] + named["fy"]) / group.focal_px - 1.0) <= MAX_FOCAL_DEVIATION


def _chosen(near: Sequence[tuple[FileLens, StatedLens, int]], group: CameraGroup, name: str) -> StatedLens | None:
    """Choose the lens of a group: by the photos it names, by the camera's name, or because it is the only candidate."""
    if not near:
        return None
    most = max(near, key=lambda entry: entry[2])
    if most[2]:
        return most[1]
    of_camera = [lens for _, lens, _ in near if group.model_name and group.model_name.lower() in lens.camera.lower()]
    same_size = [lens for each, lens, _ in near if (each.lens.width, each.lens.height) == (group.width, group.height)]
    for some in (of_camera, same_size, [lens for _, lens, _ in near]):
        if len({(lens.model, lens.params) for lens in some}) == 1:
            return some[0]
    raise SplatpipeError(
        f"{name} has {len(near)} lenses that fit photos of {group.width} × {group.height} pixels.",
        hint="Keep only the one these photos were taken with, and give the file with --set ingest.lens=PATH.",
    )


def _of_metadata(group: CameraGroup, photos: Sequence[CheckedPhoto]) -> StatedLens | None:
    """Return DJI's ``DewarpData`` if most photos of a group have the same and the drone has not applied it."""
    counts = Counter(lens for photo in photos if (lens := dewarp_lens(photo)) is not None)
    if not counts:
        return None
    lens, count = counts.most_common(1)[0]
    stray = abs(0.5 * (lens.params[0] + lens.params[1]) / group.focal_px - 1.0)
    if 2 * count <= len(photos) or (group.has_prior and stray > CALIBRATION_TOLERANCE):
        return None
    return lens


def dewarp_lens(photo: CheckedPhoto) -> StatedLens | None:
    """Parse the lens in a photo's ``drone-dji:DewarpData``: ``date;fx,fy,cx,cy,k1,k2,p1,p2,k3``.

    Values are in pixels of the original image, the principal point relative to its centre, the rest as in OpenCV
    (DJI's manuals).

    Returns:
        The lens in the photo's pixels; None if there is none, it is implausible, or it was already applied
        (``DewarpFlag``).
    """
    text = photo.xmp.get("drone-dji:DewarpData", "")
    scale = picture_scale(photo.exif, photo.width, photo.height)
    if not text or len(text) > MAX_DEWARP_CHARS or scale is None or photo.xmp.get("drone-dji:DewarpFlag") == "1":
        return None
    try:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(value) for value in text.rpartition(";")[2].split(","))
        inner = (scale * fx, scale * fy, photo.width / 2 + scale * cx, photo.height / 2 + scale * cy)
        params = (*inner, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
        return checked_lens(StatedLens("FULL_OPENCV", photo.width, photo.height, params, DEWARP, photo.exif.model))
    except ValueError:
        return None
