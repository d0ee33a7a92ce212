"""Photos that do not match the others: another camera, another zoom, another size."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from splatpipe.pipeline.photos.files.names import list_names
from splatpipe.pipeline.photos.intake.camera_groups import CameraGroup, camera_name, picture_scale
from splatpipe.pipeline.photos.intake.capture_issues import CaptureIssue
from splatpipe.pipeline.photos.intake.check import CheckedPhoto

MAX_MINORITY_SHARE = 0.25  # share of the photos above which a camera was used on purpose
VOWELS = frozenset("aeioAEIO")  # letters before which "an" is said
NO_CAMERA = camera_name("", "")


def find_camera_issues(
    photos: Sequence[CheckedPhoto], groups: Sequence[CameraGroup], camera_of: Mapping[str, int]
) -> list[CaptureIssue]:
    """Report mixed cameras, mixed zoom settings, and photos that were resized or cropped.

    Args:
        photos: The photos in use.
        groups: Their cameras.
        camera_of: Index of each photo's camera in ``groups``, by name.
    """
    resized = {photo.name: _resizing(photo) for photo in photos}
    sizes = Counter(resized.values())
    common = sizes.most_common(1)[0][0] if sizes else ""
    odd = [name for name, what in resized.items() if what and what != common]
    issues = _mixed_cameras(photos, groups, camera_of, set(odd))
    if common:
        which = "All photos" if sizes[common] == len(photos) else f"{sizes[common]} of {len(photos)} photos"
        issues.append(
            CaptureIssue(
                "resized",
                f"{which} are {common}.",
                "These are treated as reduced. Original photos have more detail, and metadata that match.",
                severity="note",
            )
        )
    for what in sorted({resized[name] for name in odd}):
        names = sorted(name for name in odd if resized[name] == what)
        issues.append(
            CaptureIssue(
                "resized", f"{list_names(names)}: {what}, unlike the others.", "Take the original files.", tuple(names)
            )
        )
    return issues


def _resizing(photo: CheckedPhoto) -> str:
    """Describe how a photo's size was changed, judged by its EXIF; empty if it was not."""
    taken = photo.exif.width, photo.exif.height
    if taken[0] is None or taken[1] is None:
        return ""
    scale = picture_scale(photo.exif, photo.width, photo.height)
    if scale == 1.0:
        return ""
    done = "cropped" if scale is None else "resized"
    return f"{done} to {photo.width} × {photo.height} px from {taken[0]} × {taken[1]}"


def _mixed_cameras(
    photos: Sequence[CheckedPhoto], groups: Sequence[CameraGroup], camera_of: Mapping[str, int], resized: set[str]
) -> list[CaptureIssue]:
    """Report cameras with few photos one by one, and those with many photos together."""
    if len(groups) < 2:
        return []
    members: dict[int, list[CheckedPhoto]] = {}
    for photo in photos:
        members.setdefault(camera_of[photo.name], []).append(photo)
    main = max(members, key=lambda number: len(members[number]))
    issues = []
    many = [number for number, own in members.items() if len(own) > MAX_MINORITY_SHARE * len(photos)]
    if len(many) > 1:
        listed = "; ".join(f"{len(members[number])} photos of {_describe(members[number][0])}" for number in many)
        issues.append(
            CaptureIssue(
                "cameras", f"The capture mixes cameras: {listed}.", "Each is calibrated separately.", severity="note"
            )
        )
    for number, own in sorted(members.items()):
        names = tuple(photo.name for photo in own if photo.name not in resized)
        if number in many or number == main or not names:
            continue
        code, what = _difference(own[0], members[main][0])
        issues.append(
            CaptureIssue(
                code,
                f"{list_names(names)}: {what}.",
                "A camera with few photos cannot be calibrated well: leave them out, or fly again with one camera.",
                names,
            )
        )
    return issues


def _difference(photo: CheckedPhoto, other: CheckedPhoto) -> tuple[str, str]:
    """How a photo of a small group differs from one of the largest."""
    mine, theirs = _body(photo), _body(other)
    other_size = sorted((photo.width, photo.height)) != sorted((other.width, other.height))
    if mine != theirs and not (other_size and not any(mine)):
        if mine[:2] == theirs[:2]:
            return "cameras", f"another {camera_name(*mine[:2])} than the others, by its serial number"
        if not any(mine):
            return "cameras", f"no camera is named in EXIF, the others were taken with {_describe(other)}"
        return "cameras", f"taken with {_describe(photo)}, the others with {_describe(other)}"
    if other_size:
        return "resized", f"{photo.width} × {photo.height} px, the others {other.width} × {other.height}"
    if (photo.exif.focal_mm, photo.exif.focal_35mm) != (other.exif.focal_mm, other.exif.focal_35mm):
        return "focal-length", f"a focal length of {_focal(photo)}, the others {_focal(other)}"
    return "cameras", "not like the others (rotated, or with lens distortion already removed)"


def _body(photo: CheckedPhoto) -> tuple[str, str, str]:
    return photo.exif.make, photo.exif.model, photo.exif.serial


def _describe(photo: CheckedPhoto) -> str:
    name = camera_name(photo.exif.make, photo.exif.model)
    focal = _focal(photo)
    article = "an" if name[0] in VOWELS or name == NO_CAMERA else "a"
    return f"{article} {name}" + (f" ({focal})" if focal != "unknown" else "")


def _focal(photo: CheckedPhoto) -> str:
    if photo.exif.focal_mm is not None:
        return f"{photo.exif.focal_mm:g} mm"
    return "unknown" if photo.exif.focal_35mm is None else f"{photo.exif.focal_35mm:g} mm (35 mm equivalent)"
