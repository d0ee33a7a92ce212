"""Thumbnails of the photos that findings are about, or crops at full resolution where these show more."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.app.page_file import printable
from splatpipe.pipeline.app.preflight.findings import Finding, PhotoFacts, Preflight
from splatpipe.pipeline.app.report.facts.wording import number
from splatpipe.pipeline.app.thumbnails import Thumbnail, crop_middle, thumbnail

THUMBNAIL_PX = 260  # pixels of a thumbnail's longer side
CROP_PX = (260, 195)  # photo pixels of a crop: blur of a pixel or two is invisible in a thumbnail
MAX_PER_FINDING = 8
MAX_PICTURES = 40  # on the page: below a megabyte, and a second or two of decoding
MAX_CROPS = 8  # crops on the page, each of which takes decoding a whole photo
CROPPED_FINDINGS = ("blurred",)  # findings whose photos are shown as crops
MAX_EXAMPLES = 3  # photos that are shown of a capture that is dull throughout
MIN_SHARPNESS = 0.9  # least relative sharpness of a neighbour shown for comparison


@dataclass(frozen=True)
class FindingPicture:
    """An image shown with a finding.

    Attributes:
        name: The photo's printable name.
        picture: The image; None if the photo cannot be read.
        fact: What was measured, in words; may be empty.
        beside: Whether it is not one of the finding's photos but shown for comparison.
    """

    name: str
    picture: Thumbnail | None
    fact: str
    beside: bool = False


def finding_pictures(preflight: Preflight) -> list[list[FindingPicture]]:
    """Images for each finding, in order; the worst findings, which come first, have priority within the limits."""
    photos = {photo.name: photo for photo in preflight.photos}
    left, cuts = MAX_PICTURES, MAX_CROPS
    every = []
    for finding in preflight.findings:
        pictures: list[FindingPicture] = []
        names = finding.photos or _examples(preflight, finding)
        for name in names[: min(MAX_PER_FINDING, left)]:
            close = finding.code in CROPPED_FINDINGS and cuts > 0
            cuts -= close
            pictures.append(_make_picture(preflight.root, name, finding, photos.get(name), close=close))
        if finding.code in CROPPED_FINDINGS and pictures and cuts > 0:
            other = _sharp_neighbour(preflight, names[0])
            if other is not None:
                cuts -= 1
                pictures.insert(1, _make_picture(preflight.root, other.name, finding, other, close=True, beside=True))
        left = max(0, left - len(pictures))
        every.append(pictures)
    return every


def facts_in_words(finding: Finding, photo: PhotoFacts | None) -> str:
    """The measurements of a photo that are relevant to a finding, in words."""
    if photo is None:
        return ""
    if finding.code in CROPPED_FINDINGS and photo.sharpness is not None:
        return f"{photo.sharpness:.0%} as sharp as its neighbours".replace("%", " %")
    if any(word in finding.code for word in ("expos", "bright", "dark")):
        if photo.brightness_ev is not None:
            return f"{photo.brightness_ev:+.1f} EV".replace("-", "−")
        return f"mean grey level {number(photo.mean_level, 0)} of 255" if photo.mean_level is not None else ""
    if any(word in finding.code for word in ("size", "camera", "resized", "focal")):
        return f"{photo.width:,} × {photo.height:,} pixels"
    return ""


def _examples(preflight: Preflight, finding: Finding) -> tuple[str, ...]:
    """Example photos for a finding: the worst ones if it concerns the whole capture, else those it names."""
    photos = preflight.photos
    if finding.code == "orphan":
        return tuple(photos[i].name for i in preflight.orphans)
    if finding.code in CROPPED_FINDINGS:
        known = [photo for photo in photos if photo.sharpness is not None]
        return tuple(photo.name for photo in sorted(known, key=lambda photo: photo.sharpness or 0.0)[:MAX_EXAMPLES])
    names = {photo.name for photo in photos}
    words = dict.fromkeys(word.strip("()") for word in re.split(r"[\s,;:]+", finding.message))
    return tuple(word for word in (each if each in names else each.rstrip(".") for each in words) if word in names)


def _make_picture(
    root: Path, name: str, finding: Finding, photo: PhotoFacts | None, *, close: bool, beside: bool = False
) -> FindingPicture:
    path = root / name
    inside = ".." not in Path(name).parts and not Path(name).is_absolute()
    picture = None
    if inside:
        picture = crop_middle(path, *CROP_PX) if close else thumbnail(path, THUMBNAIL_PX)
    return FindingPicture(printable(name), picture, facts_in_words(finding, photo), beside)


def _sharp_neighbour(preflight: Preflight, name: str) -> PhotoFacts | None:
    """The sharp photo that overlaps another one most."""
    numbers: Mapping[str, int] = {photo.name: i for i, photo in enumerate(preflight.photos)}
    own = numbers.get(name)
    beside: Sequence[tuple[int, int]] = [
        (pair.matches, pair.second if pair.first == own else pair.first)
        for pair in preflight.pairs
        if own in (pair.first, pair.second)
    ]
    sharp = [(n, i) for n, i in beside if (preflight.photos[i].sharpness or 0.0) >= MIN_SHARPNESS]
    return preflight.photos[max(sharp)[1]] if sharp else None
