"""Exposures of photos, levelled where several see the same."""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.height_field import HeightField
from splatpipe.pipeline.surface.orthophoto import Album, view_of
from splatpipe.pipeline.surface.photo_samples import PLAIN_TONE, halvings, linear, loader, sampled
from splatpipe.pipeline.surface.sight import place_in

SAMPLES = 4000  # places that photos are compared at: their number is no matter of a capture's size
MOST_GAIN = 2.0  # and one over it: more is not exposure
DARKEST, LIGHTEST = 8, 247  # values that are not cut off
REST = 3.0  # places' worth with which a photo keeps to its own exposure
STRANGE = 0.15  # logarithm of light by which a photo may differ from the others; further off counts less
ROUNDS = 4
DIGITS = 5  # of gains: what solvers do otherwise for another number of threads lies far below


def exposure_gains(album: Album, threads: int) -> Float64[np.ndarray, "n 3"]:
    """By how much each photo's light is to be multiplied so that photos agree where they see the same.

    Least squares of the logarithms over places that two photos see at least, robust (Huber's weights), about the mean
    of all; bounded.

    Args:
        album: Its own gains are not used.
        threads: Photos at a time.
    """
    points = _places(album.surface)
    cell_m = album.surface.lattice.cell_m * 2.0  # a little softer than what is coloured: matches need not be exact
    numbers = range(len(album.sources))
    rows = list(ordered_map(partial(_light, album, points, cell_m), numbers, threads))
    light = np.stack([row for row, _ in rows]) if rows else np.zeros((0, 0, 3))
    seen = np.stack([there for _, there in rows]) if rows else np.zeros((0, 0), np.bool_)
    gains = [_levelled(light[..., channel], seen) for channel in range(3)]
    return np.asarray(np.round(np.clip(np.exp(np.stack(gains, axis=-1)), 1.0 / MOST_GAIN, MOST_GAIN), DIGITS))


def _places(surface: HeightField) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Some of the surface's cells, evenly; (1, n) each."""
    height, width = surface.height.shape
    step = max(1, round((height * width / SAMPLES) ** 0.5))
    row, column = (grid.ravel() for grid in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    up = surface.height[row, column].astype(np.float64)
    known = np.isfinite(up)
    lattice = surface.lattice
    east = lattice.east_m + (column[known] + 0.5) * lattice.cell_m
    north = lattice.north_m - (row[known] + 0.5) * lattice.cell_m
    return east[None], north[None], up[known][None]


def _light(
    album: Album, points: tuple[np.ndarray, np.ndarray, np.ndarray], cell_m: float, number: int
) -> tuple[Float64[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Logarithms of the light in a photo at places, and where it sees them well."""
    source = album.sources[number]
    size = points[0].shape[1]
    if source.depths is None or not size:
        return np.zeros((size, 3)), np.zeros(size, np.bool_)
    place = place_in(source.camera, *points)
    view = view_of(source.depths, album.depths, number, points)
    seen = view.seen & ~view.mixed & place.inside
    if not seen.any():
        return np.zeros((size, 3)), np.zeros(size, np.bool_)
    pixels = album.pixels.get(number, loader(source))
    colour = sampled(pixels, place, halvings(source.camera, place, cell_m), PLAIN_TONE)[0]
    good = seen[0] & (colour >= DARKEST).all(axis=1) & (colour <= LIGHTEST).all(axis=1)
    return np.log(linear(np.maximum(colour, DARKEST) / 255.0)), good


def _levelled(light: Float64[np.ndarray, "n m"], seen: Bool[np.ndarray, "n m"]) -> Float64[np.ndarray, " n"]:
    """Logarithms of the gains of one channel."""
    seen = seen & (seen.sum(axis=0) >= 2)
    gain = np.zeros(len(light))
    weight = seen.astype(np.float64)
    for _ in range(ROUNDS):
        total = np.maximum(weight.sum(axis=0), 1e-9)
        share = weight / total
        # Normal equations of sum w (light + gain - mean of the place)², the places' means eliminated.
        matrix = np.diag(weight.sum(axis=1) + REST) - np.einsum("im,jm->ij", weight, share)
        mean = (share * light).sum(axis=0)
        gain = np.linalg.solve(matrix, (weight * (mean - light)).sum(axis=1))
        level = (share * (light + gain[:, None])).sum(axis=0)
        off = np.abs(light + gain[:, None] - level)
        weight = np.where(seen, np.minimum(1.0, STRANGE / np.maximum(off, 1e-9)), 0.0)
    heard = seen.any(axis=1)
    return np.where(heard, gain - gain[heard].mean() if heard.any() else 0.0, 0.0)
