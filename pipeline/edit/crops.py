"""Crops to a box, a polygon or a height range, or cuts these out. A Gaussian's centre decides."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.edit.coordinates import Coordinates, parse_numbers
from splatpipe.pipeline.edit.workpiece import MIDDLE_QUANTILES, Workpiece
from splatpipe.pipeline.engine.digests import file_digest
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.survey.boundary import WITHOUT, placed, placed_area
from splatpipe.pipeline.survey.files.boundary_file import BoundaryFile, read_boundary

DIGEST_CHARACTERS = 16  # hexadecimal digits of a polygon file's SHA-256 in a splat's record: enough to identify it
MESSAGE_DECIMALS = 3  # decimals of coordinates in metres, in messages
Inside = Callable[[Float64[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]
BOX_FORM = "X1,Y1,X2,Y2 or X1,Y1,Z1,X2,Y2,Z2"


@dataclass(frozen=True)
class CropBox:
    """A box along the axes of the coordinates in which it is given.

    Attributes:
        low: Minimum x, y and optionally z.
        high: Maximum x, y and optionally z.
        local: As for ``Coordinates.of``.
        inside: Keep the inside if true, else the outside.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    local: bool = False
    inside: bool = True

    @staticmethod
    def parse(text: str, option: str, local: bool, inside: bool) -> CropBox:
        """Parse two opposite corners, of two or three numbers each.

        Raises:
            UsageError: if it is anything else, or the box is empty.
        """
        numbers = parse_numbers(text, option, (4, 6), BOX_FORM)
        corners = numbers[: len(numbers) // 2], numbers[len(numbers) // 2 :]
        low = tuple(min(pair) for pair in zip(*corners, strict=True))
        high = tuple(max(pair) for pair in zip(*corners, strict=True))
        if any(a == b for a, b in zip(low, high, strict=True)):
            raise UsageError(f"The box of {option} has no size.", hint=f"Write it as {option} {BOX_FORM}.")
        return CropBox(low, high, local, inside)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Crop the splat; returns the record of the step.

        Raises:
            SplatpipeError: if nothing is left.
        """
        coordinates, count = Coordinates.of(piece.facts, self.local), len(self.low)

        def within(places: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
            stated = coordinates.stated(places)[:, :count]
            return np.asarray(((stated >= self.low) & (stated <= self.high)).all(axis=1))

        _crop(piece, within, self.inside, lambda: _nothing("box", piece, coordinates))
        return {
            "step": "crop" if self.inside else "cut",
            "box": [list(self.low), list(self.high)],
            "coordinates": coordinates.name,
        }


@dataclass(frozen=True)
class CropHeights:
    """A height range.

    Attributes:
        low: Lower limit; −∞ if open.
        high: Upper limit; ∞ if open.
        local: As for ``Coordinates.of``.
    """

    low: float
    high: float
    local: bool = False

    @staticmethod
    def parse(text: str, option: str, local: bool) -> CropHeights:
        """Parse two heights; one of them may be left out.

        Raises:
            UsageError: if it is anything else, or the range is empty.
        """
        form = "LOW,HIGH (or LOW, or ,HIGH)"
        first, comma, second = (part.strip() for part in text.partition(","))
        if not comma or not (first or second):
            raise UsageError(f'Cannot understand {option} "{text[:60]}".', hint=f"Write it as {option} {form}.")
        low = parse_numbers(first, option, (1,), form)[0] if first else -math.inf
        high = parse_numbers(second, option, (1,), form)[0] if second else math.inf
        if low >= high:
            raise UsageError(
                f"Between {first} and {second} of {option} there are no heights.", hint="Give the lower height first."
            )
        return CropHeights(low, high, local)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Crop the splat; returns the record of the step.

        Raises:
            SplatpipeError: if nothing is left.
        """
        coordinates = Coordinates.of(piece.facts, self.local)

        def within(places: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
            heights = coordinates.heights(places)
            return np.asarray((heights >= self.low) & (heights <= self.high))

        _crop(piece, within, True, lambda: _nothing("heights", piece, coordinates))
        ends = [end if math.isfinite(end) else None for end in (self.low, self.high)]
        return {"step": "crop", "heights": ends, "coordinates": coordinates.name}


@dataclass(frozen=True)
class CropPolygon:
    """The polygons of a GeoJSON file, in any CRS.

    Attributes:
        path: The file.
        local: Its coordinates are metres east and north in the splat's frame.
        inside: Keep the inside if true, else the outside.
    """

    path: Path
    local: bool = False
    inside: bool = True

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Crop the splat; returns the record of the step.

        Raises:
            SplatpipeError: if the file is broken, the splat is not georeferenced, or nothing is left.
        """
        drawing = read_boundary(self.path)
        area = self._area(drawing, piece)
        if drawing.crossing:
            x, y = drawing.crossing
            piece.notes.append(
                f"{drawing.name} crosses itself near {x:.10g}, {y:.10g}: areas enclosed twice count as outside."
            )
        _crop(piece, area.contains, self.inside, lambda: self._nothing(drawing, piece))
        return {
            "step": "crop" if self.inside else "cut",
            "polygon": drawing.name[:80],
            "sha256": file_digest(self.path)[:DIGEST_CHARACTERS],
            "area_m2": round(area.size(), 2),
        }

    def _area(self, drawing: BoundaryFile, piece: Workpiece) -> PlanArea:
        if self.local:
            return PlanArea.seen_from_above(drawing.polygons)
        if piece.frame is None:
            raise SplatpipeError(
                f"{drawing.name} cannot be used on a splat that is not georeferenced.",
                hint="Use --crop-box in the splat's own coordinates, or add --local if the polygon is in them.",
            )
        try:
            return placed_area(drawing, piece.frame)
        except SplatpipeError as error:
            raise _for_edits(error) from error

    def _nothing(self, drawing: BoundaryFile, piece: Workpiece) -> SplatpipeError:
        if self.local or piece.frame is None or not self.inside:
            return _nothing(f"polygon {drawing.name}", piece, Coordinates.of(piece.facts, self.local))
        try:
            placed(drawing, piece.frame, piece.sample())
        except SplatpipeError as error:
            return _for_edits(error)
        return _nothing(f"polygon {drawing.name}", piece, Coordinates.of(piece.facts, self.local))


def _for_edits(error: SplatpipeError) -> SplatpipeError:
    """A boundary's error without the part of the hint that applies only to a run."""
    return SplatpipeError(error.message, error.hint.replace(WITHOUT, "").strip())


def _crop(piece: Workpiece, within: Inside, inside: bool, nothing: Callable[[], SplatpipeError]) -> None:
    chosen = np.empty(len(piece), np.bool_)
    for rows, places in piece.places():
        chosen[rows] = within(places) == inside
    if not chosen.any():
        raise nothing()
    piece.keep(chosen)


def _nothing(what: str, piece: Workpiece, coordinates: Coordinates) -> SplatpipeError:
    """The error that nothing is left; it says where the splat is."""
    ends = np.quantile(coordinates.stated(piece.sample()), MIDDLE_QUANTILES, axis=0)
    low, high = (",".join(f"{number:.{_digits(coordinates)}f}" for number in end) for end in ends)
    named = {"own": "in its own coordinates", "local": "in metres from its origin"}
    where = named.get(coordinates.name, f"in {coordinates.name}")
    hint = f"Most of it lies between {low} and {high} ({where})."
    if coordinates.world is not None:
        hint += " With --local, numbers are metres from its origin."
    return SplatpipeError(f"The crop by {what} would remove the whole splat.", hint)


def _digits(coordinates: Coordinates) -> int:
    degrees = coordinates.world is not None and coordinates.world.crs.is_geographic
    return 7 if degrees else MESSAGE_DECIMALS
