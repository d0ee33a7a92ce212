"""Levels of detail (LOD): a tree over space in which each node replaces its children at a distance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.splat.levels.reduction import Reduction, reduce_further
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.moments import moments_of

MAX_PER_NODE = 60_000
CHILDREN = 4
"""Maximum per node: a surface twice as coarse has a quarter as many Gaussians. The root may have one more."""
BOX_SIGMAS = 3.0
ERROR_PER_SPREAD = 40.0
"""A node's error per spread of its merged Gaussians, both in world units: at an error of 16 pixels the spread is 0.4
pixels, where models of different captures are within 32 dB of the full model (`benchmarks/splats/levels.py`). From
farther away a node is even closer to the full model, but not to its rendering, which omits contributions below an
8-bit step: most of a pixel's many Gaussians."""
LARGE_POWER = 0.5
"""Replaces ``reduction.LARGE_POWER``: all of a node is seen from about the same distance, so what is large in the world
is large in the image."""
FIRST_POWER = 0.3
"""For the root, which is seen first, and from the photos' positions, near which Gaussians are small. With a smaller
power, enormous Gaussians far around the scene become thin."""
_SPREAD_QUANTILE = 0.9  # the coarsest tenth may exceed it
_ERROR_STEP = 1.01  # least ratio of a node's error to its children's
_FAR_SIDES = 2.0  # Gaussians more than this many box sides outside the middle 80 % are far: sky, floaters
_LARGE_SIDES = 0.05  # a Gaussian with a standard deviation above this many box sides would fill most of a leaf's box
_MIDDLE_PERCENT = (10.0, 90.0)  # lies in the scene even if a fifth of all Gaussians form a sky around it
_EXTENT_PERCENT = (5.0, 95.0)


@dataclass(frozen=True, eq=False)
class LevelNode:
    """A part of the scene at one level of detail.

    Attributes:
        box: Lowest and highest corner of the centres ± 3 standard deviations of all Gaussians in it and below, scene
            frame.
        error: Geometric error against the full model, world units; 0 for a leaf, otherwise above its children's.
        gaussians: Represent everything below.
        children: Together they replace the node; empty for a leaf.
    """

    box: Float64[np.ndarray, "2 3"]
    error: float
    gaussians: Gaussians
    children: tuple[LevelNode, ...]

    def nodes(self) -> Iterator[LevelNode]:
        """This node and all below it, each before its children."""
        yield self
        for child in self.children:
            yield from child.nodes()


def build_levels(gaussians: Gaussians, most_per_node: int = MAX_PER_NODE) -> LevelNode:
    """Partition Gaussians into leaves, and merge those of a node's children until they fit into one node.

    Gaussians far outside, such as a sky, and enormous ones get a branch of their own, so that other boxes stay small.

    Args:
        gaussians: On the CPU, in any frame; at least one.
        most_per_node: Maximum number of Gaussians per node.

    Returns:
        The root. Every Gaussian is in exactly one leaf, bit for bit.

    Raises:
        ValueError: if there are no Gaussians, or ``most_per_node`` is below 1.
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
    """Select the fewest nodes that show the scene from a viewpoint within an error limit.

    Args:
        root: Root of the tree.
        camera_centre: World frame.
        focal_px: Focal length, pixels.
        most_error_px: Largest screen-space error, at the nearest point of a node's box.
    """
    if not root.children or root.error * focal_px <= most_error_px * box_distance(root.box, camera_centre):
        return [root]
    return [node for child in root.children for node in select_nodes(child, camera_centre, focal_px, most_error_px)]


def box_distance(box: Float64[np.ndarray, "2 3"], point: Float64[np.ndarray, " 3"]) -> float:
    """Distance from a point to a box; 0 inside."""
    return float(np.linalg.norm(np.maximum(np.maximum(box[0] - point, point - box[1]), 0.0)))


@dataclass(frozen=True, eq=False)
class _Branch:
    """A node with the reduction that produced its Gaussians."""

    node: LevelNode
    held: Reduction


def _branch(
    gaussians: Gaussians, means: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " m"], most: int
) -> _Branch:
    """The tree of a part, with leaves of about equal size."""
    if len(part) > most:
        return _joined(_branches(gaussians, means, part, most), most, LARGE_POWER)
    own = gaussians.select(torch.from_numpy(np.sort(part)))
    return _Branch(LevelNode(_box(own), 0.0, own, ()), Reduction.unmerged(own))


def _branches(
    gaussians: Gaussians, means: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " m"], most: int
) -> list[_Branch]:
    """The trees of a part's children, of the smallest height that the node size allows."""
    height = 1
    while most * CHILDREN**height < len(part):
        height += 1
    count = math.ceil(len(part) / (most * CHILDREN ** (height - 1)))
    return [_branch(gaussians, means, cell, most) for cell in _cells(means, part, count)]


def _joined(branches: Sequence[_Branch], most: int, large_power: float) -> _Branch:
    """The parent of some branches: their Gaussians, merged until they fit into a node."""
    children = tuple(branch.node for branch in branches)
    reduced = reduce_further(Reduction.joined([branch.held for branch in branches]), most, large_power)
    boxes = np.stack([child.box for child in children])
    box = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
    error = max(_ERROR_STEP * max(child.error for child in children), ERROR_PER_SPREAD * _spread(reduced))
    return _Branch(LevelNode(box, error, reduced.gaussians, children), reduced)


def _spread(reduced: Reduction) -> float:
    """Upper quantile of the spreads of merged Gaussians, weighted by the number of Gaussians merged into each.

    Not by mass: a model's few enormous Gaussians, far from every camera, would outweigh everything in view.
    """
    order = np.argsort(reduced.spreads, kind="stable")
    below = np.cumsum(reduced.counts[order])
    return float(reduced.spreads[order][np.searchsorted(below, _SPREAD_QUANTILE * below[-1])])


def _cells(
    means: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " m"], count: int
) -> list[Int64[np.ndarray, " k"]]:
    """Split a part into ``count`` cells of about equal size, across the longest side each time."""
    if count == 1:
        return [part]
    first = count // 2
    low, high = np.percentile(means[part], _EXTENT_PERCENT, axis=0)
    axis = int(np.argmax(high - low))
    order = part[np.argsort(means[part, axis], kind="stable")]
    at = round(len(part) * first / count)
    return _cells(means, order[:at], first) + _cells(means, order[at:], count - first)


def _outside(gaussians: Gaussians, means: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which Gaussians lie far outside the middle of the scene, or are so large that they would dominate any box."""
    low, high = np.percentile(means, _MIDDLE_PERCENT, axis=0)
    side = float((high - low).max())
    far = ((means < low - _FAR_SIDES * side) | (means > high + _FAR_SIDES * side)).any(1)
    large = gaussians.log_scales.detach().amax(1).to(torch.float64).exp().numpy() > _LARGE_SIDES * side
    return np.asarray(far | large)


def _box(gaussians: Gaussians) -> Float64[np.ndarray, "2 3"]:
    """The box around the centres ± ``BOX_SIGMAS`` standard deviations along each axis of the frame."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for piece in gaussians.pieces():
        moments = moments_of(piece)
        reach = BOX_SIGMAS * np.sqrt(moments.covariances[:, [0, 3, 5]])
        low, high = np.minimum(low, (moments.means - reach).min(0)), np.maximum(high, (moments.means + reach).max(0))
    return np.stack([low, high])
