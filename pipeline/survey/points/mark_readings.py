"""Conventions of pixel coordinates, told apart by whether the marks of each point meet in one place of the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.crs.readings import MIN_CONTRADICTING, Evidence, Reading, plausible
from splatpipe.pipeline.survey.files.control_file import SurveyedPoint
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.points.located_points import Sighting, SurveyPoint, locate

MIN_AGREEING_SHARE = 0.5  # share of the marks that could contradict: if fewer agree, they do so by chance
MAX_POINTS, MAX_MARKS = 12, 8  # points, and marks of each, that other readings are tried on: half a second each
Pixel = tuple[float, float]
Rewrite = Callable[[float, float, float, float], Pixel]


@dataclass(frozen=True)
class Marks:
    """The usable marks of a control file: by point, those in photos of the capture.

    Attributes:
        points: The points.
        pixels: Of each point by photo, in the file's order; (0, 0) is the corner of the first pixel.
    """

    points: tuple[SurveyedPoint, ...]
    pixels: tuple[Mapping[str, Pixel], ...]

    def some(self) -> Marks:
        """A part that is enough to judge a convention, evenly over the file and each point's photos."""
        best = [k for k, pixels in enumerate(self.pixels) if len(pixels) >= 2]
        best = best[:: -(-len(best) // MAX_POINTS) or 1]
        thinned = []
        for k in best:
            names = sorted(self.pixels[k])
            thinned.append({name: self.pixels[k][name] for name in names[:: -(-len(names) // MAX_MARKS)]})
        return Marks(tuple(self.points[k] for k in best), tuple(thinned))


def _scaled(factor: int) -> list[tuple[Reading, Rewrite]]:
    larger = Reading(
        f"the marks were made in photos {factor} times as wide and high",
        f"Divide the pixel coordinates by {factor}, or use the photos that were marked.",
    )
    smaller = Reading(
        f"the marks were made in copies of 1/{factor} of the photos' width and height",
        f"Multiply the pixel coordinates by {factor}.",
    )
    return [
        (larger, lambda x, y, _width, _height: (x / factor, y / factor)),
        (smaller, lambda x, y, _width, _height: (x * factor, y * factor)),
    ]


# The rewriting takes pixel x and y, and the width and height of the stored photo.
READINGS: tuple[tuple[Reading, Rewrite], ...] = (
    (
        Reading(
            "pixel rows count from the bottom of the photo",
            "Replace pixel_y by the photo's height minus pixel_y: rows count from the top here.",
        ),
        lambda x, y, _width, height: (x, height - y),
    ),
    (
        Reading(
            "pixel rows are negative, as QGIS writes them",
            "Omit the minus signs of pixel_y: rows count from the top, downwards.",
        ),
        lambda x, y, _width, _height: (x, -y),
    ),
    (
        Reading("pixel columns and rows are swapped", "Swap pixel_x (the column) and pixel_y (the row)."),
        lambda x, y, _width, _height: (y, x),
    ),
    (
        Reading(
            "pixel columns count from the right of the photo", "Replace pixel_x by the photo's width minus pixel_x."
        ),
        lambda x, y, width, _height: (width - x, y),
    ),
    (
        Reading("the marks were made in photos turned by 180°", "Mark them in the photos as they are stored."),
        lambda x, y, width, height: (width - x, height - y),
    ),
    (
        Reading("the marks were made in photos turned by 90°", "Mark them in the photos as they are stored."),
        lambda x, y, _width, height: (y, height - x),
    ),
    (
        Reading("the marks were made in photos turned by 270°", "Mark them in the photos as they are stored."),
        lambda x, y, width, _height: (width - y, x),
    ),
    (
        Reading(
            "pixel coordinates are shares of the photo's width and height",
            "Multiply pixel_x by the photo's width, and pixel_y by its height.",
        ),
        lambda x, y, width, height: (x * width, y * height),
    ),
    (
        Reading(
            "pixel coordinates count from the middle of the photo",
            "Add half of the photo's width to pixel_x, and half of its height to pixel_y.",
        ),
        lambda x, y, width, height: (x + width / 2.0, y + height / 2.0),
    ),
    (
        Reading(
            "pixel coordinates count from the middle of the photo, upwards",
            "Add half of the photo's width to pixel_x, and replace pixel_y by half of its height minus pixel_y.",
        ),
        lambda x, y, width, height: (x + width / 2.0, height / 2.0 - y),
    ),
    *(each for factor in (2, 4, 8, 3) for each in _scaled(factor)),
)


def named_reading(
    marks: Marks, model: SparseModel, photos: Mapping[str, Photo], mark_sigma_px: float
) -> tuple[Reading, Evidence] | None:
    """The convention that explains the marks where the stated one does not; None if there is none."""
    few = marks.some()
    stated = _evidence(few, model, photos, mark_sigma_px, lambda x, y, _width, _height: (x, y))
    tried = ((reading, _evidence(few, model, photos, mark_sigma_px, rewrite)) for reading, rewrite in READINGS)
    return plausible(stated, tried)


def require_agreement(
    name: str,
    marks: Marks,
    located: Sequence[SurveyPoint],
    model: SparseModel,
    photos: Mapping[str, Photo],
    mark_sigma_px: float,
) -> None:
    """Refuse a file most of whose marks contradict each other.

    The few that agree do so by chance, and would place the model with the accuracy of a survey. Three points of three
    marks each, of which none agrees with the other two, are refused, too; their number names no cause.

    Args:
        name: Of the file.
        marks: Its marks.
        located: Its points, triangulated from them.
        model: The sparse model.
        photos: All photos of the capture by name.
        mark_sigma_px: As in the options.

    Raises:
        SplatpipeError: if they do; the hint names the convention that explains them, if one does.
    """
    found = _sum([_witnesses(point, len(_posed(point.sightings))) for point in located])
    if found.of < MIN_CONTRADICTING or found.share >= MIN_AGREEING_SHARE:
        return
    off = sum(1 for point in located for each in _posed(point.sightings) if point.found is None or not each.agrees)
    count = sum(len(_posed(point.sightings)) for point in located)
    cause = named_reading(marks, model, photos, mark_sigma_px)
    hint = (
        "Are they of these photos, and each of the point that it names? Pixel columns count from the left, rows from"
        " the top. Marks made roughly: --set georef.mark_sigma_px=3."
        if cause is None
        else sentence_of(*cause)
    )
    raise SplatpipeError(
        f"The marks of {name} contradict each other: {off} of {count} do not meet the others of their points.",
        f"{hint} --set georef.control=none runs without control.",
    )


def sentence_of(reading: Reading, evidence: Evidence) -> str:
    """A hint at a convention: what speaks for it, and what to do."""
    return (
        f"If {reading.cause}, {evidence.share:.0%} of the marks that can be compared agree: it looks like that. "
        f"{reading.remedy}"
    )


def _evidence(
    marks: Marks, model: SparseModel, photos: Mapping[str, Photo], mark_sigma_px: float, rewrite: Rewrite
) -> Evidence:
    index = {photo: k for k, photo in enumerate(model.names)}
    each = []
    for point, pixels in zip(marks.points, marks.pixels, strict=True):
        sightings = []
        for photo, (x, y) in sorted(pixels.items()):
            width, height = photos[photo].width, photos[photo].height
            pixel = rewrite(x, y, width, height)
            if photo in index and 0.0 <= pixel[0] <= width and 0.0 <= pixel[1] <= height:
                sightings.append(Sighting(photo, pixel, index[photo]))
        count = sum(photo in index for photo in pixels)
        located = locate(SurveyPoint(point, "control", "", tuple(sightings)), model, photos, mark_sigma_px)
        each.append(_witnesses(located, count))
    return _sum(each)


def _witnesses(point: SurveyPoint, count: int) -> Evidence:
    """Marks that could contradict a point's place, and those that do not.

    Two marks are needed for a place, and the pair that most others agree with is chosen: it agrees with itself in any
    case. Of two marks alone, the second can contradict: rays pass each other.
    """
    if count < 2:
        return Evidence(0, 0)
    agree = 0 if point.found is None else sum(each.agrees for each in _posed(point.sightings))
    return Evidence(int(agree == 2), 1) if count == 2 else Evidence(max(agree - 2, 0), count - 2)


def _posed(sightings: Sequence[Sighting]) -> list[Sighting]:
    return [each for each in sightings if each.index is not None and not each.automatic]


def _sum(each: Sequence[Evidence]) -> Evidence:
    return Evidence(sum(one.explained for one in each), sum(one.of for one in each))
