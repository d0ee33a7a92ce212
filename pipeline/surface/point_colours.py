"""Colours of points from all photos that see them, the finest ones before all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from splatpipe.pipeline.surface.photo_samples import halvings, loader, sampled, tone_curve
from splatpipe.pipeline.surface.photo_set import Facing, PhotoSet, look_at
from splatpipe.pipeline.surface.sight import Place

COARSE = 4  # power of the footprint that a photo's weight falls with: one half as fine counts a sixteenth
MIXED = 0.01  # weight where a nearer surface lies in the next pixel of the depths: its colour may be mixed in
COLUMNS = 256  # of the picture that points are sampled as: OpenCV's are no longer than 32,767


def point_colours(
    photos: PhotoSet, numbers: Sequence[int], pieces: Facing, cell_m: float
) -> tuple[UInt8[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """The mean colour of points in the photos that see them, and which are seen at all; black where not.

    Args:
        photos: With their depths.
        numbers: Of those to ask.
        pieces: The points.
        cell_m: Side of the area whose colour a point has.
    """
    size = pieces.xyz.shape[1]
    total, weights = np.zeros((size, 3)), np.zeros(size)
    for number in numbers:
        rows, weight = _seen(photos, number, pieces)
        if rows.size:
            colour = _sampled(photos, number, pieces.xyz[:, rows], cell_m)
            total[rows] += weight[:, None] * colour
            weights[rows] += weight
    known = weights > 0.0
    mean = total / np.where(known, weights, 1.0)[:, None]
    return np.clip(np.round(mean), 0, 255).astype(np.uint8), known


def _seen(photos: PhotoSet, number: int, pieces: Facing) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Rows of the points that a photo sees, and how much its colours count."""
    found = photos.depth_map(number)
    look = look_at(found.camera, pieces)
    facing = np.isfinite(look.footprint)
    rows, look = np.flatnonzero(facing), look.select(facing)
    sight = look.sight(found)
    weight = np.where(sight.seen, np.where(sight.mixed, MIXED, 1.0), 0.0) / look.footprint**COARSE
    whole = look_at(photos.sources[number].camera, pieces.select(rows)).place.inside
    kept = np.flatnonzero((weight > 0.0) & whole)
    return rows[kept], weight[kept]


def _sampled(
    photos: PhotoSet, number: int, xyz: Float64[np.ndarray, "3 k"], cell_m: float
) -> Float64[np.ndarray, "k 3"]:
    """Colours in a photo at places within it."""
    source = photos.sources[number]
    size = xyz.shape[1]
    shape = (-(-size // COLUMNS), COLUMNS)
    padded = np.pad(xyz, ((0, 0), (0, shape[0] * shape[1] - size)), mode="edge").reshape(3, *shape)
    flat = Facing(padded.reshape(3, -1), np.zeros((3, padded[0].size)))
    place = look_at(source.camera, flat).place
    place = Place(*(part.reshape(shape) for part in (place.column, place.row, place.depth, place.sine, place.inside)))
    pixels = photos.pixels.get(number, loader(source))
    level = halvings(source.camera, place, cell_m)
    colour = sampled(pixels, place, level, tone_curve(photos.gains[number]))
    return np.asarray(colour.reshape(-1, 3)[:size], np.float64)
