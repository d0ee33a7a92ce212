"""A drawing in metres at true size: lines, texts, an image, a scale bar; the source of DXF and SVG files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

PAPER_MM = (380.0, 240.0)  # area on an A3 page that a drawing may fill
SCALES = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000)  # denominators used for plans
BAR_MM = 60.0  # longest scale bar on paper
BAR_LENGTHS_M = tuple(base * 10.0**power for power in range(-1, 5) for base in (1.0, 2.0, 5.0))
BAR_PARTS = 4
TEXT_MM, TITLE_MM = 2.5, 5.0  # ISO 3098's heights of letters
GAP_MM = 6.0  # between what is drawn and what is written about it

EXTENT, OUTLINE, OPENINGS, PROJECTIONS, SURFACE, GROUND, POINTS, GRID, TEXTS, PICTURE = (
    "EXTENT",
    "OUTLINE",
    "OPENINGS",
    "PROJECTIONS",
    "SURFACE",
    "GROUND",
    "POINTS",
    "GRID",
    "TEXT",
    "PICTURE",
)
Line2 = Float64[np.ndarray, "_ 2"]
Place2 = Float64[np.ndarray, " 2"]


@dataclass(frozen=True, eq=False)
class Stroke:
    """A polyline.

    Attributes:
        layer: One of the layer constants.
        line: Metres to the right and up.
        closed: Whether its end connects to its start.
        filled: Whether it is filled; only with four corners.
    """

    layer: str
    line: Line2
    closed: bool = False
    filled: bool = False


@dataclass(frozen=True)
class Label:
    """A text.

    Attributes:
        text: One line.
        right_m: Horizontal position of its anchor.
        up_m: Height of its baseline.
        size_mm: Height of its letters on paper.
        anchor: The part of the text at that position: ``start``, ``middle`` or ``end``.
    """

    text: str
    right_m: float
    up_m: float
    size_mm: float = TEXT_MM
    anchor: str = "start"


@dataclass(frozen=True)
class Dots:
    """Points of one layer.

    Attributes:
        layer: One of the layer constants.
        places: Metres to the right and up.
    """

    layer: str
    places: Line2


@dataclass(frozen=True)
class DrawingPicture:
    """An image at true size.

    Attributes:
        file: Name of the image file beside the drawing.
        left_m: Left edge.
        bottom_m: Bottom edge.
        width_m: Width of the image.
        height_m: Height of the image.
        pixels: Width and height, pixels.
    """

    file: str
    left_m: float
    bottom_m: float
    width_m: float
    height_m: float
    pixels: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Drawing:
    """A drawing, in metres at true size.

    Attributes:
        scale: Denominator of the plot scale.
        strokes: Lines, from bottom to top.
        labels: Texts.
        picture: Image below everything else; None without one.
        dots: Points.
    """

    scale: int
    strokes: Sequence[Stroke]
    labels: Sequence[Label]
    picture: DrawingPicture | None = None
    dots: Dots | None = None

    def box(self) -> tuple[Place2, Place2]:
        """Lower left and upper right corner of all lines and the image; texts extend slightly beyond."""
        parts = [stroke.line for stroke in self.strokes]
        if self.picture is not None:
            left, bottom = self.picture.left_m, self.picture.bottom_m
            parts.append(rectangle(left, bottom, left + self.picture.width_m, bottom + self.picture.height_m))
        every = np.concatenate(parts)
        return every.min(axis=0), every.max(axis=0)


def plot_scale(width_m: float, height_m: float) -> int:
    """The largest usual scale at which a drawing fits onto an A3 sheet, or else the smallest usual scale."""
    for scale in SCALES:
        if width_m * 1000.0 / scale <= PAPER_MM[0] and height_m * 1000.0 / scale <= PAPER_MM[1]:
            return scale
    return SCALES[-1]


def rectangle(left_m: float, bottom_m: float, right_m: float, top_m: float) -> Line2:
    """Corners of a rectangle, for a closed line."""
    return np.array([[left_m, bottom_m], [right_m, bottom_m], [right_m, top_m], [left_m, top_m]])


def caption(title: str, about: Sequence[str], left_m: float, bottom_m: float, scale: int) -> list[Label]:
    """A title and descriptive lines below a drawing, given its lower left corner."""
    mm = scale / 1000.0
    labels = [Label(title, left_m, bottom_m - (GAP_MM + TITLE_MM) * mm, TITLE_MM)]
    for number, text in enumerate(about, 1):
        labels.append(Label(text, left_m, bottom_m - (GAP_MM + TITLE_MM + 2.0 * TEXT_MM * number) * mm))
    return labels


def scale_bar(right_m: float, bottom_m: float, scale: int) -> tuple[list[Stroke], list[Label]]:
    """A scale bar below the right end of a drawing, with alternately filled parts and lengths.

    Args:
        right_m: Right edge of the drawing.
        bottom_m: Bottom edge of the drawing.
        scale: Denominator of the plot scale.
    """
    mm = scale / 1000.0
    length = max((metres for metres in BAR_LENGTHS_M if metres <= BAR_MM * mm), default=BAR_LENGTHS_M[0])
    left, top = right_m - length, bottom_m - GAP_MM * mm
    bottom = top - TEXT_MM / 2.0 * mm
    edges = left + np.arange(BAR_PARTS + 1) * (length / BAR_PARTS)
    strokes = [
        Stroke(TEXTS, rectangle(a, bottom, b, top), closed=True, filled=number % 2 == 0)
        for number, (a, b) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))
    ]
    below = bottom - 2.0 * TEXT_MM * mm
    labels = [
        Label(text, at, below, anchor="middle")
        for text, at in (("0", left), (f"{length / 2.0:g}", left + length / 2.0), (f"{length:g} m", right_m))
    ]
    return strokes, labels
