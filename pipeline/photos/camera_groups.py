"""Which photos share a camera, and what is known of its focal length before calibration."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.photos.check import CheckedPhoto
from splatpipe.pipeline.photos.exif import Exif
from splatpipe.pipeline.photos.sensors import sensor_size_mm
from splatpipe.pipeline.photos.xmp import xmp_number

MODEL = "SIMPLE_RADIAL"
DEFAULT_FOCAL = 1.2  # of the longer side, COLMAP's guess where nothing is known: a lens of 43 mm on 35 mm film
FOCAL_BOUNDS = (0.2, 30.0)  # of the longer side; a value outside is no focal length of a camera
ASPECT_TOLERANCE = 0.01
SHAPE_TOLERANCE = 0.03  # between a sensor's specified shape and that of the pictures that use all of it
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
WIDEST_SENSOR = 1.51  # width over height; wider pictures are cut from a sensor of 4:3
PANORAMA = 2.5  # wider still, no sensor's shape
CAMERAS_TOLD = 10  # on the console; the report has them all
EQUIVALENT_TOLERANCE = 0.05  # of the 35 mm equivalent, which is rounded; what differs by more is digital zoom
ZOOM_TOLERANCE = 0.01  # of the focal length: within it photos share a lens, as focus and heat move it by as much
CALIBRATION_STRAY = 0.15  # from the sensor's focal length: more is another unit, or another mode of the camera


@dataclass(frozen=True)
class Focal:
    """A focal length in pixels of the stored grid.

    Attributes:
        px: Its value.
        source: Where it is from, as FOCAL_SOURCES.
        has_prior: Whether it is more than a guess.
    """

    px: float
    source: str
    has_prior: bool


# In order of trust. A maker's calibration comes first. Rounded 35 mm equivalents err by up to 5 %.
# FocalPlaneXResolution of a photo that was resized afterwards may or may not have been changed with it, so comes last.
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
    """Photos that were taken by one camera with one setting of its lens.

    Attributes:
        model: COLMAP's camera model to start from.
        width: Of the stored grid, pixels.
        height: Likewise.
        params: The model's parameters to start from: focal length, principal point, distortion.
        focal_px: The focal length to start from.
        focal_source: Where it is from.
        has_prior: Whether it is more than a guess.
        make: From EXIF; empty when unknown.
        model_name: Likewise.
        photos: How many there are.
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
    """The most trustworthy focal length that a photo's metadata give.

    Args:
        exif: Its EXIF; the size in it is the picture's before any resizing.
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
            "xmp-calibrated": _times(xmp_number(xmp, "drone-dji:CalibratedFocalLength", 1.0, 1e6), scale),
            "sensor-table": _from_sensor(exif, width, height),
            plane: _times(exif.focal_mm, exif.focal_plane_px_per_mm, scale),
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
    """Whether a maker's calibration can be of this lens and picture, as far as anything else tells."""
    return calibrated is None or nominal is None or abs(calibrated / nominal - 1.0) <= CALIBRATION_STRAY


def refused_calibrations(photos: Sequence[CheckedPhoto]) -> list[str]:
    """Names of photos whose stated calibration is far from what their lens and sensor give."""
    return [
        photo.name
        for photo in photos
        if xmp_number(photo.xmp, "drone-dji:CalibratedFocalLength", 1.0, 1e6) is not None
        and focal_prior(photo.exif, photo.xmp, photo.width, photo.height).source != "xmp-calibrated"
    ]


def group_cameras(photos: Sequence[CheckedPhoto]) -> tuple[list[CameraGroup], dict[str, int]]:
    """Group photos by body (make, model, serial number), size, zoom, and whether the drone took their distortion out.

    Photos held upright have the grid of the others where EXIF turns them, and are of the same group; where their pixels
    were turned, they are of another with the same focal length to begin with.

    Args:
        photos: Those that take part, sorted by name.

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
    """Photos of one body by the zoom: around the focal length that most of them have, then around that of most others.

    A zoom states every step of its motor. A camera a step would be one a photo, which no photo can calibrate.
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
    """By focal length in millimetres and as 35 mm equivalent; the latter alone tells of digital zoom."""
    return all(
        mine is theirs if mine is None or theirs is None else abs(mine - theirs) <= tolerance * theirs
        for mine, theirs, tolerance in zip(zoom, other, (ZOOM_TOLERANCE, EQUIVALENT_TOLERANCE), strict=True)
    )


def describe_cameras(
    photos: Sequence[CheckedPhoto], groups: Sequence[CameraGroup], camera_of: Mapping[str, int]
) -> list[JSON]:
    """A row a camera for people: its name, photos, pixels, focal length with its source, and what size EXIF speaks of.

    ``exif_size`` is None where that is the photos' size, or not stated; ``cropped`` tells that it has another shape.
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
    """What people call a camera."""
    told = model if model.casefold().startswith(make.casefold()) else f"{make} {model}"
    return told.strip() or "unknown camera"


def tell_cameras(rows: Sequence[JSON], report: Reporter) -> None:
    """Name the cameras where there are several, and what was made of EXIF that speaks of another picture size."""
    if len(rows) > 1:
        for row in rows[:CAMERAS_TOLD]:
            zoom = f", {row['focal_mm']:g} mm" if row["focal_mm"] else ""
            width, height = row["size"]
            focal = f"{row['focal_px']:.0f} px ({row['focal_source'].replace('-', ' ')})"
            report.note(f"{row['name']}{zoom}: {row['photos']} photos of {width} × {height}, focal length {focal}.")
        if len(rows) > CAMERAS_TOLD:
            report.note(f"And {len(rows) - CAMERAS_TOLD} more cameras.")
    for row in rows[:CAMERAS_TOLD]:
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
    """What ``cameras.json`` holds."""
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
    """Stored pixels per pixel of the picture that the camera took; None when the picture was cropped.

    A turn by 90° in between does not matter. Without a size in EXIF the picture counts as the camera's own.
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
    # A picture that is narrower than the sensor was cut at its sides, a wider one at top and bottom.
    used_mm = size[1] * longer / shorter
    if used_mm > size[0] * (1.0 - SHAPE_TOLERANCE):
        used_mm = size[0]
    return exif.focal_mm * longer / used_mm


def _from_35mm(focal_35mm: float | None, longer: int, aspect: float) -> float | None:
    """By the diagonal of the sensor (which is how the equivalent is defined), not of a 16:9 picture cut from it."""
    if focal_35mm is None:
        return None
    shape = aspect if aspect <= WIDEST_SENSOR else 4 / 3
    return focal_35mm * longer / (FILM_DIAGONAL_MM * shape / math.hypot(shape, 1.0))


def _times(*factors: float | None) -> float | None:
    known = [factor for factor in factors if factor is not None]
    return math.prod(known) if len(known) == len(factors) else None
