"""The style of the report's charts, and their conversion to inline SVG."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float64
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

INK, FAINT, LINE = "#1b1f24", "#5b6570", "#d8dde3"
BLUE, ORANGE, GREEN, RED, GREY = "#0b66c3", "#d9730d", "#1a7f37", "#cf222e", "#8b949e"
WIDTH, HEIGHT = 5.4, 3.5  # inches: half a page's width, or a phone's, with legible letters on both
MARGINS = (0.78, 0.12, 0.5, 0.3)  # inches: left, right, bottom, top
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text: small, searchable, in the page's own font
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.edgecolor": LINE,
    "axes.labelcolor": FAINT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#eceff2",
    "text.color": INK,
    "text.parse_math": False,  # a point may be named $5
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "legend.frameon": False,
    "figure.dpi": 100,
    "savefig.dpi": 110,  # resolution of rasterized parts: point clouds
}


@contextmanager
def styled() -> Iterator[None]:
    """Context in which charts have the report's style, whatever the user's matplotlibrc says."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def new_figure(width: float = WIDTH, height: float = HEIGHT, right: float = MARGINS[1]) -> tuple[Figure, Axes]:
    """An empty chart and its axes; sizes in inches, `right` is the right margin."""
    figure = Figure(figsize=(width, height))  # margins are fixed: a layout engine would draw everything twice
    FigureCanvasSVG(figure)
    left, _, bottom, top = MARGINS
    figure.subplots_adjust(left / width, bottom / height, 1.0 - right / width, 1.0 - top / height)
    return figure, figure.add_subplot()


def new_rows(count: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Empty charts one below the other, with a common horizontal axis; sizes of all of it in inches."""
    figure = Figure(figsize=(width, height))
    FigureCanvasSVG(figure)
    left, right, bottom, top = MARGINS
    figure.subplots_adjust(left / width, bottom / height, 1.0 - right / width, 1.0 - top / height, hspace=0.28)
    return figure, list(figure.subplots(count, 1, sharex=True))


def to_svg(figure: Figure, title: str) -> Markup:
    """A chart as an SVG element for the page; IDs are unique across charts.

    Args:
        figure: The chart.
        title: The text alternative.
    """
    salt = hashlib.sha256(title.encode()).hexdigest()[:12]
    with matplotlib.rc_context({"svg.hashsalt": salt}):
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'\b(id="|href="#|url\(#)', rf"\g<1>c{salt}-", svg)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    label = Markup.escape(title)
    return Markup(svg.replace("<svg", f'<svg role="img" aria-label="{label}"', 1))


def as_map(axes: Axes, box: tuple[float, float, float, float], unit: str) -> None:
    """Format axes as a map: equal scales, east and north.

    Args:
        axes: The chart's axes.
        box: West, east, south, north.
        unit: ``m``; ``metres`` if the axes are not east and north; empty without a scale.
    """
    axes.set_xlim(box[0], box[1])
    axes.set_ylim(box[2], box[3])
    axes.set_aspect("equal")
    placed = unit == "m"
    axes.set_xlabel("east (m)" if placed else f"x ({unit or 'model units'})")
    axes.set_ylabel("north (m)" if placed else f"y ({unit or 'model units'})")


def map_box(places: Float64[np.ndarray, "n 2"], margin: float = 0.15) -> tuple[float, float, float, float]:
    """West, east, south, north about some places, with a margin as a share of the longer side."""
    low, high = places.min(axis=0), places.max(axis=0)
    around = margin * float(max(high - low)) + 1e-6
    return float(low[0]) - around, float(high[0]) + around, float(low[1]) - around, float(high[1]) + around


def map_size(box: tuple[float, float, float, float], right: float = MARGINS[1]) -> tuple[float, float]:
    """Width and height, inches, of a map of that box: as wide as any chart, and not much higher.

    Args:
        box: West, east, south, north.
        right: The right margin, inches.
    """
    ratio = (box[3] - box[2]) / max(box[1] - box[0], 1e-9)
    left, _, bottom, top = MARGINS
    return WIDTH, float(np.clip((WIDTH - left - right) * ratio, 2.0, 4.8)) + bottom + top
