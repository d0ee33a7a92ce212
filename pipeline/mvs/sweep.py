"""Plane sweep: a depth for each pixel whose surroundings look alike in its neighbours on one plane only.

At half the size, planes parallel to the picture, evenly spaced in inverse depth, carry the neighbours into the photo
(Collins, "A space-sweep approach to true multi-image matching", CVPR 1996). Of the neighbours only the two most alike
count, against occlusion (Kang, Szeliski and Chai, "Handling occlusions in dense multi-view stereo", CVPR 2001). At full
size the smoothed depths are moved to and fro a little: the windows then lie on the surface, however it is inclined.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from splatpipe.pipeline.mvs.likeness import Likeness, Picture, corners, relative

PLANES = (32, 128)  # fewest and most
STEP_PX = 1.0  # a neighbour moves at most this far from plane to plane, as far as the number of planes allows
ALIKE = 0.6  # mean correlation of the two best neighbours that a depth needs
APART = 3  # planes from the best one on, a second one may not come as close as...
UNIQUE = 0.05  # ...this
SMOOTHED = 2  # pixels to each side over which depths are averaged before they are refined...
TOGETHER = 2.0  # ...where they are within so many planes of the middle one...
SUPPORT = 8  # ...and at least so many, of 25: fewer are speckles
OFFSETS = np.linspace(-1.25, 1.25, 11)  # planes to and fro at full size: half a pixel each


@dataclass(frozen=True)
class Depths:
    """What a sweep found.

    Attributes:
        inverse: Inverse depth along the camera's z, 1 / world units; 0 where none was found.
        score: Mean correlation of the two best neighbours, 0 where no depth was found.
    """

    inverse: Float32[np.ndarray, "h w"]
    score: Float32[np.ndarray, "h w"]


def sweep(photo: Picture, others: Sequence[Picture], inverse_range: tuple[float, float]) -> Depths:
    """Find the depths of a photo's pixels.

    Args:
        photo: The photo.
        others: Its neighbours; with fewer than two nothing is found.
        inverse_range: Smallest and largest inverse depth.
    """
    half, half_others = photo.halved(), [other.halved() for other in others]
    planes = plane_depths(half, half_others, inverse_range)
    step = float(planes[1] - planes[0])
    likeness = Likeness(half)
    volume = np.stack(
        [_best_two(half, (likeness.by_plane(other, float(plane)) for other in half_others)) for plane in planes]
    )
    place, score = _peaks(volume)
    found = likeness.textured & (score >= ALIKE) & _alone(volume, place, score)
    start = _smoothed(np.where(found, planes[0] + place * step, 0.0).astype(np.float32), step)
    return _refined(photo, others, _doubled(start, photo), step)


def plane_depths(
    photo: Picture, others: Sequence[Picture], inverse_range: tuple[float, float]
) -> Float64[np.ndarray, " planes"]:
    """Inverse depths, as many as keep a neighbour's steps near ``STEP_PX``."""
    longest = 0.0
    for other in others:
        turn, shift = relative(photo.camera, other.camera)
        ends = [turn @ corners(photo.camera) + shift[:, None] * inverse for inverse in inverse_range]
        if all((end[2] > 0.0).all() for end in ends):
            near, far = (end[:2] / end[2] for end in ends)
            longest = max(longest, float(np.hypot(*(near - far)).max()))
    return np.linspace(*inverse_range, min(max(math.ceil(longest / STEP_PX), PLANES[0]), PLANES[1]))


def _best_two(photo: Picture, likenesses: Iterable[Float32[np.ndarray, "h w"] | None]) -> Float32[np.ndarray, "h w"]:
    """Mean of the two highest; one neighbour alone is worth half."""
    first, second = np.zeros((2, *photo.grey.shape), np.float32)
    for alike in likenesses:
        if alike is not None:
            np.maximum(second, np.minimum(first, alike), out=second)
            np.maximum(first, alike, out=first)
    return np.asarray(0.5 * (first + second), np.float32)


def _peaks(
    volume: Float32[np.ndarray, "planes h w"],
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Where each pixel's best layer is, between layers by a parabola, and its score: 0 at an end of the volume."""
    best = volume.argmax(axis=0)
    middle = np.clip(best, 1, len(volume) - 2)
    before, score, after = (np.take_along_axis(volume, (middle + step)[None], 0)[0] for step in (-1, 0, 1))
    bend = np.minimum(before - 2.0 * score + after, -np.finfo(np.float32).tiny)
    place = middle + np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return place.astype(np.float32), np.where(best == middle, score, 0.0).astype(np.float32)


def _alone(
    volume: Float32[np.ndarray, "planes h w"], place: Float32[np.ndarray, "h w"], score: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Whether no plane away from the best one is about as good."""
    rival = np.zeros_like(score)
    for number, layer in enumerate(volume):
        np.maximum(rival, layer, out=rival, where=np.abs(place - number) > APART - 0.5)
    return np.asarray(score - rival >= UNIQUE)


def _smoothed(inverse: Float32[np.ndarray, "h w"], step: float) -> Float32[np.ndarray, "h w"]:
    """Averages over the neighbours on the same surface, without speckles; 0 where there is no depth."""
    h, w = inverse.shape
    padded = np.pad(inverse, SMOOTHED)
    total, count = np.zeros((2, h, w), np.float32)
    for top in range(2 * SMOOTHED + 1):
        for left in range(2 * SMOOTHED + 1):
            near = padded[top : top + h, left : left + w]
            same = (near > 0.0) & (np.abs(near - inverse) < TOGETHER * step)
            total += np.where(same, near, 0.0)
            count += same
    return np.where((inverse > 0.0) & (count >= SUPPORT), total / np.maximum(count, 1.0), 0.0).astype(np.float32)


def _doubled(inverse: Float32[np.ndarray, "h w"], photo: Picture) -> Float32[np.ndarray, "full_h full_w"]:
    """The same at the photo's size."""
    size = (photo.camera.width, photo.camera.height)
    total = cv2.resize(inverse, size, interpolation=cv2.INTER_LINEAR)
    weight = cv2.resize((inverse > 0.0).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.where(weight > 0.5, total / np.maximum(weight, 0.5), 0.0).astype(np.float32)


def _refined(photo: Picture, others: Sequence[Picture], start: Float32[np.ndarray, "h w"], step: float) -> Depths:
    """Depths of the best offsets from a start (0 where there is none), where they are good."""
    likeness = Likeness(photo)
    turned = [likeness.turned(other) for other in others]
    offsets = (OFFSETS * step).astype(np.float32)
    volume = np.stack(
        [
            _best_two(
                photo,
                (likeness.by_surface(other, start + offset, rays) for other, rays in zip(others, turned, strict=True)),
            )
            for offset in offsets
        ]
    )
    place, score = _peaks(volume)
    inverse = start + offsets[0] + place * (offsets[1] - offsets[0])
    found = (start > 0.0) & (inverse > 0.0) & likeness.textured & (score >= ALIKE)
    return Depths(np.where(found, inverse, 0.0).astype(np.float32), np.where(found, score, 0.0).astype(np.float32))
