"""Charts of the adjustment to camera positions: residuals on the map and along each flight, accuracy of heights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from splatpipe.pipeline.app.report.charts.drawing import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    LINE,
    ORANGE,
    WIDTH,
    as_map,
    map_box,
    map_size,
    new_figure,
    new_rows,
    to_svg,
)
from splatpipe.pipeline.app.report.facts.adjustment_results import PositionResidual

ARROW_SHARE = 0.12  # length of the longest residual as a share of the map's width
SCALE_MARGIN = 0.95  # inches for a colour scale
MANY_DOTS = 300  # dots from which they are drawn as an image: smaller than as shapes
NORMAL_95 = 1.959964
SPREAD = (2.0, 98.0)  # percentiles of the heights' accuracy between which colours run
MIN_SPREAD_SHARE = 0.1  # least range of the colours over its middle: smaller differences do not deserve all colours
TURN_DEG = 45.0  # change of direction from which a strip ends
MIN_STRIP = 3  # photos


def positions_map(entries: Sequence[PositionResidual], places: Sequence[Sequence[float]]) -> Markup:
    """Map of the camera positions' residuals: arrows for the horizontal part, colours for the height.

    Args:
        entries: The residuals, in the order of capture.
        places: The camera's place of each: east, north, up in metres.
    """
    at = np.array(places, np.float64)[:, :2]
    residuals = np.array([entry.residual_m for entry in entries], np.float64)
    box = map_box(at)
    figure, axes = new_figure(*map_size(box, SCALE_MARGIN), right=SCALE_MARGIN)
    for flight in sorted({entry.flight for entry in entries}):
        own = np.array([entry.flight == flight for entry in entries])
        axes.plot(*at[own].T, "-", color=LINE, lw=0.9, zorder=1)
    longest = float(np.linalg.norm(residuals[:, :2], axis=1).max())
    scale = max(longest, 1e-9) / (ARROW_SHARE * (box[1] - box[0]))
    many = len(entries) > MANY_DOTS
    axes.quiver(
        *at.T,
        *residuals[:, :2].T,
        angles="xy",
        scale_units="xy",
        scale=scale,
        color=INK,
        width=0.004,
        zorder=3,
        rasterized=many,
    )
    largest = max(float(np.abs(residuals[:, 2]).max()), 1e-6)
    colours = ScalarMappable(Normalize(-100.0 * largest, 100.0 * largest), "RdBu_r")
    size = 26.0 if len(entries) <= 100 else 12.0
    axes.scatter(
        at[:, 0],
        at[:, 1],
        s=size,
        c=colours.to_rgba(100.0 * residuals[:, 2]),
        edgecolors=FAINT,
        linewidths=0.5,
        zorder=2,
        rasterized=many,
    )
    axes.set_title(
        f"arrows {_times(1.0 / scale)} times as long; the longest is {_centimetres(longest)}",
        fontsize=9,
        color=FAINT,
        loc="left",
    )
    as_map(axes, box, "m")
    _colour_scale(figure, axes, colours, "height residual (cm)")
    return to_svg(figure, "Residuals of the camera positions on the map")


def flight_lines(flight: int, entries: Sequence[PositionResidual], places: Sequence[Sequence[float]]) -> Markup:
    """A flight's residuals east, north and up in the order of capture, with the ends of its strips.

    Args:
        flight: Its number, from 0.
        entries: Its residuals.
        places: The camera's place of each: east, north, up in metres.
    """
    residuals = 100.0 * np.array([entry.residual_m for entry in entries], np.float64)
    figure, rows = new_rows(3, WIDTH, 3.9)
    largest = 1.15 * max(float(np.abs(residuals).max()), 0.1)
    numbers = np.arange(len(entries)) + 1
    mark = "o" if len(entries) <= 100 else ""
    ends = strip_ends(np.array(places, np.float64)[:, :2])
    for axes, values, name, colour in zip(
        rows, residuals.T, ("east", "north", "up"), (BLUE, GREEN, ORANGE), strict=True
    ):
        axes.axhline(0.0, color=FAINT, lw=0.8)
        for end in ends:
            axes.axvline(end, color=LINE, lw=1.0)
        axes.plot(numbers, values, "-", marker=mark, ms=2.8, color=colour, lw=1.1)
        axes.set_ylim(-largest, largest)
        axes.set_xlim(0.5, len(entries) + 0.5)
        axes.set_ylabel(f"{name} (cm)")
        axes.grid(visible=False, axis="x")
        rms = math.sqrt(float((values**2).mean()))
        axes.set_title(f"RMS {_centimetres(rms / 100.0)}", fontsize=8, color=FAINT, loc="right", pad=2.0)
        axes.tick_params(labelbottom=axes is rows[-1])
    rows[-1].set_xlabel("position, in the order of capture")
    return to_svg(figure, f"Residuals of the camera positions of flight {flight + 1}")


def heights_map(
    points: Sequence[tuple[float, float, float]],
    control: Sequence[tuple[float, float, float]],
    cameras: Sequence[Sequence[float]],
) -> Markup:
    """Map of the accuracy of the ground's heights, and of the places proposed for control points.

    Args:
        points: East, north and standard deviation of the height, metres.
        control: East, north, up of the places proposed.
        cameras: East, north, up of the cameras.
    """
    table = np.array(points, np.float64)
    proposed = np.array(control, np.float64).reshape(-1, 3)
    centres = np.array(cameras, np.float64)[:, :2]
    box = map_box(np.concatenate([table[:, :2], proposed[:, :2], centres]), 0.06)
    figure, axes = new_figure(*map_size(box, SCALE_MARGIN), right=SCALE_MARGIN)
    bounds = 100.0 * NORMAL_95 * table[:, 2]
    low, high = np.percentile(bounds, SPREAD).tolist()
    lacking = max(0.0, MIN_SPREAD_SHARE * 0.5 * (low + high) - (high - low))
    colours = ScalarMappable(Normalize(max(0.0, low - 0.5 * lacking), high + 0.5 * lacking), "viridis_r")
    axes.plot(*centres.T, "+", ms=4, color=FAINT, mew=0.6, zorder=1, label="camera")
    axes.scatter(
        table[:, 0],
        table[:, 1],
        s=14.0,
        c=colours.to_rgba(bounds),
        linewidths=0,
        zorder=2,
        rasterized=len(table) > MANY_DOTS,
    )
    if len(proposed):
        axes.plot(*proposed[:, :2].T, "^", ms=9, mfc=ORANGE, mec="white", mew=0.8, zorder=4, label="proposed control")
        for k, (east, north, _) in enumerate(proposed.tolist(), start=1):
            axes.annotate(
                str(k),
                (east, north),
                xytext=(6, 3),
                textcoords="offset points",
                fontsize=10,
                fontweight="bold",
                color=INK,
                zorder=5,
            )
    as_map(axes, box, "m")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8, borderaxespad=0.2)
    _colour_scale(figure, axes, colours, "height, ± (cm), 95 %", extend="both")
    return to_svg(figure, "Accuracy of the ground's heights on the map")


def strip_ends(places: Float64[np.ndarray, "n 2"]) -> list[float]:
    """Where a flight's strips end, as numbers between those of its photos, which count from 1.

    Args:
        places: East and north of its photos in the order of capture.
    """
    steps = np.diff(places, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    straight = [True] + [
        float(steps[k - 1] @ steps[k]) >= math.cos(math.radians(TURN_DEG)) * float(lengths[k - 1] * lengths[k])
        for k in range(1, len(steps))
    ]
    starts = [k for k, same in enumerate(straight) if not same or k == 0]
    runs = [(a, b) for a, b in zip(starts, [*starts[1:], len(steps)], strict=True) if b - a >= MIN_STRIP - 1]
    return [0.5 * (last + first) + 1.0 for (_, last), (first, _) in pairwise(runs)]


def _colour_scale(figure: Figure, axes: Axes, colours: ScalarMappable, label: str, extend: str = "neither") -> None:
    """A colour scale as high as a map, to its right."""
    bar = figure.colorbar(colours, cax=axes.inset_axes((1.03, 0.0, 0.04, 1.0)), extend=extend)
    bar.set_label(label)
    bar.outline.set_visible(False)


def _times(factor: float) -> str:
    """An enlargement, to two digits."""
    if factor < 1.0:
        return f"{factor:.2g}"
    step = 10 ** max(0, math.floor(math.log10(factor)) - 1)
    return f"{step * round(factor / step):,.0f}"


def _centimetres(length_m: float) -> str:
    return f"{100.0 * length_m:.1f} cm"
