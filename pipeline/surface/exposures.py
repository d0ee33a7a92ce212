"""Exposures of photos, levelled where several see the same."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.photo_samples import PLAIN_TONE, PhotoSource, linear, loaded, sampled
from splatpipe.pipeline.surface.sight import Points, place_in, sight

COMPARED_AT = 4000  # places that all photos together are compared at: no matter of a capture's size
MOST_GAIN = 2.0  # and one over it: more is not exposure
DARKEST, LIGHTEST = 8, 247  # values that are not cut off
REST = 3.0  # places' worth with which a photo keeps to its own exposure
STRANGE = 0.15  # logarithm of light by which a photo may differ from the others; further off counts less
ROUNDS = 4
DIGITS = 5  # of gains: what solvers do otherwise for another number of threads lies far below


def exposure_gains(
    sources: Sequence[PhotoSource], places: Float64[np.ndarray, "m 3"], cell_m: float, threads: int
) -> Float64[np.ndarray, "n 3"]:
    """By how much each photo's light is to be multiplied so that photos agree where they see the same.

    Least squares of the logarithms over places that two photos see at least, robust (Huber's weights), about the mean
    of all; bounded.

    Args:
        sources: The photos.
        places: On the surface, in their cameras' frame: some thousand, evenly.
        cell_m: How fine photos are compared; a little softer than what is coloured, matches need not be exact.
        threads: Photos at a time.
    """
    rows = list(ordered_map(partial(_light, places, cell_m), sources, threads))
    light = np.stack([row for row, _ in rows]) if rows else np.zeros((0, 0, 3))
    seen = np.stack([there for _, there in rows]) if rows else np.zeros((0, 0), np.bool_)
    gains = [_levelled(light[..., channel], seen) for channel in range(3)]
    return np.asarray(np.round(np.clip(np.exp(np.stack(gains, axis=-1)), 1.0 / MOST_GAIN, MOST_GAIN), DIGITS))


def _light(
    places: Float64[np.ndarray, "m 3"], cell_m: float, source: PhotoSource
) -> tuple[Float64[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Logarithms of the light in a photo at places, and where it sees them well."""
    unseen = np.zeros((len(places), 3)), np.zeros(len(places), np.bool_)
    points: Points = (places[:, 0], places[:, 1], places[:, 2])
    inside = place_in(source.camera, *points).inside
    if source.depths is None or not inside.any():
        return unseen
    view = sight(source.depths.load(), points, 0.0)
    seen = view.seen & ~view.mixed & inside
    if not seen.any():
        return unseen
    pixels, _ = loaded(source)
    colour = sampled(source, pixels, points, seen, cell_m, PLAIN_TONE)
    good = seen & (colour >= DARKEST).all(axis=1) & (colour <= LIGHTEST).all(axis=1)
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
