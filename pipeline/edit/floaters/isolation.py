"""Finds which Gaussians are connected, and which small groups are apart from all others.

Two Gaussians touch if their ellipsoids, some standard deviations large, meet along the line between their centres.
Surfaces, poles and wires are chains of touching Gaussians; a floater touches nothing, or a few others that touch
nothing else. Sizes are measured along that line: a flat Gaussian of a wall reaches far within the wall but hardly off
it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from splatpipe.pipeline.splat.model.gaussians import Gaussians

NEIGHBOURS = 12  # nearest neighbours of each Gaussian that are tested for contact
MAX_GAP_SIGMAS = 4.0  # farther from the scene, in a Gaussian's own sigmas, it is isolated: surfaces lie closer
CHUNK = 1 << 16  # Gaussians at a time: tens of megabytes


@dataclass(frozen=True)
class TouchRule:
    """The definition of touching.

    Attributes:
        sigmas: Size of the ellipsoids in standard deviations.
        size_ratio: The larger one's reach along the line counts at most this many times the smaller one's: a small
            Gaussian within the haze of a large one is not held by it.
        needed: Number of others that one has to touch to be held.
    """

    sigmas: float
    size_ratio: float
    needed: int = 1


@dataclass(frozen=True, eq=False)
class GaussianShapes:
    """Positions and sizes of Gaussians, on the CPU.

    Attributes:
        centres: Centres, world units.
        axes: Matrices R diag(s): the standard deviation along a unit vector u is |(R diag(s))ᵀ u|.
        largest: The largest standard deviation.
    """

    centres: Float64[np.ndarray, "n 3"]
    axes: Float32[np.ndarray, "n 3 3"]
    largest: Float32[np.ndarray, " n"]

    @staticmethod
    def of(gaussians: Gaussians) -> GaussianShapes:
        """The shapes of finite Gaussians, which may be on the CPU or a device."""
        largest = np.exp(gaussians.log_scales.detach().amax(1).numpy(force=True))
        return GaussianShapes(gaussians.means.detach().double().numpy(force=True), half_axes(gaussians), largest)


def far_groups(
    shapes: GaussianShapes, touch: TouchRule, solid: Bool[np.ndarray, " n"], few: int
) -> Bool[np.ndarray, " n"]:
    """Which Gaussians form small connected groups far from all others.

    Args:
        shapes: Shapes of all Gaussians.
        touch: The contact rule.
        solid: Which ones count: haze holds nothing, and is never reported.
        few: Largest size of a group that is not the scene. If no group is larger, everything is the scene.
    """
    rows = np.flatnonzero(solid)
    found = np.zeros(len(solid), np.bool_)
    if len(rows) <= NEIGHBOURS:
        return found
    neighbours, touching = _contacts(shapes, touch, rows, rows)
    labels = _labels(np.searchsorted(rows, neighbours).astype(np.int32), touching)
    sizes = np.bincount(labels)
    scene, alone = rows[sizes[labels] > few], np.flatnonzero(sizes[labels] <= few)
    if not len(scene) or not len(alone):
        return found
    near = _near(shapes, touch, rows[alone], scene)
    is_near = np.zeros(len(sizes), np.bool_)
    is_near[labels[alone[near]]] = True
    found[rows[alone[~is_near[labels[alone]]]]] = True
    return found


def _near(
    shapes: GaussianShapes, touch: TouchRule, asked: Int64[np.ndarray, " m"], scene: Int64[np.ndarray, " s"]
) -> Bool[np.ndarray, " m"]:
    """Which Gaussians are near the scene: they touch it, or are within ``MAX_GAP_SIGMAS`` of it."""
    distance = cKDTree(shapes.centres[scene]).query(shapes.centres[asked])[0]
    return np.asarray(touch_any(shapes, touch, asked, scene) | (distance <= MAX_GAP_SIGMAS * shapes.largest[asked]))


def held(
    shapes: GaussianShapes, touch: TouchRule, ground: Bool[np.ndarray, " n"], asked: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Which Gaussians are held by the ground, directly or through other held ones.

    Args:
        shapes: Shapes of all Gaussians.
        touch: The contact rule; each needs ``touch.needed`` contacts that are ground or held.
        ground: Which Gaussians are undoubted.
        asked: Which Gaussians to test.

    Returns:
        Those of ``asked`` that are held.
    """
    rows, solid = np.flatnonzero(asked), np.flatnonzero(ground | asked)
    if len(solid) <= NEIGHBOURS:
        return asked.copy()
    neighbours, touching = _contacts(shapes, touch, rows, solid)
    holding, waiting = ground.copy(), np.arange(len(rows))
    while len(waiting):
        by = (holding[neighbours[waiting]] & touching[waiting]).sum(1)
        found = by >= touch.needed
        if not found.any():
            break
        holding[rows[waiting[found]]] = True
        waiting = waiting[~found]
    return np.asarray(holding & asked)


def touch_any(
    shapes: GaussianShapes, touch: TouchRule, asked: Int64[np.ndarray, " m"], others: Int64[np.ndarray, " s"]
) -> Bool[np.ndarray, " m"]:
    """Which Gaussians touch any of the others, including large ones whose centres are far away.

    Each size class has its own tree, in which those that could reach are among the nearest.
    """
    found = np.zeros(len(asked), np.bool_)
    if not len(others):
        return found
    steps = np.floor(np.log2(shapes.largest[others] / np.median(shapes.largest[others]))).clip(min=0)
    for step in np.unique(steps):
        members, left = others[steps == step], np.flatnonzero(~found)
        _, touching = _contacts(shapes, touch, asked[left], members)
        found[left] = touching.any(1)
    return found


def half_axes(gaussians: Gaussians) -> Float32[np.ndarray, "n 3 3"]:
    """Matrices R diag(s): a Gaussian's standard deviation along a unit vector u is |(R diag(s))ᵀ u|."""
    w, x, y, z = torch.nn.functional.normalize(gaussians.quats.detach(), dim=1).numpy(force=True).T
    axes = np.empty((len(gaussians), 3, 3), np.float32)
    axes[:, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1)
    axes[:, 1] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1)
    axes[:, 2] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1)
    axes *= np.exp(gaussians.log_scales.detach().numpy(force=True))[:, None]
    return axes


def _contacts(
    shapes: GaussianShapes, touch: TouchRule, rows: Int64[np.ndarray, " m"], others: Int64[np.ndarray, " s"]
) -> tuple[Int32[np.ndarray, "m k"], Bool[np.ndarray, "m k"]]:
    """The nearest others of some Gaussians, and whether they touch; a Gaussian never touches itself."""
    tree = cKDTree(shapes.centres[others])
    k = min(NEIGHBOURS + 1, len(others))
    neighbours, touching = np.empty((len(rows), k), np.int32), np.empty((len(rows), k), np.bool_)
    for part in _chunks(len(rows)):
        nearest = others[tree.query(shapes.centres[rows[part]], k)[1].reshape(-1, k)]
        neighbours[part], touching[part] = nearest, _touching(shapes, touch, rows[part], nearest)
    return neighbours, touching


def _touching(
    shapes: GaussianShapes, touch: TouchRule, one: Int64[np.ndarray, " c"], others: Int64[np.ndarray, "c k"]
) -> Bool[np.ndarray, "c k"]:
    """Whether Gaussians touch others, k of which are tested for each."""
    apart = (shapes.centres[others] - shapes.centres[one, None]).astype(np.float32)
    distance = np.linalg.norm(apart, axis=2)
    touching = np.zeros(distance.shape, np.bool_)
    near = distance <= touch.sigmas * (shapes.largest[one, None] + shapes.largest[others])
    which, slot = np.nonzero(near & (others != one[:, None]))
    along = apart[which, slot] / np.maximum(distance[which, slot], 1e-30)[:, None]
    here, there = (_sigma(shapes.axes[index], along) for index in (one[which], others[which, slot]))
    reach = np.minimum(here, touch.size_ratio * there) + np.minimum(there, touch.size_ratio * here)
    touching[which, slot] = distance[which, slot] <= touch.sigmas * reach
    return touching


def _sigma(axes: Float32[np.ndarray, "m 3 3"], along: Float32[np.ndarray, "m 3"]) -> Float32[np.ndarray, " m"]:
    """Standard deviations along unit vectors."""
    return np.asarray(np.linalg.norm(np.einsum("mij,mi->mj", axes, along), axis=1))


def _labels(neighbours: Int32[np.ndarray, "n k"], touching: Bool[np.ndarray, "n k"]) -> Int32[np.ndarray, " n"]:
    """Labels of the connected groups."""
    n = len(neighbours)
    starts = np.concatenate(([0], np.cumsum(touching.sum(1)))).astype(np.int64)
    graph = csr_matrix((np.ones(starts[-1], np.uint8), neighbours[touching], starts), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def _chunks(n: int) -> Iterator[slice]:
    return (slice(start, min(n, start + CHUNK)) for start in range(0, n, CHUNK))
