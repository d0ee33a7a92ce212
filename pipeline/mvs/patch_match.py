"""Depths of a photo by PatchMatch: a plane for every pixel, propagated where it fits, from coarse to fine.

At a quarter of the size, planes start at random, and those that fit are propagated (Barnes et al., "PatchMatch",
SIGGRAPH 2009; for depths Bleyer et al., BMVC 2011, and Galliani et al., "Gipuma", ICCV 2015). Each finer size starts
with the planes of the one before, so it has little left to do. A single photo's depths are only candidates until other
photos confirm them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32

from splatpipe.pipeline.mvs.picture import Picture, relative
from splatpipe.pipeline.native import _native

ITERATIONS = (6, 3, 1)  # from the coarsest size; each size is half the next
PERTURBATION_STEPS = (0, 1, 4)  # reductions of the perturbation at the start: planes of larger sizes are nearly right
MIN_SIDE = 24  # pixels; a photo is not halved below this
MAX_COST = 0.5  # for the two best-matching photos: a pixel with a higher cost has no depth
MIN_INVERSE_RATIO = 2.0  # least inverse depth of a result over that searched; what is farther, e.g. clouds, has none


@dataclass(frozen=True, eq=False)
class DepthEstimate:
    """Estimated depths of a photo.

    Attributes:
        inverse: Inverse depth along the camera's z, 1 / world units; 0 where none was found.
        cost: One minus the correlation with the two best-matching photos.
    """

    inverse: Float32[np.ndarray, "h w"]
    cost: Float32[np.ndarray, "h w"]


def find_depths(
    photo: Picture, others: Sequence[Picture], inverse_range: tuple[float, float], seed: int, plain: bool = False
) -> DepthEstimate:
    """Estimate the depths of a photo's pixels, on the kernels' threads.

    Args:
        photo: The photo.
        others: Its neighbours; fewer than two give no depths.
        inverse_range: Smallest and largest inverse depth, 1 / world units.
        seed: Seed of the random planes.
        plain: Whether pixels without texture get depths, too.
    """
    sizes = [(photo, list(others))]
    while len(sizes) < len(ITERATIONS) and min(sizes[-1][0].grey.shape) >= 2 * MIN_SIDE:
        sizes.append((sizes[-1][0].halved(), [other.halved() for other in sizes[-1][1]]))
    planes = np.zeros((3, *sizes[-1][0].grey.shape), np.float32)
    costs = np.zeros(planes.shape[1:], np.float32)
    for number, (small, near) in enumerate(reversed(sizes)):
        planes = _upsample(planes, small)
        costs = np.zeros(planes.shape[1:], np.float32)
        seen = [_seen_from(small, other) for other in near]
        _native.patch_match(
            _bytes(small),
            seen,
            inverse_range,
            ITERATIONS[number],
            PERTURBATION_STEPS[number],
            seed + number,
            planes,
            costs,
        )
    usable = photo.whole() if plain else photo.textured()
    found = usable & (costs <= MAX_COST) & (planes[0] > MIN_INVERSE_RATIO * inverse_range[0])
    return DepthEstimate(np.where(found, planes[0], np.float32(0.0)), costs)


def _upsample(planes: Float32[np.ndarray, "3 h w"], photo: Picture) -> Float32[np.ndarray, "3 h2 w2"]:
    """Upsample planes to the grid of a larger photo."""
    height, width = photo.grey.shape
    if planes.shape[1:] == (height, width):
        return planes
    larger = [cv2.resize(each, (width, height), interpolation=cv2.INTER_NEAREST) for each in planes]
    slopes = (1.0, planes.shape[2] / width, planes.shape[1] / height)
    return np.stack([each * np.float32(slope) for each, slope in zip(larger, slopes, strict=True)])


def _bytes(photo: Picture) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(photo.grey), np.ascontiguousarray(photo.counts).view(np.uint8)


def _seen_from(photo: Picture, other: Picture) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    turn, shift = (np.ascontiguousarray(each, np.float32) for each in relative(photo.camera, other.camera))
    return (*_bytes(other), turn, shift)
