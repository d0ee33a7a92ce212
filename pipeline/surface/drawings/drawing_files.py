"""Drawings as DXF for CAD, and as SVG for general use.

DXF files have the AutoCAD 2000 format, in metres at true size, with an image as a reference to the file beside it. SVG
files have the paper's size, in millimetres, with the image embedded: programs that show an SVG as an image do not load
other files.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from splatpipe.pipeline.engine.files.durable import whole_file, write_durably
from splatpipe.pipeline.surface.drawings.drawing import (
    EXTENT,
    GRID,
    GROUND,
    OPENINGS,
    OUTLINE,
    PICTURE,
    POINTS,
    PROJECTIONS,
    SURFACE,
    TEXTS,
    Drawing,
    Stroke,
)
from splatpipe.pipeline.surface.drawings.dxf import alignment, new_document

if TYPE_CHECKING:
    from ezdxf.document import Drawing as DxfDocument

DXF_VERSION = "R2000"  # the oldest with drawing units and images, so most programs read it
METRES = 6  # value of $INSUNITS
DIGITS = 4  # decimals of coordinates in metres: a tenth of a millimetre
MARGIN_MM = 10.0  # around an SVG, with room for texts that extend beyond lines
MAX_EMBEDDED = 4096  # largest side of an image in an SVG, pixels; larger images are reduced
JPEG_QUALITY = 92
# AutoCAD's colour, hundredths of a millimetre, and the SVG's colour of each layer.
LAYERS = {
    PICTURE: (7, 0, "none"),
    GRID: (8, 9, "#b0b0b0"),
    EXTENT: (8, 13, "#808080"),
    OUTLINE: (7, 35, "#000000"),
    OPENINGS: (5, 25, "#0040c0"),
    PROJECTIONS: (30, 25, "#c06000"),
    POINTS: (5, 0, "#3060d0"),
    SURFACE: (7, 35, "#000000"),
    GROUND: (32, 25, "#a0602a"),
    TEXTS: (7, 18, "#000000"),
}
ANCHORS: Mapping[str, Literal["LEFT", "CENTER", "RIGHT"]] = {"start": "LEFT", "middle": "CENTER", "end": "RIGHT"}


def write_dxf_drawing(path: Path, drawing: Drawing) -> None:
    """Write a drawing as DXF; its image has to be in the same folder.

    Raises:
        OSError: if the disk is full or not writable.
    """
    mm = drawing.scale / 1000.0
    with new_document(DXF_VERSION, METRES) as document:
        document.header["$MEASUREMENT"] = 1
        for name in sorted(_layers_of(drawing)):
            colour, weight, _ = LAYERS[name]
            document.layers.add(name, color=colour, lineweight=weight)
        model = document.modelspace()
        _attach_picture(document, drawing)
        for stroke in drawing.strokes:
            line = np.round(stroke.line, DIGITS).tolist()
            model.add_lwpolyline(line, close=stroke.closed, dxfattribs={"layer": stroke.layer})
            if stroke.filled:
                a, b, c, d = line
                model.add_solid([a, b, d, c], dxfattribs={"layer": stroke.layer})
        if drawing.dots is not None:
            for place in np.round(drawing.dots.places, DIGITS).tolist():
                model.add_point(place, dxfattribs={"layer": drawing.dots.layer})
        for label in drawing.labels:
            text = model.add_text(label.text, height=label.size_mm * mm, dxfattribs={"layer": TEXTS})
            text.set_placement((label.right_m, label.up_m), align=alignment(ANCHORS[label.anchor]))
        low, high = drawing.box()
        model.reset_extents((*low.tolist(), 0.0), (*high.tolist(), 0.0))
        with whole_file(path) as aside:
            document.saveas(aside)


def _layers_of(drawing: Drawing) -> set[str]:
    dots = set() if drawing.dots is None else {drawing.dots.layer}
    picture = set() if drawing.picture is None else {PICTURE}
    return {stroke.layer for stroke in drawing.strokes} | dots | picture | {TEXTS}


def _attach_picture(document: DxfDocument, drawing: Drawing) -> None:
    placed = drawing.picture
    if placed is None:
        return
    definition = document.add_image_def(placed.file, placed.pixels)
    image = document.modelspace().add_image(
        definition,
        insert=(placed.left_m, placed.bottom_m),
        size_in_units=(placed.width_m, placed.height_m),
        dxfattribs={"layer": PICTURE},
    )
    image.transparency = 0.0
    document.set_raster_variables(frame=0, quality=1, units="m")


def write_svg_drawing(path: Path, drawing: Drawing, colours: UInt8[np.ndarray, "h w 4"] | None, title: str) -> None:
    """Write a drawing as SVG, in millimetres of paper.

    Args:
        path: Output file.
        drawing: The drawing.
        colours: Its image, transparent where the last channel is 0; None without one.
        title: Title in the file.

    Raises:
        OSError: if the disk is full or not writable.
    """
    mm = drawing.scale / 1000.0
    low, high = drawing.box()
    bottom = min(low[1], *(label.up_m - label.size_mm * mm for label in drawing.labels))
    top = max(high[1], *(label.up_m + label.size_mm * mm for label in drawing.labels))
    corner = np.array([low[0] - MARGIN_MM * mm, top + MARGIN_MM * mm])
    width = (high[0] - low[0]) / mm + 2.0 * MARGIN_MM
    height = (top - bottom) / mm + 2.0 * MARGIN_MM

    def paper(places: np.ndarray) -> np.ndarray:
        return np.asarray((places - corner) * [1.0, -1.0] / mm)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.2f}mm" height="{height:.2f}mm"'
        f' viewBox="0 0 {width:.2f} {height:.2f}">',
        f"<title>{escape(title)}</title>",
        '<rect width="100%" height="100%" fill="#ffffff"/>',
    ]
    placed = drawing.picture
    if placed is not None and colours is not None:
        x, y = paper(np.array([placed.left_m, placed.bottom_m + placed.height_m]))
        parts.append(
            f'<image x="{x:.3f}" y="{y:.3f}" width="{placed.width_m / mm:.3f}" height="{placed.height_m / mm:.3f}"'
            f' preserveAspectRatio="none" href="{_embedded(colours)}"/>'
        )
    if drawing.dots is not None:
        paths = "".join(f"M{x:.2f} {y:.2f}h0" for x, y in paper(drawing.dots.places).tolist())
        colour = LAYERS[drawing.dots.layer][2]
        parts.append(f'<path d="{paths}" stroke="{colour}" stroke-width="0.4" stroke-linecap="round"/>')
    parts += [_svg_path(stroke, paper(stroke.line)) for stroke in drawing.strokes]
    for label in drawing.labels:
        x, y = paper(np.array([label.right_m, label.up_m]))
        parts.append(
            f'<text x="{x:.2f}" y="{y:.2f}" font-family="sans-serif" font-size="{label.size_mm * 1.4:.2f}"'
            f' text-anchor="{label.anchor}">{escape(label.text)}</text>'
        )
    write_durably(path, "\n".join([*parts, "</svg>\n"]))


def _svg_path(stroke: Stroke, line: np.ndarray) -> str:
    _, weight, colour = LAYERS[stroke.layer]
    points = "L".join(f"{x:.3f} {y:.3f}" for x, y in line.tolist())
    fill = colour if stroke.filled else "none"
    end = "Z" if stroke.closed else ""
    return f'<path d="M{points}{end}" fill="{fill}" stroke="{colour}" stroke-width="{weight / 100.0}"/>'


def _embedded(colours: UInt8[np.ndarray, "h w 4"]) -> str:
    """An image as a data URL: JPEG on white, a fifth of a PNG's size."""
    flat = Image.fromarray(np.where(colours[..., 3:] > 0, colours[..., :3], np.uint8(255)))
    flat.thumbnail((MAX_EMBEDDED, MAX_EMBEDDED))
    kept = io.BytesIO()
    flat.save(kept, "JPEG", quality=JPEG_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(kept.getvalue()).decode("ascii")
