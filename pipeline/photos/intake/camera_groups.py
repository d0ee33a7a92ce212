"""Group photos by camera, and derive each camera's prior focal length from metadata."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.exif import Exif
from splatpipe.pipeline.photos.metadata.sensors import sensor_size_mm
from splatpipe.pipeline.photos.metadata.xmp import xmp_number

MODEL = "SIMPLE_RADIAL"
DEFAULT_FOCAL = 1.2  # focal length over the image's longer side without metadata: COLMAP's default, 43 mm on 35 mm film
FOCAL_BOUNDS = (0.2, 30.0)  # focal length over the image's longer side; values outside are errors
ASPECT_TOLERANCE = 0.01
SHAPE_TOLERANCE = 0.03  # between a sensor's specified aspect ratio and that of the images that use all of it
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
WIDEST_SENSOR = 1.51  # width over height; wider images are cropped from a 4:3 sensor
PANORAMA = 2.5  # no sensor has this aspect ratio or a larger one
CAMERAS_SHOWN = 10  # cameras listed on the console; the report lists them all
EQUIVALENT_TOLERANCE = 0.05  # relative difference of rounded 35 mm equivalents; a larger one is digital zoom
ZOOM_TOLERANCE = 0.01  # relative difference of focal lengths that focus and heat explain
CALIBRATION_TOLERANCE = 0.15  # relative, calibrated to nominal focal length: more is another unit or camera mode


@dataclass(frozen=True)
class Focal:
    """A focal length in pixels of the stored grid.

    Attributes:
        px: Its value.
        source: Its source, one of FOCAL_SOURCES.
        has_prior: Whether it is more than a guess.
    """

    px: float
    source: str
    has_prior: bool


# In order of trust. A maker's calibration comes first. Rounded 35 mm equivalents err by up to 5 %.
# FocalPlaneXResolution of a photo that was resized afterwards may not have been updated, so comes last.
FOCAL_SOURCES = (
    "xmp-calibrated",
    "sensor-table",
    "focal-plane-resolution",
    "35mm-equivalent",
    "focal-plane-resolution-resized",
    "guess",
)


@dataclass(frozen=True)
class CameraGroup:
    """Photos taken by one camera with one lens setting.

    Attributes:
        model: COLMAP's camera model, the initial one.
        width: Of the stored grid, pixels.
        height: Likewise.
        params: The model's initial parameters: focal length, principal point, distortion.
        focal_px: The initial focal length, pixels.
        focal_source: Its source, one of FOCAL_SOURCES.
        has_prior: Whether it is more than a guess.
        make: From EXIF; empty when unknown.
        model_name: Likewise.
        photos: Number of photos.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    focal_px: float
    focal_source: str
    has_prior: bool
    make: str
    model_name: str
    photos: int


def focal_prior(exif: Exif, xmp: Mapping[str, str], width: int, height: int) -> Focal:
    """Return the most trustworthy focal length that a photo's metadata give.

    Args:
        exif: Its EXIF; the size in it is the image's before any resizing.
        xmp: Its XMP properties.
        width: Of the stored grid, pixels.
        height: Likewise.
    """
    scale = picture_scale(exif, width, height)
    longer = max(width, height)
    aspect = longer / min(width, height)
    if aspect < PANORAMA and scale is not None:
        plane = "focal-plane-resolution" if scale == 1.0 else "focal-plane-resolution-resized"
        found = {
            "xmp-calibrated": _product(xmp_number(xmp, "drone-dji:CalibratedFocalLength", 1.0, 1e6), scale),
            "sensor-table": _from_sensor(exif, width, height),
            plane: _product(exif.focal_mm, exif.focal_plane_px_per_mm, scale),
            "35mm-equivalent": _from_35mm(exif.focal_35mm, longer, aspect),
        }
        if not _is_credible(found["xmp-calibrated"], found["sensor-table"] or found["35mm-equivalent"]):
            del found["xmp-calibrated"]
        for source in FOCAL_SOURCES:
            focal = found.get(source)
            if focal is not None and FOCAL_BOUNDS[0] <= focal / longer <= FOCAL_BOUNDS[1]:
                return Focal(focal, source, True)
    return Focal(DEFAULT_FOCAL * longer, "guess", False)


def _is_credible(calibrated: float | None, nominal: float | None) -> bool:
    """Whether a maker's calibration agrees with the nominal focal length, where both are known."""
    return calibrated is None or nominal is None or abs(calibrated / nominal - 1.0) <= CALIBRATION_TOLERANCE


def refused_calibrations(photos: Sequence[CheckedPhoto]) -> list[str]:
    """Names of photos whose stated calibration is far from the focal length by lens and sensor."""
    return [
        photo.name
        for photo in photos
        if xmp_number(photo.xmp, "drone-dji:CalibratedFocalLength", 1.0, 1e6) is not None
        and focal_prior(photo.exif, photo.xmp, photo.width, photo.height).source != "xmp-calibrated"
    ]


def group_cameras(photos: Sequence[CheckedPhoto]) -> tuple[list[CameraGroup], dict[str, int]]:
    """Group photos by body (make, model, serial number), size, zoom, and whether the drone removed their distortion.

    Portrait photos that only EXIF rotates have the same stored grid as the others, and are in the same group; if their
    pixels were rotated, they are in another group with the same initial focal length.

    Args:
        photos: The photos in use, sorted by name.

    Returns:
        The groups in the order of their first photos, and each photo's group by its name.
    """
    alike: dict[tuple[object, ...], list[CheckedPhoto]] = {}
    for photo in photos:
        exif = photo.exif
        dewarped = photo.xmp.get("drone-dji:DewarpFlag") == "1"
        key = (exif.make, exif.model, exif.serial, photo.width, photo.height, dewarped)
        alike.setdefault(key, []).append(photo)
    members = [zoom for group in alike.values() for zoom in _by_zoom(group)]
    order = {photo.name: number for number, photo in enumerate(photos)}
    members.sort(key=lambda group: order[group[0].name])
    groups = [_group(group) for group in members]
    index = {photo.name: number for number, group in enumerate(members) for photo in group}
    return groups, index


def _by_zoom(photos: list[CheckedPhoto]) -> list[list[CheckedPhoto]]:
    """Group photos of one body by zoom: around the most frequent focal length, then around that of the rest, and so on.

    A zoom lens reports every step of its motor. A camera per step would be one per photo, which cannot be calibrated.
    """
    left, groups = list(photos), []
    while left:
        counts = Counter((photo.exif.focal_mm, photo.exif.focal_35mm) for photo in left)
        most = min(counts, key=lambda zoom: (-counts[zoom], zoom[0] or 0.0, zoom[1] or 0.0))
        near = [_same_zoom((photo.exif.focal_mm, photo.exif.focal_35mm), most) for photo in left]
        groups.append([photo for photo, is_near in zip(left, near, strict=True) if is_near])
        left = [photo for photo, is_near in zip(left, near, strict=True) if not is_near]
    return groups


def _same_zoom(zoom: tuple[float | None, float | None], other: tuple[float | None, float | None]) -> bool:
    """Compare focal lengths in millimetres and as 35 mm equivalents; only the latter include digital zoom."""
    return all(
        mine is theirs if mine is None or theirs is None else abs(mine - theirs) <= tolerance * theirs
        for mine, theirs, tolerance in zip(zoom, other, (ZOOM_TOLERANCE, EQUIVALENT_TOLERANCE), strict=True)
    )


def describe_cameras(
    photos: Sequence[CheckedPhoto], groups: Sequence[CameraGroup], camera_of: Mapping[str, int]
) -> list[JSON]:
    """One row per camera for reports: name, photos, size, focal length with its source, and the size in EXIF.

    ``exif_size`` is None if it equals the photos' size or is not stated; ``cropped``: its aspect ratio differs.
    """
    first = {camera_of[photo.name]: photo for photo in reversed(photos)}
    rows = []
    for number, group in enumerate(groups):
        exif = first[number].exif
        taken = (exif.width, exif.height)
        differs = None not in taken and sorted(map(str, taken)) != sorted(map(str, (group.width, group.height)))
        rows.append(
            {
                "name": camera_name(group.make, group.model_name),
                "focal_mm": exif.focal_mm,
                "photos": group.photos,
                "size": [group.width, group.height],
                "focal_px": round(group.focal_px, 2),
                "focal_source": group.focal_source,
                "exif_size": list(taken) if differs else None,
                "cropped": picture_scale(exif, group.width, group.height) is None,
            }
        )
    return rows


def camera_name(make: str, model: str) -> str:
    """A camera's display name."""
    name = model if model.casefold().startswith(make.casefold()) else f"{make} {model}"
    return name.strip() or "unknown camera"


def report_cameras(rows: Sequence[JSON], report: Reporter) -> None:
    """Report the cameras if there are several, and how EXIF that states another image size was handled."""
    if len(rows) > 1:
        for row in rows[:CAMERAS_SHOWN]:
            zoom = f", {row['focal_mm']:g} mm" if row["focal_mm"] else ""
            width, height = row["size"]
            focal = f"{row['focal_px']:.0f} px ({row['focal_source'].replace('-', ' ')})"
            report.note(f"{row['name']}{zoom}: {row['photos']} photos of {width} × {height}, focal length {focal}.")
        if len(rows) > CAMERAS_SHOWN:
            report.note(f"And {len(rows) - CAMERAS_SHOWN} more cameras.")
    for row in rows[:CAMERAS_SHOWN]:
        if row["exif_size"] is None:
            continue
        (width, height), (taken_width, taken_height) = row["size"], row["exif_size"]
        sizes = f"{row['photos']} photos of the {row['name']} have {width} × {height} pixels, but their EXIF states"
        sizes += f" {taken_width} × {taken_height}"
        if row["cropped"]:
            report.note(
                f"{sizes}: another aspect ratio, so they were cropped, and their focal length cannot be taken from "
                "EXIF."
            )
        else:
            factor = max(width, height) / max(taken_width, taken_height)
            report.note(f"{sizes}: they are treated as reduced, and its focal length is scaled by {factor:.3g}.")


def cameras_json(groups: Sequence[CameraGroup]) -> JSON:
    """The content of ``cameras.json``."""
    return {"cameras": [asdict(group) for group in groups]}


def _group(photos: Sequence[CheckedPhoto]) -> CameraGroup:
    first = photos[0]
    priors = [focal_prior(photo.exif, photo.xmp, photo.width, photo.height) for photo in photos]
    counts = Counter(prior.source for prior in priors)
    source = min(counts, key=lambda name: (-counts[name], FOCAL_SOURCES.index(name)))
    focal = float(np.median([prior.px for prior in priors if prior.source == source]))
    return CameraGroup(
        model=MODEL,
        width=first.width,
        height=first.height,
        params=(focal, first.width / 2, first.height / 2, 0.0),
        focal_px=focal,
        focal_source=source,
        has_prior=source != "guess",
        make=first.exif.make,
        model_name=first.exif.model,
        photos=len(photos),
    )


def picture_scale(exif: Exif, width: int, height: int) -> float | None:
    """Stored pixels per pixel of the image that the camera took; None if the image was cropped.

    A rotation by 90° does not matter. Without a size in EXIF the scale is 1.
    """
    if exif.width is None or exif.height is None:
        return 1.0
    longer, shorter = max(width, height), min(width, height)
    taken_longer, taken_shorter = max(exif.width, exif.height), min(exif.width, exif.height)
    scale = longer / taken_longer
    if abs(shorter - scale * taken_shorter) > max(1.0, ASPECT_TOLERANCE * shorter):
        return None
    return scale


def _from_sensor(exif: Exif, width: int, height: int) -> float | None:
    size = sensor_size_mm(exif.make, exif.model)
    if size is None or exif.focal_mm is None:
        return None
    longer, shorter = max(width, height), min(width, height)
    # An image narrower than the sensor was cropped at its sides, a wider one at top and bottom.
    used_mm = size[1] * longer / shorter
    if used_mm > size[0] * (1.0 - SHAPE_TOLERANCE):
        used_mm = size[0]
    return exif.focal_mm * longer / used_mm


def _from_35mm(focal_35mm: float | None, longer: int, aspect: float) -> float | None:
    """Convert by the sensor's diagonal (which defines the equivalent), not that of a 16:9 image cropped from it."""
    if focal_35mm is None:
        return None
    shape = aspect if aspect <= WIDEST_SENSOR else 4 / 3
    return focal_35mm * longer / (FILM_DIAGONAL_MM * shape / math.hypot(shape, 1.0))


def _product(*factors: float | None) -> float | None:
    known = [factor for factor in factors if factor is not None]
    return math.prod(known) if len(known) == len(factors) else None
