"""Levels of detail: a tree of parts of space, each of which stands for those below it until one comes near."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.moments import moments_of
from splatpipe.pipeline.splat.reduction import Reduction, reduce_further

MOST_PER_NODE = 60_000
CHILDREN = 4
"""Of a node, at most: a surface twice as coarse has a quarter as many Gaussians. The root has one more."""
BOX_SIGMAS = 3.0
ERROR_PER_SPREAD = 40.0
"""World units of a node's error for each of the spread of its merged Gaussians: at an error of 16 pixels the spread is
0.4 pixels, and models of unlike captures are within 32 dB there (`benchmarks/levels.py`). From farther away a node is
nearer still to what the full model is, but not to what is drawn of it, which leaves out what is fainter than an 8-bit
step: most of a pixel's many Gaussians."""
LARGE_POWER = 0.5
"""In place of ``reduction.LARGE_POWER``: all of a node is seen from about one distance, and what is large is large in
the picture."""
FIRST_POWER = 0.3
"""For the root, which is seen first, and then from the photos' places: what is small is near them. With less, what is
enormous, far around, becomes thin."""
_SPREAD_QUANTILE = 0.9  # the coarsest tenth may lie beyond
_ERROR_STEP = 1.01  # that a node's error is at least above its children's
_FAR_SIDES = 2.0  # what lies so many sides of the middle 80 % beyond them is far: sky, floaters
_LARGE_SIDES = 0.05  # a Gaussian with such a standard deviation is large: it would be most of a leaf's box
_MIDDLE_PERCENT = (10.0, 90.0)  # even a fifth of all Gaussians in a sky around leaves these to the scene
_EXTENT_PERCENT = (5.0, 95.0)


@dataclass(frozen=True, eq=False)
class LevelNode:
    """A part of the scene at one level of detail.

    Attributes:
        box: Lowest and highest corner of the centres ± 3 standard deviations of what it and all below it hold, scene
            frame.
        error: How far it stands from the full model, world units; 0 where it is that. Above its children's.
        gaussians: Stands for everything below.
        children: Together they replace it; none at the full model.
    """

    box: Float64[np.ndarray, "2 3"]
    error: float
    gaussians: Gaussians
    children: tuple[LevelNode, ...]

    def nodes(self) -> Iterator[LevelNode]:
        """This one and all below it, each before its children."""
        yield self
        for child in self.children:
            yield from child.nodes()


def build_levels(gaussians: Gaussians, most_per_node: int = MOST_PER_NODE) -> LevelNode:
    """Divide Gaussians in space into leaves, and merge those of a node's children until they fit one node.

    What lies far outside, as a sky does, and what is enormous have a branch of their own: the others' boxes stay small.

    Args:
        gaussians: On the CPU, in any frame; at least one.
        most_per_node: Gaussians in a node, at most.

    Returns:
        The root. Every Gaussian is in one leaf, to the bit.

    Raises:
        ValueError: if there are no Gaussians, or nodes may not hold any.
    """
    if not len(gaussians) or most_per_node < 1:
        raise ValueError(f"levels of {len(gaussians)} Gaussians, at most {most_per_node} in a node")
    means = gaussians.means.detach().to(torch.float64).numpy()
    far_or_large = _outside(gaussians, means)
    if len(means) <= most_per_node:
        return _branch(gaussians, means, np.arange(len(means)), most_per_node).node
    inside, outside = np.flatnonzero(~far_or_large), np.flatnonzero(far_or_large)
    below = _branches(gaussians, means, inside, most_per_node) if len(inside) else []
    if len(outside):
        below.append(_branch(gaussians, means, outside, most_per_node))
    return _joined(below, most_per_node, FIRST_POWER).node


def select_nodes(
    root: LevelNode, camera_centre: Float64[np.ndarray, " 3"], focal_px: float, most_error_px: float = 16.0
) -> list[LevelNode]:
    """The nodes that show the scene from a place: as few as are needed for no error to be larger there than allowed.

    Args:
        root: Of the levels.
        camera_centre: World frame.
        focal_px: Pixels.
        most_error_px: Largest error on the screen, at the nearest point of a node's box.
    """
    if not root.children or root.error * focal_px <= most_error_px * box_distance(root.box, camera_centre):
        return [root]
    return [node for child in root.children for node in select_nodes(child, camera_centre, focal_px, most_error_px)]


def box_distance(box: Float64[np.ndarray, "2 3"], point: Float64[np.ndarray, " 3"]) -> float:
    """From a point to the nearest of a box; 0 inside."""
    return float(np.linalg.norm(np.maximum(np.maximum(box[0] - point, point - box[1]), 0.0)))


@dataclass(frozen=True, eq=False)
class _Branch:
    """A node, and what its Gaussians stand for."""

    node: LevelNode
    held: Reduction


def _branch(
    gaussians: Gaussians, means: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " m"], most: int
) -> _Branch:
    """The tree of a part, its leaves alike in number."""
    if len(part) > most:
        return _joined(_branches(gaussians, means, part, most), most, LARGE_POWER)
    own = gaussians.select(torch.from_numpy(np.sort(part)))
    return _Branch(LevelNode(_box(own), 0.0, own, ()), Reduction.none_yet(own))


def _branches(
    gaussians: Gaussians, means: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " m"], most: int
) -> list[_Branch]:
    """A part divided into the trees of its children: as low as nodes of this size allow."""
    height = 1
    while most * CHILDREN**height < len(part):
        height += 1
    count = math.ceil(len(part) / (most * CHILDREN ** (height - 1)))
    return [_branch(gaussians, means, cell, most) for cell in _cells(means, part, count)]


def _joined(branches: Sequence[_Branch], most: int, large_power: float) -> _Branch:
    """The node over some: what they hold, merged until it fits."""
    children = tuple(branch.node for branch in branches)
    reduced = reduce_further(Reduction.joined([branch.held for branch in branches]), most, large_power)
    boxes = np.stack([child.box for child in children])
    box = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
    error = max(_ERROR_STEP * max(child.error for child in children), ERROR_PER_SPREAD * _spread(reduced))
    return _Branch(LevelNode(box, error, reduced.gaussians, children), reduced)


def _spread(reduced: Reduction) -> float:
    """Upper quantile, by the numbers that they stand for, of how far Gaussians stand from those.

    Not by mass: a model's few enormous Gaussians, far from every camera, would outweigh all that is looked at.
    """
    order = np.argsort(reduced.spreads, kind="stable")
    below = np.cumsum(reduced.counts[order])
    return float(reduced.spreads[order][np.searchsorted(below, _SPREAD_QUANTILE * below[-1])])


def _cells(
    means: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " m"], count: int
) -> list[Int64[np.ndarray, " k"]]:
    """Divide a part in space into so many, alike in number, across the longest side each time."""
    if count == 1:
        return [part]
    first = count // 2
    low, high = np.percentile(means[part], _EXTENT_PERCENT, axis=0)
    axis = int(np.argmax(high - low))
    order = part[np.argsort(means[part, axis], kind="stable")]
    at = round(len(part) * first / count)
    return _cells(means, order[:at], first) + _cells(means, order[at:], count - first)


def _outside(gaussians: Gaussians, means: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which lie far outside the middle of all, or are so large that a box around them says nothing of the others."""
    low, high = np.percentile(means, _MIDDLE_PERCENT, axis=0)
    side = float((high - low).max())
    far = ((means < low - _FAR_SIDES * side) | (means > high + _FAR_SIDES * side)).any(1)
    large = gaussians.log_scales.detach().amax(1).to(torch.float64).exp().numpy() > _LARGE_SIDES * side
    return np.asarray(far | large)


def _box(gaussians: Gaussians) -> Float64[np.ndarray, "2 3"]:
    """Around centres and so many standard deviations along each axis of the frame."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for piece in gaussians.pieces():
        moments = moments_of(piece)
        reach = BOX_SIGMAS * np.sqrt(moments.covariances[:, [0, 3, 5]])
        low, high = np.minimum(low, (moments.means - reach).min(0)), np.maximum(high, (moments.means + reach).max(0))
    return np.stack([low, high])
