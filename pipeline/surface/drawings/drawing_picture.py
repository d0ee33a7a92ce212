"""A drawing as a PNG, for reports."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.surface.drawings.drawing import Drawing
from splatpipe.pipeline.surface.drawings.drawing_files import LAYERS, MARGIN_MM

DOTS_PER_INCH = 150  # resolution on paper: a page fills a screen
MM_AN_INCH, POINTS_A_MM = 25.4, 72.0 / 25.4
LETTER = 1.4  # a font's size over its capitals' height
DOT_MM = 0.6  # diameter of a point on paper
MIN_MM, MAX_MM = 60.0, 600.0  # shortest and longest side on paper, whatever is drawn
TEXT_ROOM_MM = 25.0  # for what is written below and at the left


def write_png_drawing(path: Path, drawing: Drawing) -> None:
    """Write a drawing as PNG at its plot scale, without its image.

    Raises:
        OSError: if the disk is full or not writable.
    """
    mm = drawing.scale / 1000.0
    low, high = drawing.box()
    low = low - (TEXT_ROOM_MM + MARGIN_MM) * mm
    high = high + MARGIN_MM * mm
    width, height = ((high - low) / mm).clip(MIN_MM, MAX_MM) / MM_AN_INCH
    figure = Figure(figsize=(width, height), dpi=DOTS_PER_INCH)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_axis_off()
    if drawing.dots is not None:
        colour = LAYERS[drawing.dots.layer][2]
        axes.plot(*drawing.dots.places.T, ".", color=colour, markersize=DOT_MM * POINTS_A_MM, markeredgewidth=0.0)
    for stroke in drawing.strokes:
        _, weight, colour = LAYERS[stroke.layer]
        line = stroke.line[[*range(len(stroke.line)), 0]] if stroke.closed else stroke.line
        if stroke.filled:
            axes.fill(*line.T, color=colour)
        axes.plot(*line.T, color=colour, linewidth=weight / 100.0 * POINTS_A_MM)
    sides = {"start": "left", "middle": "center", "end": "right"}
    for label in drawing.labels:
        size = label.size_mm * LETTER * POINTS_A_MM
        axes.text(label.right_m, label.up_m, label.text, fontsize=size, ha=sides[label.anchor], va="baseline")
    with whole_file(path) as aside:
        figure.savefig(aside, format="png", metadata={"Software": None})
