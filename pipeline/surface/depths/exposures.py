"""Radiometric balancing of photos: exposure and shading, levelled where several photos see the same points.

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
from splatpipe.pipeline.geometry.robust import huber_weights
from splatpipe.pipeline.surface.depths.photo_gains import SHADING_TERMS, PhotoGains, shading_terms
from splatpipe.pipeline.surface.depths.photo_samples import (
    PLAIN_TONE,
    PhotoSource,
    linear_light,
    load_pixels,
    sample_colours,
)
from splatpipe.pipeline.surface.depths.point_visibility import Points, classify_points, project_points

COMPARED_POINTS = 4000  # at which exposures are compared, whatever the size of the capture
MAX_GAIN = 2.0  # and at least its inverse: more is not a difference in exposure
MAX_SHADE = 0.5  # largest coefficient of a shading term, as a logarithm of light
MIN_VALUE, MAX_VALUE = 8, 247  # values that are not clipped
PRIOR = 3.0  # weight, in points, that holds each photo at its own exposure,
PRIOR_SHADING = 10.0  # and at the shading of all photos: corners determine a term better than the middle
PRIOR_COMMON = 0.01  # times that weight for what all photos have in common
HUBER = 0.15  # logarithm of light: larger differences between photos are weighted down
ROUNDS = 4
TOLERANCE = 1e-10  # relative to the right-hand side of the equations
DIGITS = 5  # decimals of gains: sums vary with the number of threads, but by much less

Numbers = Int64[np.ndarray, " k"]


def exposure_levels(
    sources: Sequence[PhotoSource], places: Float64[np.ndarray, "m 3"], cell_m: float, threads: int
) -> PhotoGains:
    """Estimate gains by which to multiply each photo's light so that photos agree where they see the same points.

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
    rows = list(ordered_map(partial(_measure_light, places, cell_m), sources, threads))
    photo = np.repeat(np.arange(len(rows)), [len(there) for there, _, _ in rows])
    place, light, shades = (np.concatenate(column) for column in zip(*rows, strict=True))
    shared = np.bincount(place, minlength=len(places))[place] >= 2
    if not shared.any():
        return PhotoGains.plain(len(sources))
    photo, place, light = photo[shared], place[shared], light[shared]
    terms = np.column_stack([np.ones(len(photo)), shades[shared]])
    prior = np.array([PRIOR, *([PRIOR_SHADING] * SHADING_TERMS)])
    numbers = photo.astype(np.int64), place.astype(np.int64)
    factors = np.stack([_solve_levels(each, terms, prior, numbers, len(sources)) for each in light.T], axis=-1)
    gain = np.clip(np.exp(factors[:, 0]), 1.0 / MAX_GAIN, MAX_GAIN)
    shading = np.clip(factors[:, 1:], -MAX_SHADE, MAX_SHADE)
    return PhotoGains(np.round(gain, DIGITS), np.round(shading, DIGITS))


def _measure_light(
    places: Float64[np.ndarray, "m 3"], cell_m: float, source: PhotoSource
) -> tuple[Numbers, Float64[np.ndarray, "k 3"], Float64[np.ndarray, "k t"]]:
    """Points that a photo sees well, the logarithms of its light there, and the shading terms at their pixels."""
    unseen = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, SHADING_TERMS))
    points: Points = (places[:, 0], places[:, 1], places[:, 2])
    place = project_points(source.camera, *points)
    if source.depths is None or not place.inside.any():
        return unseen
    view = classify_points(source.depths.load(), points, 0.0)
    seen = view.seen & ~view.mixed & place.inside
    if not seen.any():
        return unseen
    pixels, _ = load_pixels(source)
    colour = sample_colours(source, pixels, points, seen, cell_m, PLAIN_TONE)
    good = np.flatnonzero(seen & (colour >= MIN_VALUE).all(axis=1) & (colour <= MAX_VALUE).all(axis=1))
    terms = shading_terms(source.camera, place.column[good], place.row[good]).T
    return good, np.log(linear_light(colour[good] / 255.0)), terms


def _solve_levels(
    light: Float64[np.ndarray, " k"],
    terms: Float64[np.ndarray, "k t"],
    prior: Float64[np.ndarray, " t"],
    numbers: tuple[Numbers, Numbers],
    photos: int,
) -> Float64[np.ndarray, "n t"]:
    """Corrections to the logarithms of a channel's light: for each photo a factor per term.

    Args:
        light: Logarithm of light for each observation of a point in a photo.
        terms: Shading terms of each observation; the first is one.
        prior: Weight that holds each factor at the average.
        numbers: Photo and point of each observation.
        photos: Number of photos.
    """
    photo, place = numbers
    found, weight = np.zeros((photos, terms.shape[1])), np.ones(len(light))

    def deviations(value: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " k"]:
        total = np.bincount(place, weight)
        mean = np.bincount(place, weight * value) / np.maximum(total, 1e-9)
        return np.asarray(value - mean[place])

    def sum_by_photo(value: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "n t"]:
        each = (np.bincount(photo, weight * value * term, photos) for term in terms.T)
        return np.stack(list(each), axis=-1)

    def normal_equations(flat: Float64[np.ndarray, " u"]) -> Float64[np.ndarray, " u"]:
        factors = flat.reshape(found.shape)
        kept = prior * (factors - (1.0 - PRIOR_COMMON) * factors.mean(axis=0))
        return np.asarray((sum_by_photo(deviations((terms * factors[photo]).sum(axis=1))) + kept).ravel())

    for _ in range(ROUNDS):
        operator = LinearOperator((found.size, found.size), matvec=normal_equations, dtype=np.float64)
        solution, _ = cg(operator, -sum_by_photo(deviations(light)).ravel(), x0=found.ravel(), rtol=TOLERANCE)
        found = solution.reshape(found.shape)
        off = np.abs(deviations(light + (terms * found[photo]).sum(axis=1)))
        weight = huber_weights(off, HUBER)
    observed = np.bincount(photo, minlength=photos) > 0
    if observed.any():
        found[:, 0] -= found[observed, 0].mean()
    return np.asarray(np.where(observed[:, None], found, 0.0))
