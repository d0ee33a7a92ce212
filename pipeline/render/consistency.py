"""Depth consistency of neighbouring views: the disagreement of their median depths.

Haze fitted to one photo is a surface only along that photo's rays: a neighbour that sees the same place from the side
looks through it. The pixels of a view are therefore unprojected by its median depth and looked up in the neighbour's
depth map, as in the consistency checks of multi-view stereo (Schönberger et al.: "Pixelwise View Selection for
Unstructured Multi-View Stereo", ECCV 2016).

A nearer depth in the neighbour says nothing: something may occlude the place, as corners do. A farther depth is a
contradiction: the neighbour looks through what the view shows as a surface. The check is one-sided and runs in both
directions: haze in front of the neighbour is an occlusion in one direction and a contradiction in the other. One pixel
of tolerance is allowed: the best-matching depth of the nine pixels counts; otherwise every real silhouette would be a
contradiction. A solid floater that both views see in the same place is not detected here but by ``free_space``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera

DEPTH_TOLERANCE = 0.05  # relative; far more than a pixel's step on slanted ground, far less than a floater's distance
SAMPLE_EVERY = 4  # pixels, both ways: thousands remain of the smallest image
NO_SURFACE = 1.0  # stands for the infinite difference where the neighbour sees no surface, and caps the others
MAX_PAIRS = 12  # pairs of neighbouring photos: enough for the median, in a few seconds of rendering


@dataclass(frozen=True)
class DepthDisagreement:
    """Disagreement of the median depths of neighbouring views.

    Attributes:
        median: Median magnitude of the differences, as a share of the depth; None without pixels.
        share: Share of the pixels where the neighbour sees more than ``DEPTH_TOLERANCE`` farther; None without pixels.
        pixels: Number of pixels compared.
    """

    median: float | None
    share: float | None
    pixels: int


def neighbouring_pairs(seen: Sequence[Int64[np.ndarray, " _"]], most: int = MAX_PAIRS) -> list[tuple[int, int]]:
    """Pairs of views that share sparse points: evenly chosen views, each with the view that shares most.

    Args:
        seen: Rows of the points that each view observes.
        most: Maximum number of pairs.

    Returns:
        Pairs of indices, the smaller first, each once, in order.
    """
    usable = [index for index, rows in enumerate(seen) if rows.size]
    if len(usable) < 2 or most < 1:
        return []
    once = {index: np.unique(seen[index]) for index in usable}
    points = 1 + max(int(rows[-1]) for rows in once.values())
    pairs = set()
    for place in np.unique(np.linspace(0, len(usable) - 1, min(most, len(usable))).round().astype(int)):
        here = usable[place]
        marked = np.zeros(points, np.bool_)
        marked[once[here]] = True
        shared = [0 if index == here else int(np.count_nonzero(marked[rows])) for index, rows in once.items()]
        best = int(np.argmax(shared))
        if shared[best] > 0:
            pairs.add((min(here, usable[best]), max(here, usable[best])))
    return sorted(pairs)


def depth_differences(
    camera: Camera, depth: Float[np.ndarray, "h w"], neighbour: Camera, neighbour_depth: Float[np.ndarray, "nh nw"]
) -> Float64[np.ndarray, " k"]:
    """How much farther a neighbour sees than the surface in a view, per pixel.

    Args:
        camera: The view's camera, at the size of its depth map.
        depth: Its median depth, world units along the view axis; 0 or not finite where it has none.
        neighbour: The neighbour's camera, at the size of its depth map.
        neighbour_depth: The neighbour's depth; without one, it sees no surface.

    Returns:
        (neighbour's depth - point's depth) / point's depth, at most `NO_SURFACE`, for every few pixels that have a
        depth, project into the neighbour's image and are not occluded there.
    """
    rows, columns = np.mgrid[
        SAMPLE_EVERY // 2 : camera.height : SAMPLE_EVERY, SAMPLE_EVERY // 2 : camera.width : SAMPLE_EVERY
    ]
    rows, columns = rows.ravel(), columns.ravel()
    z = depth[rows, columns].astype(np.float64)
    usable = np.isfinite(z) & (z > 0.0)
    rows, columns, z = rows[usable], columns[usable], z[usable]
    world = camera.unproject(np.stack((columns + 0.5, rows + 0.5), axis=1), z)
    _, pixels, there = neighbour.in_view(world)
    best = _best_around(pixels.astype(np.int64), there, neighbour_depth)
    return best[best >= -DEPTH_TOLERANCE]


def _best_around(
    pixels: Int64[np.ndarray, "k 2"], z: Float64[np.ndarray, " k"], depth: Float[np.ndarray, "h w"]
) -> Float64[np.ndarray, " k"]:
    """The relative difference of smallest magnitude among the nine pixels around each."""
    h, w = depth.shape
    best = np.full(len(z), NO_SURFACE)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            found = depth[np.clip(pixels[:, 1] + down, 0, h - 1), np.clip(pixels[:, 0] + right, 0, w - 1)]
            surface = np.isfinite(found) & (found > 0.0)
            there = np.where(surface, found, np.inf).astype(np.float64)
            difference = np.minimum(there / z - 1.0, NO_SURFACE)
            best = np.where(np.abs(difference) < np.abs(best), difference, best)
    return best


def depth_disagreement(differences: Sequence[Float64[np.ndarray, " _"]]) -> DepthDisagreement:
    """The figures over all compared pixels.

    Args:
        differences: Results of ``depth_differences``, for both directions of each pair.
    """
    every = np.concatenate([np.empty(0), *differences])
    if every.size == 0:
        return DepthDisagreement(None, None, 0)
    return DepthDisagreement(float(np.median(np.abs(every))), float(np.mean(every > DEPTH_TOLERANCE)), int(every.size))
