"""The report's charts: maps, registration, training, held-out photos. Each is an SVG element."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import BoundaryNorm, ListedColormap

from splatpipe.pipeline.app.report.charts.drawing import (
    BLUE,
    FAINT,
    GREEN,
    GREY,
    INK,
    LINE,
    ORANGE,
    RED,
    WIDTH,
    as_map,
    map_box,
    map_size,
    new_figure,
    to_svg,
)
from splatpipe.pipeline.app.report.charts.geometry import Geometry, OverlapGrid, ResidualField

MAX_POINTS = 20_000  # most points drawn of a cloud: more would add nothing at this size
MAX_PAIRS = 3_000  # lines, for the strongest pairs
OVERLAP_STEPS = (1, 2, 3, 4, 5, 7, 10)  # numbers of photos at which a new colour begins
OVERLAP_COLOURS = ("#cf222e", "#e8743b", "#f2b134", "#d9d557", "#8cc152", "#4aa564", "#1a6b3c")
ARROW_SHARE = 0.12  # length of the longest residual as a share of the map's width
MAX_PLANNED_TIMES = 4.0  # times the iterations reached: a planned end farther away would squash the curve
METRES_A_DEGREE = 111_195.0  # on a sphere: accurate enough for drawing
MAX_NAMES = 30  # points with their names on a map
Residual = tuple[str, Sequence[float], Sequence[float]]  # name, position and residual: east, north, up, metres


def survey_map(geometry: Geometry, unit: str, held_out: Sequence[str]) -> Markup:
    """Map of camera positions, viewing directions and footprints over the sparse points."""
    photos, box = geometry.photos, _with_cameras(geometry)
    figure, axes = new_figure(*map_size(box))
    _draw_points(axes, geometry)
    faint = min(0.03, 0.6 / len(photos.names))
    outlines = PolyCollection(list(photos.footprints), facecolor=(*_rgb(BLUE), faint), edgecolor=(*_rgb(BLUE), 0.18))
    outlines.set_linewidth(0.5)
    axes.add_collection(outlines)
    out = np.isin(np.array(photos.names, dtype=object), list(held_out))
    span = 0.035 * max(box[1] - box[0], box[3] - box[2])
    heads = photos.centres[:, :2] + span * photos.axes[:, :2]
    lines = list(np.stack([photos.centres[:, :2], heads], axis=1))
    axes.add_collection(LineCollection(lines, colors=INK, linewidths=0.7))
    for chosen, colour, label in ((~out, BLUE, "photo"), (out, ORANGE, "held-out photo")):
        if chosen.any():
            axes.plot(*photos.centres[chosen, :2].T, "o", ms=4, mfc=colour, mec="white", mew=0.5, label=label)
    axes.legend(loc="upper right", fontsize=8)
    as_map(axes, box, unit)
    return to_svg(figure, "Map of the photos' positions, viewing directions and footprints")


def stated_map(places: Sequence[tuple[float, float]]) -> Markup:
    """Map of the photos' stated positions, used before the cameras are estimated.

    Args:
        places: Latitude and longitude, degrees.
    """
    degrees = np.array(places, np.float64)
    north = METRES_A_DEGREE * (degrees[:, 0] - degrees[:, 0].mean())
    east = METRES_A_DEGREE * math.cos(math.radians(degrees[0, 0])) * (degrees[:, 1] - degrees[:, 1].mean())
    box = map_box(np.stack([east, north], axis=1))
    figure, axes = new_figure(*map_size(box))
    axes.plot(east, north, "o-", ms=4, mfc=BLUE, mec="white", mew=0.5, color=LINE, lw=0.8)
    as_map(axes, box, "m")
    return to_svg(figure, "Map of the positions in the photos' metadata")


def overlap_map(overlap: OverlapGrid, unit: str) -> Markup:
    """Map of the number of footprints that cover each place."""
    figure, axes = new_figure(*map_size(overlap.box), right=1.15)
    norm = BoundaryNorm([*OVERLAP_STEPS, 10_000], len(OVERLAP_COLOURS))
    covered_counts = np.ma.masked_equal(overlap.counts, 0)
    axes.imshow(
        covered_counts,
        extent=overlap.box,
        cmap=ListedColormap(OVERLAP_COLOURS),
        norm=norm,
        interpolation="nearest",
        zorder=1,
    )
    labels = ["1", "2", "3", "4", "5–6", "7–9", "10 or more"]
    for colour, label in zip(OVERLAP_COLOURS, labels, strict=True):
        axes.plot([], [], "s", ms=7, color=colour, label=label)
    axes.legend(title="photos", loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    as_map(axes, overlap.box, unit)
    return to_svg(figure, "Map of the number of photos that cover each place")


def match_map(geometry: Geometry, pairs: Sequence[tuple[str, str, int]], unit: str) -> Markup:
    """The verified pairs as lines between the photos, darker with more matches."""
    box = map_box(geometry.photos.centres[:, :2])
    figure, axes = new_figure(*map_size(box))
    places = dict(zip(geometry.photos.names, geometry.photos.centres[:, :2], strict=True))
    known = [pair for pair in pairs if pair[0] in places and pair[1] in places]
    strongest = sorted(known, key=lambda pair: -pair[2])[:MAX_PAIRS][::-1]
    lines = LineCollection([(places[a], places[b]) for a, b, _ in strongest], cmap="Blues", linewidths=0.9)
    lines.set_array(np.log10([max(1, pair[2]) for pair in strongest]))
    lines.set_clim(0.5, 3.0)
    axes.add_collection(lines)
    axes.plot(*geometry.photos.centres[:, :2].T, "o", ms=3.5, color=INK)
    for matches in (10, 100, 1000):
        colour = lines.cmap(lines.norm(np.log10(matches)))
        axes.plot([], [], "-", color=colour, lw=2.5, label=f"{matches:,} matches")
    axes.legend(loc="upper right", fontsize=8)
    as_map(axes, box, unit)
    return to_svg(figure, "Map of the pairs of photos that were matched")


def observations_bars(geometry: Geometry) -> Markup:
    """Bar chart of the sparse points observed per photo, in name order."""
    figure, axes = new_figure(WIDTH, 2.6)
    counts = geometry.photos.points
    axes.bar(np.arange(len(counts)) + 1, counts, width=0.85, color=np.where(counts < 100, RED, BLUE))
    axes.axhline(float(np.median(counts)), color=FAINT, lw=0.8, ls="--")
    axes.set_xlabel("photo, in name order")
    axes.set_ylabel("sparse points observed")
    return to_svg(figure, "Sparse points that each photo observes")


def track_histogram(geometry: Geometry) -> Markup:
    """Histogram of the sparse points' track lengths."""
    figure, axes = new_figure(WIDTH, 2.6)
    longest = int(np.clip(geometry.tracks.max(), 3, 20))
    lengths = np.clip(geometry.tracks, 2, longest)
    values, counts = np.unique(lengths, return_counts=True)
    axes.bar(values, counts, width=0.8, color=np.where(values < 3, ORANGE, BLUE))
    ticks = list(range(2, longest + 1, 1 if longest <= 12 else 2))
    more = int(geometry.tracks.max()) > longest
    axes.set_xticks(ticks, [f"{tick}{'+' if more and tick == longest else ''}" for tick in ticks])
    axes.set_xlabel("photos that observe a point (track length)")
    axes.set_ylabel("sparse points")
    return to_svg(figure, "Track lengths of the sparse points")


def error_histogram(geometry: Geometry) -> Markup:
    """Histogram of the sparse points' mean reprojection errors."""
    figure, axes = new_figure()
    errors = geometry.errors_px[np.isfinite(geometry.errors_px)]
    top = float(np.percentile(errors, 99.5)) if len(errors) else 1.0
    axes.hist(np.clip(errors, 0.0, top), bins=48, range=(0.0, max(top, 1e-6)), color=BLUE)
    if len(errors):
        axes.axvline(float(errors.mean()), color=ORANGE, lw=1.4, label=f"mean {errors.mean():.2f} px")
        axes.legend(fontsize=8)
    axes.set_xlabel("mean reprojection error of a point (pixels)")
    axes.set_ylabel("sparse points")
    return to_svg(figure, "Reprojection errors of the sparse points")


def residual_field(field: ResidualField, camera: int) -> Markup:
    """Mean residuals over the image: a pattern indicates that the lens model does not fit."""
    width, height = field.size
    figure, axes = new_figure(*map_size((0.0, float(width), 0.0, float(height))))
    largest = float(np.linalg.norm(field.residuals, axis=1).max())
    scale = max(largest, 1e-6) * 14.0 / width
    axes.quiver(
        *field.places.T, *field.residuals.T, angles="xy", scale_units="xy", scale=scale, color=BLUE, width=0.004
    )
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal")
    axes.set_title(f"longest arrow: {largest:.2f} pixels", fontsize=9, color=FAINT, loc="left")
    axes.set_xlabel("x in the picture (pixels)")
    axes.set_ylabel("y (pixels)")
    return to_svg(figure, f"Mean residuals over the pictures of camera {camera}")


def residual_map(geometry: Geometry, groups: Mapping[str, Sequence[Residual]]) -> Markup:
    """Map of residuals as exaggerated arrows.

    Args:
        geometry: The scene's geometry.
        groups: Residuals of points or photos, by kind.
    """
    every = [entry for entries in groups.values() for entry in entries]
    box = map_box(np.array([entry[1][:2] for entry in every], np.float64))
    figure, axes = new_figure(*map_size(box))
    _draw_points(axes, geometry)
    longest = max(math.hypot(*entry[2][:2]) for entry in every)
    scale = max(longest, 1e-9) / (ARROW_SHARE * (box[1] - box[0]))
    colours = {"control": BLUE, "check": ORANGE, "left out": RED, "photo": GREY}
    for kind, entries in groups.items():
        place = np.array([entry[1][:2] for entry in entries], np.float64)
        residual = np.array([entry[2][:2] for entry in entries], np.float64)
        colour = colours.get(kind, GREEN)
        axes.plot(*place.T, "o", ms=3.5, color=colour, label=kind)
        axes.quiver(*place.T, *residual.T, angles="xy", scale_units="xy", scale=scale, color=colour, width=0.004)
        if kind != "photo" and len(entries) <= MAX_NAMES:
            for (name, _, _), (x, y) in zip(entries, place, strict=True):
                axes.annotate(name[:16], (x, y), xytext=(3, 3), textcoords="offset points", fontsize=7, color=INK)
    axes.set_title(
        f"arrows {1 / scale:,.0f} times as long; the longest is {longest:.3f} m", fontsize=9, color=FAINT, loc="left"
    )
    axes.legend(loc="upper right", fontsize=8)
    as_map(axes, box, "m")
    return to_svg(figure, f"Residuals on the map: {', '.join(groups)}")


def training_curve(name: str, curve: Mapping[float, float], planned: float | None, log: bool) -> Markup:
    """A metric over the iterations, with the planned end if it was not reached."""
    figure, axes = new_figure(WIDTH, 2.8)
    steps = sorted(curve)
    axes.plot(steps, [curve[step] for step in steps], color=BLUE, lw=1.2)
    if log and min(curve.values()) > 0.0:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
    if planned and MAX_PLANNED_TIMES * steps[-1] >= planned > steps[-1]:
        axes.axvline(planned, color=ORANGE, lw=1.0, ls="--", label=f"planned end: {planned:,.0f}")
        axes.legend(fontsize=8)
    axes.set_xlim(left=0)
    axes.set_xlabel("iteration")
    axes.set_ylabel(name)
    return to_svg(figure, f"Training: {name}")


def view_bars(views: Sequence[tuple[str, float]], unit: str) -> Markup:
    """Bar chart of a metric for each held-out photo, worst first."""
    figure, axes = new_figure(WIDTH, 2.6)
    values = [value for _, value in views]
    axes.bar(np.arange(len(values)) + 1, values, width=0.8, color=BLUE)
    axes.axhline(float(np.mean(values)), color=ORANGE, lw=1.2, label=f"mean {np.mean(values):.2f} {unit}")
    axes.set_ylim(max(0.0, min(values) - 5.0), max(values) + 4.0)
    axes.set_xlabel("held-out photo, the worst first")
    axes.set_ylabel(f"PSNR ({unit})")
    axes.legend(fontsize=8, loc="upper left")
    return to_svg(figure, "PSNR of the held-out photos")


def _draw_points(axes: Axes, geometry: Geometry) -> None:
    chosen = np.linspace(0, len(geometry.points) - 1, min(MAX_POINTS, len(geometry.points))).astype(int)
    colours = geometry.colours[chosen] / 255.0
    east, north = geometry.points[chosen, :2].T
    axes.scatter(east, north, s=0.6, c=colours, linewidths=0, rasterized=True, zorder=0)


def _with_cameras(geometry: Geometry) -> tuple[float, float, float, float]:
    west, east, south, north = geometry.box
    low, high = geometry.photos.centres[:, :2].min(axis=0), geometry.photos.centres[:, :2].max(axis=0)
    margin = 0.06 * float(max(high - low))
    return (
        min(west, float(low[0]) - margin),
        max(east, float(high[0]) + margin),
        min(south, float(low[1]) - margin),
        max(north, float(high[1]) + margin),
    )


def _rgb(colour: str) -> tuple[float, float, float]:
    return int(colour[1:3], 16) / 255.0, int(colour[3:5], 16) / 255.0, int(colour[5:7], 16) / 255.0
