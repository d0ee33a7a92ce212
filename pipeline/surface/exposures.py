"""Radiometric balancing of photos: exposure and shading, levelled where several see the same.

Lenses darken corners (vignetting), and fields look brighter away from the sun: unless shading is levelled, each photo's
part of an orthophoto is a visible patch.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse.linalg import LinearOperator, cg

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.photo_gains import SHADES, PhotoGains, across
from splatpipe.pipeline.surface.photo_samples import PLAIN_TONE, PhotoSource, linear, loaded, sampled
from splatpipe.pipeline.surface.point_visibility import Points, place_in, sight

COMPARED_AT = 4000  # places that photos' exposures are compared at: their number is no matter of a capture's size
MAX_GAIN = 2.0  # and one over it: more is not exposure
MAX_SHADE = 0.5  # of a term's logarithm of light
DARKEST, LIGHTEST = 8, 247  # values that are not cut off
REST = 3.0  # places' worth with which a photo keeps to its own exposure,
REST_SHADE = 10.0  # and to the shading that all photos have: corners say more of a term than the middle
REST_ALL = 0.01  # times as much for what all have in common
STRANGE = 0.15  # logarithm of light by which a photo may differ from the others; further off counts less
ROUNDS = 4
TOLERANCE = 1e-10  # of the equations' right side
DIGITS = 5  # of gains: what sums do otherwise for another number of threads lies far below

Numbers = Int64[np.ndarray, " k"]


def exposure_levels(
    sources: Sequence[PhotoSource], places: Float64[np.ndarray, "m 3"], cell_m: float, threads: int
) -> PhotoGains:
    """Estimate gains by which to multiply each photo's light so that photos agree where they see the same.

    Robust least squares of the logarithms (Huber weights) over points that at least two photos see, relative to the
    mean of all; bounded.

    Args:
        sources: The photos.
        places: A few thousand evenly spaced points on the surface, in their cameras' frame.
        cell_m: Resolution of the comparison, metres; slightly coarser than the product, as alignment is not exact.
        threads: Photos in parallel.
    """
    if not sources:
        return PhotoGains.plain(0)
    rows = list(ordered_map(partial(_light, places, cell_m), sources, threads))
    photo = np.repeat(np.arange(len(rows)), [len(there) for there, _, _ in rows])
    place, light, shades = (np.concatenate(column) for column in zip(*rows, strict=True))
    shared = np.bincount(place, minlength=len(places))[place] >= 2
    if not shared.any():
        return PhotoGains.plain(len(sources))
    photo, place, light = photo[shared], place[shared], light[shared]
    terms = np.column_stack([np.ones(len(photo)), shades[shared]])
    rest = np.array([REST, *([REST_SHADE] * SHADES)])
    numbers = photo.astype(np.int64), place.astype(np.int64)
    factors = np.stack([_levelled(each, terms, rest, numbers, len(sources)) for each in light.T], axis=-1)
    gain = np.clip(np.exp(factors[:, 0]), 1.0 / MAX_GAIN, MAX_GAIN)
    shading = np.clip(factors[:, 1:], -MAX_SHADE, MAX_SHADE)
    return PhotoGains(np.round(gain, DIGITS), np.round(shading, DIGITS))


def _light(
    places: Float64[np.ndarray, "m 3"], cell_m: float, source: PhotoSource
) -> tuple[Numbers, Float64[np.ndarray, "k 3"], Float64[np.ndarray, "k t"]]:
    """Points that a photo sees well, the logarithms of its light there, and the shading terms at their pixels."""
    unseen = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, SHADES))
    points: Points = (places[:, 0], places[:, 1], places[:, 2])
    place = place_in(source.camera, *points)
    if source.depths is None or not place.inside.any():
        return unseen
    view = sight(source.depths.load(), points, 0.0)
    seen = view.seen & ~view.mixed & place.inside
    if not seen.any():
        return unseen
    pixels, _ = loaded(source)
    colour = sampled(source, pixels, points, seen, cell_m, PLAIN_TONE)
    good = np.flatnonzero(seen & (colour >= DARKEST).all(axis=1) & (colour <= LIGHTEST).all(axis=1))
    terms = across(source.camera, place.column[good], place.row[good]).T
    return good, np.log(linear(colour[good] / 255.0)), terms


def _levelled(
    light: Float64[np.ndarray, " k"],
    terms: Float64[np.ndarray, "k t"],
    rest: Float64[np.ndarray, " t"],
    numbers: tuple[Numbers, Numbers],
    photos: int,
) -> Float64[np.ndarray, "n t"]:
    """Corrections to the logarithms of a channel's light: for each photo a factor per term.

    Args:
        light: Logarithm of light for each observation of a point in a photo.
        terms: Shading terms of each observation; the first is one.
        rest: Strength with which each factor is held at the average.
        numbers: Photo and point of each observation.
        photos: Number of photos.
    """
    photo, place = numbers
    found, weight = np.zeros((photos, terms.shape[1])), np.ones(len(light))

    def about_mean(value: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " k"]:
        total = np.bincount(place, weight)
        mean = np.bincount(place, weight * value) / np.maximum(total, 1e-9)
        return np.asarray(value - mean[place])

    def gathered(value: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "n t"]:
        each = (np.bincount(photo, weight * value * term, photos) for term in terms.T)
        return np.stack(list(each), axis=-1)

    def equations(flat: Float64[np.ndarray, " u"]) -> Float64[np.ndarray, " u"]:
        factors = flat.reshape(found.shape)
        kept = rest * (factors - (1.0 - REST_ALL) * factors.mean(axis=0))
        return np.asarray((gathered(about_mean((terms * factors[photo]).sum(axis=1))) + kept).ravel())

    for _ in range(ROUNDS):
        operator = LinearOperator((found.size, found.size), matvec=equations, dtype=np.float64)
        solution, _ = cg(operator, -gathered(about_mean(light)).ravel(), x0=found.ravel(), rtol=TOLERANCE)
        found = solution.reshape(found.shape)
        off = np.abs(about_mean(light + (terms * found[photo]).sum(axis=1)))
        weight = np.minimum(1.0, STRANGE / np.maximum(off, 1e-9))
    heard = np.bincount(photo, minlength=photos) > 0
    if heard.any():
        found[:, 0] -= found[heard, 0].mean()
    return np.asarray(np.where(heard[:, None], found, 0.0))
