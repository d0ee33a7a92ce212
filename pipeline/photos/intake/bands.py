"""Photos of several spectral bands of the same shot: multispectral cameras, and thermal ones beside a colour camera.

Poses come from one band: its cameras are those of the shot, and the others, behind other lenses, would be cameras of
their own with the same view. A band is told by XMP (``Camera:BandName`` and ``CentralWavelength`` of Pix4D's namespace,
as MicaSense, Parrot and DJI write them; DJI's ``ImageSource``) or by the name, as those makers give it, where the shot
has a photo of another band, too.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import cv2
import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.names import list_names
from splatpipe.pipeline.photos.files.scan import ExcludedPhoto
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.intake.detail import read_grey
from splatpipe.pipeline.photos.metadata.xmp import xmp_number

AUTO, ALL = "auto", "all"
COLOUR, THERMAL = "colour", "thermal"
NAMES = {  # as makers write bands, letters and digits only
    **dict.fromkeys(("rgb", "colour", "color", "visible"), COLOUR),
    **dict.fromkeys(("blue", "b"), "blue"),
    **dict.fromkeys(("green", "gre", "g"), "green"),
    **dict.fromkeys(("red", "r"), "red"),
    **dict.fromkeys(("rededge", "reg", "re"), "red edge"),
    **dict.fromkeys(("nir", "nearinfrared", "nearir"), "near infrared"),
    **dict.fromkeys(("panchro", "panchromatic", "pan"), "panchromatic"),
    **dict.fromkeys(("lwir", "thermal", "thermalinfrared"), THERMAL),
}
WAVELENGTHS_NM = (  # upper ends
    (510.0, "blue"),
    (600.0, "green"),
    (690.0, "red"),
    (750.0, "red edge"),
    (1100.0, "near infrared"),
    (1e6, THERMAL),
)
SOURCES = {"infraredcamera": THERMAL, "widecamera": COLOUR, "zoomcamera": COLOUR, "visiblecamera": COLOUR}
TAGS = {  # ends of names: of Sequoia, of DJI's multispectral and of its thermal cameras
    "gre": "green",
    "red": "red",
    "reg": "red edge",
    "nir": "near infrared",
    "rgb": COLOUR,
    "ms_g": "green",
    "ms_r": "red",
    "ms_re": "red edge",
    "ms_nir": "near infrared",
    "d": COLOUR,
    "t": THERMAL,
    "thrm": THERMAL,
    "ir": THERMAL,
    "v": COLOUR,
    "w": COLOUR,
    "z": COLOUR,
}
_TAGGED = re.compile(rf"(?P<shot>.+)_(?P<tag>{'|'.join(sorted(TAGS, key=len, reverse=True))})")
_AUTEL = re.compile(r"(?P<tag>irx|max)_(?P<shot>\d+)")
_TIME = re.compile(r"_\d{14}(?=_)")  # in DJI's names; it may differ by a second between the cameras of a shot
# most pixels of a thermal photo known only by its name, over those of the smallest colour one
MAX_THERMAL_PIXEL_SHARE = 0.5
MIN_COLOUR_PHOTO_SHARE = 0.5  # colour is used as the band if its photos are this share of the most numerous band's
SAMPLED = 5  # photos of each band whose sharpness is measured
SIGMA_PX = 1.0  # standard deviation of the blur that removes single pixels' noise


@dataclass(frozen=True)
class BandChoice:
    """The photos of the band that is used.

    Attributes:
        photos: These, and all photos whose band is not known.
        left_out: Those of other bands.
        note: What was chosen, in a sentence; empty where there is nothing to choose.
    """

    photos: list[CheckedPhoto]
    left_out: list[ExcludedPhoto]
    note: str


def choose_band(photos: Sequence[CheckedPhoto], wanted: str) -> BandChoice:
    """Keep the photos of one band.

    Args:
        photos: All usable photos.
        wanted: A band; ``auto``: colour, or else the sharpest band; ``all``: every photo.

    Raises:
        SplatpipeError: if there are no photos of the wanted band.
    """
    if wanted == ALL:
        return BandChoice(list(photos), [], "")
    bands = bands_of(photos)
    counts = Counter(bands.values())
    if wanted != AUTO:
        band = _known(wanted) or wanted.casefold().strip()
        if band not in counts:
            listed = f"these are of {', '.join(sorted(counts))}" if counts else "no photo states its band"
            raise SplatpipeError(
                f"ingest.bands={wanted}, but there is no photo of that band: {listed}.",
                "Give one of these bands, or --set ingest.bands=auto.",
            )
    elif len(counts) < 2:
        return BandChoice(list(photos), [], "")
    else:
        band = COLOUR if counts[COLOUR] >= MIN_COLOUR_PHOTO_SHARE * max(counts.values()) else _sharpest(photos, bands)
    kept = [photo for photo in photos if bands.get(photo.name, band) == band]
    left_out = [
        ExcludedPhoto(photo.name, f"shows the band {bands[photo.name]}, and {band} is used", "companion")
        for photo in photos
        if bands.get(photo.name, band) != band
    ]
    others = sorted(set(counts) - {band})
    note = f"The photos are of {len(counts)} bands: {band} is used, without {', '.join(others)}; ingest.bands chooses."
    lacking = _without(photos, {name for name, its in bands.items() if its == band})
    if lacking:
        note += f" Shots without a photo of that band: those of {list_names(lacking)}."
    return BandChoice(kept, left_out, note if others else "")


def _without(photos: Sequence[CheckedPhoto], used: Container[str]) -> list[str]:
    """The first photo of each shot that has none of the used ones; empty where these do not tell their shots."""
    shots: dict[tuple[str, str], list[str]] = {}
    for photo in photos:
        shot = _shot_of(photo)
        if shot is not None:
            shots.setdefault(shot, []).append(photo.name)
        elif photo.name in used:
            return []
    return sorted(min(names) for names in shots.values() if not any(name in used for name in names))


def _shot_of(photo: CheckedPhoto) -> tuple[str, str] | None:
    """What the photos of a shot have in common: its identifier, or the beginning of their names."""
    identifier = photo.xmp.get("Camera:CaptureUUID") or photo.xmp.get("MicaSense:CaptureId")
    return ("", identifier) if identifier else _shot_by_name(photo.name)[0]


def _shot_by_name(name: str) -> tuple[tuple[str, str] | None, str]:
    """The shot of a photo, as a folder and what its names have in common, and its band; None where no name tells."""
    path = PurePosixPath(name)
    stem = path.stem.casefold()
    if found := _TAGGED.fullmatch(stem):
        return (str(path.parent), _TIME.sub("", found["shot"])), TAGS[found["tag"]]
    if found := _AUTEL.fullmatch(stem):
        return (str(path.parent), found["shot"]), THERMAL if found["tag"] == "irx" else COLOUR
    return None, ""


def bands_of(photos: Sequence[CheckedPhoto]) -> dict[str, str]:
    """The band of each photo, by name; without those that do not tell it.

    Where a capture has photos of single bands, colour photos that tell no band are of the colour camera beside them.
    """
    stated = {photo.name: band for photo in photos if (band := _stated(photo.xmp))}
    named = _by_names([photo for photo in photos if photo.name not in stated])
    bands = {**stated, **named}
    single = any(band != COLOUR for band in bands.values())
    rest = [photo for photo in photos if photo.name not in bands and not photo.grey] if single else []
    return {**bands, **dict.fromkeys((photo.name for photo in rest), COLOUR)}


def _stated(xmp: Mapping[str, str]) -> str:
    """The band by XMP; empty where it states none."""
    source = SOURCES.get(xmp.get("drone-dji:ImageSource", "").casefold(), "")
    name = xmp.get("Camera:BandName", "").strip()
    if not name:
        return source
    if "," in name:  # red, green and blue
        return COLOUR
    known = _known(name)
    if known:
        return known
    wavelength = xmp_number(xmp, "Camera:CentralWavelength", 300.0, 1e5)
    if any(sign.isdigit() for sign in name) or wavelength is None:  # such as Red edge-740, beside Red edge-705
        return name.casefold()
    return next(band for upper, band in WAVELENGTHS_NM if wavelength <= upper)


def _known(name: str) -> str:
    return NAMES.get("".join(filter(str.isalnum, name.casefold())), "")


def _by_names(photos: Sequence[CheckedPhoto]) -> dict[str, str]:
    """The bands that names tell, in shots of several bands."""
    shots: dict[tuple[str, str], list[tuple[CheckedPhoto, str]]] = {}
    for photo in photos:
        shot, band = _shot_by_name(photo.name)
        if shot is not None:
            shots.setdefault(shot, []).append((photo, band))
    confirmed = [shot for shot in shots.values() if _is_shot(shot)]
    return {photo.name: band for shot in confirmed for photo, band in shot}


def _is_shot(shot: Iterable[tuple[CheckedPhoto, str]]) -> bool:
    """Whether photos of like names are bands of one shot: grey ones of bands, or a small thermal one beside colour."""
    pixels: dict[str, list[int]] = {}
    for photo, band in shot:
        if band not in (COLOUR, THERMAL) and not photo.grey:
            return False
        pixels.setdefault(band, []).append(photo.width * photo.height)
    if set(pixels) == {COLOUR, THERMAL}:
        return max(pixels[THERMAL]) <= MAX_THERMAL_PIXEL_SHARE * min(pixels[COLOUR])
    return len(pixels) > 1


def _sharpest(photos: Sequence[CheckedPhoto], bands: Mapping[str, str]) -> str:
    """The band with the most fine detail over its contrast; thermal only if there is no other."""
    found: dict[str, float] = {}
    for band in sorted(set(bands.values()) - {THERMAL}) or [THERMAL]:
        own = [photo for photo in photos if bands.get(photo.name) == band]
        chosen = own[:: max(1, len(own) // SAMPLED)][:SAMPLED]
        found[band] = float(np.median([_sharpness(photo) for photo in chosen]))
    return max(found, key=lambda band: found[band])


def _sharpness(photo: CheckedPhoto) -> float:
    grey = cv2.GaussianBlur(read_grey(photo), (0, 0), SIGMA_PX).astype(np.float32)
    contrast = float(grey.std())
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean()) / contrast if contrast > 0.0 else 0.0
