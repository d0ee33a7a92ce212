"""How well an adjusted block knows its cameras, its lens and the ground, and what more observations would add.

All by propagation from the normal equations, in which positions, tie points and lens priors have their estimated
errors. In photos straight down from one height the height of the ground is the camera's height less focal length times
baseline over parallax: it stretches with the focal length, and no residual shows by how much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.similarity import Similarity, similarity_jacobian
from splatpipe.pipeline.survey.adjustment.block import Block, ReducedBlock, ground_carry, part_of, reduce_block
from splatpipe.pipeline.survey.adjustment.block_adjustment import (
    AdjustedBlock,
    PositionObservations,
    joint_system,
    solve,
)
from splatpipe.pipeline.survey.placing.uncertainty import NORMAL_95

GROUND_POINTS = 400  # points at which the ground's accuracy is evaluated
MIN_VIEWS = 3  # photos that show a point of the ground at which accuracy is evaluated
MAX_PHOTOS = 500  # whose covariance is propagated together
MAX_DISTANCE_RATIO = 2.0  # distance over the median from camera to point: what is beyond is not the site
MARK_SIGMA_PX = 0.5
CONTROL_SIGMAS_M = (0.02, 0.02, 0.03)
CROSS_STRIP_RISE = 0.25  # height of a cross strip over the other flights', as a share of the flying height
MAX_CROSS = 12  # photos of a cross strip


@dataclass(frozen=True)
class BlockAccuracy:
    """Covariance of an adjusted block.

    Attributes:
        adjusted: The block.
        observed: The positions in it.
        covariance: Of its unknowns, then of the flights' offsets.
        points: Indices of the ground points.
        carry: (k, 3, q) their derivatives by the unknowns.
        own: (k, 3, 3) their covariance for known cameras.
    """

    adjusted: AdjustedBlock
    observed: PositionObservations
    covariance: Float64[np.ndarray, "r r"]
    points: Int64[np.ndarray, " k"]
    carry: Float64[np.ndarray, "k 3 q"]
    own: Float64[np.ndarray, "k 3 3"]

    @property
    def places(self) -> Float64[np.ndarray, "k 3"]:
        """The ground points, world metres."""
        return np.asarray(self.adjusted.block.points[self.points])

    def cameras(self) -> Float64[np.ndarray, "q q"]:
        """Covariance of the unknowns without the offsets."""
        q = self.adjusted.block.unknowns
        return self.covariance[:q, :q]

    def ground_sigmas(self) -> Float64[np.ndarray, "k 3"]:
        """Standard deviations of the ground points, metres."""
        carried = np.einsum("kaq,qr,kar->ka", self.carry, self.cameras(), self.carry, optimize=True)
        return np.asarray(np.sqrt(carried + np.diagonal(self.own, axis1=1, axis2=2)))

    def mean_sigmas(self) -> Float64[np.ndarray, " 3"]:
        """Standard deviations of the ground's mean position: what all of it is off by together, metres."""
        mean = self.carry.mean(axis=0)
        return np.asarray(np.sqrt(np.einsum("aq,qr,ar->a", mean, self.cameras(), mean, optimize=True)))

    def lens_sigmas(self) -> list[Float64[np.ndarray, "k k"]]:
        """Covariance of each lens's free parameters."""
        return [self.covariance[where, where] for where in self.adjusted.block.lens_slices]


def accuracy_of(adjusted: AdjustedBlock, observed: PositionObservations) -> BlockAccuracy:
    """Propagate the errors of all observations; of very many photos, those of a part, which knows a little less."""
    if len(adjusted.block) > MAX_PHOTOS:
        adjusted, observed = _middle(adjusted, observed)
    block = adjusted.block
    normal, _ = joint_system(adjusted.reduced, observed, block, adjusted.offsets)
    covariance = solve(normal, np.eye(len(normal)))
    views = np.bincount(block.point, minlength=len(block.points))
    away = np.linalg.norm(block.points[block.point] - block.centres[block.photo], axis=1)
    distance = np.bincount(block.point, weights=away, minlength=len(views)) / np.maximum(views, 1)
    near = distance <= MAX_DISTANCE_RATIO * float(np.median(away)) if len(away) else np.ones(0, dtype=bool)
    seen = np.flatnonzero((views >= MIN_VIEWS) & (block.weights[:, 0] == 0.0) & near)
    chosen = seen[:: max(1, math.ceil(len(seen) / GROUND_POINTS))]
    return BlockAccuracy(
        adjusted,
        observed,
        0.5 * (covariance + covariance.T),
        chosen,
        ground_carry(adjusted.reduced, chosen.tolist()),
        adjusted.reduced.own[chosen],
    )


def _middle(adjusted: AdjustedBlock, observed: PositionObservations) -> tuple[AdjustedBlock, PositionObservations]:
    """The photos in the middle of the order of names, which is mostly that of capture, as a block of their own."""
    first = (len(adjusted.block) - MAX_PHOTOS) // 2
    photos = np.zeros(len(adjusted.block), dtype=bool)
    photos[first : first + MAX_PHOTOS] = True
    block, used = part_of(adjusted.block, photos), photos[observed.photo]
    part = PositionObservations(
        observed.photo[used] - first,
        observed.stated[used],
        observed.precision[:, used][:, :, used],
        observed.group[used],
        observed.offset_sigmas,
    )
    return replace(adjusted, block=block, reduced=reduce_block(block)), part


def camera_accuracy(accuracy: BlockAccuracy) -> dict[str, float | list[float]]:
    """Standard deviations of the frame that the cameras make: mean position (metres), north and up (radians), scale."""
    block = accuracy.adjusted.block
    n = len(block)
    centres = slice(3 * n, 6 * n)
    design = similarity_jacobian(Similarity.identity(), block.centres).reshape(3 * n, -1)
    back = np.linalg.pinv(design)
    known = back @ accuracy.covariance[centres, centres] @ back.T
    return {
        "offset_m": np.sqrt(np.diag(known)[4:7]).tolist(),
        "north_rad": math.sqrt(max(known[2, 2], 0.0)),
        "up_rad": math.sqrt(max(float(np.trace(known[:2, :2])), 0.0)),
        "scale": math.sqrt(max(known[3, 3], 0.0)),
    }


@dataclass(frozen=True)
class Remedy:
    """What another observation would make of the ground's heights.

    Attributes:
        height_sigma_m: Standard deviation of the mean height of the ground with it.
        places: World positions of the control points; empty for photos.
    """

    height_sigma_m: float
    places: tuple[tuple[float, float, float], ...] = ()

    def as_json(self) -> dict[str, Any]:
        """The entry in ``accuracy.json``."""
        return {
            "height_sigma_m": round(self.height_sigma_m, 4),
            "places_m": [[round(value, 2) for value in place] for place in self.places],
        }


def with_control(accuracy: BlockAccuracy, counts: Sequence[int] = (1, 3)) -> dict[int, Remedy]:
    """Predict the accuracy with control points, each where it helps most.

    Args:
        accuracy: Without them.
        counts: Numbers of points, ascending.
    """
    covariance = accuracy.cameras()
    mean = accuracy.carry[:, 2].mean(axis=0)
    sigma = float(accuracy.adjusted.block.sigmas.mean())
    survey = np.diag(np.square(CONTROL_SIGMAS_M)) + accuracy.own * (MARK_SIGMA_PX / sigma) ** 2
    result: dict[int, Remedy] = {}
    places: list[tuple[float, float, float]] = []
    for count in range(1, max(counts) + 1):
        if not len(accuracy.points):
            break
        carried = accuracy.carry @ covariance  # (k, 3, q)
        spread = np.einsum("kaq,kbq->kab", carried, accuracy.carry, optimize=True) + survey
        crossed = carried @ mean  # (k, 3)
        gains = np.einsum("ka,ka->k", crossed, np.linalg.solve(spread, crossed[:, :, None])[:, :, 0])
        scores = gains - 1e9 * np.array([tuple(place) in places for place in accuracy.places.tolist()])
        best = int(np.argmax(scores)) if count == 1 else _farthest(accuracy, scores, places)
        places.append(tuple(accuracy.places[best].tolist()))
        covariance = covariance - carried[best].T @ np.linalg.solve(spread[best], carried[best])
        if count in counts:
            result[count] = Remedy(math.sqrt(max(float(mean @ covariance @ mean), 0.0)), tuple(places))
    return result


def _farthest(
    accuracy: BlockAccuracy, scores: Float64[np.ndarray, " k"], places: Sequence[tuple[float, float, float]]
) -> int:
    """Of the points, the one farthest from those chosen: control belongs around the site."""
    away = np.min([np.linalg.norm(accuracy.places[:, :2] - np.array(place)[:2], axis=1) for place in places], axis=0)
    return int(np.argmax(np.where(scores > -1e8, away, -1.0)))


def with_cross_strip(accuracy: BlockAccuracy) -> Remedy | None:
    """Predict the accuracy with a strip of photos across the block at another height, positions as good as the others'.

    Returns:
        None where the block has too few photos straight down to say where it would be.
    """
    block = _with_strip(accuracy.adjusted.block)
    if block is None:
        return None
    observed = accuracy.observed
    n, extra = len(accuracy.adjusted.block), len(block) - len(accuracy.adjusted.block)
    count = len(observed)
    precision = np.zeros((3, count + extra, count + extra))
    precision[:, :count, :count] = observed.precision
    for axis in range(3):
        own = float(np.median(np.diag(observed.precision[axis])))
        precision[axis, count:, count:] = own * np.eye(extra)
    joined = PositionObservations(
        np.concatenate([observed.photo, np.arange(n, n + extra)]),
        np.concatenate([observed.stated, block.centres[n:]]),
        precision,
        np.concatenate([observed.group, np.full(extra, observed.group[0])]),
        observed.offset_sigmas,
    )
    reduced: ReducedBlock = reduce_block(block)
    wider = AdjustedBlock(block, accuracy.adjusted.offsets, reduced, 0.0, True)
    normal, _ = joint_system(reduced, joined, block, accuracy.adjusted.offsets)
    q = block.unknowns
    mean = ground_carry(wider.reduced, accuracy.points.tolist())[:, 2].mean(axis=0)
    carried = solve(normal, np.concatenate([mean, np.zeros(normal.shape[0] - q)]))[:q]
    return Remedy(math.sqrt(max(float(mean @ carried), 0.0)))


def _with_strip(block: Block) -> Block | None:
    """The block with photos of its tie points from another height, across its longer side."""
    down = block.rotations[:, 2, 2] < -0.9
    if down.sum() < 3 or not len(block.points):
        return None
    plan = block.centres[down][:, :2]
    middle = plan.mean(axis=0)
    _, _, axes = np.linalg.svd(plan - middle, full_matrices=False)
    ground = float(np.median(block.points[:, 2]))
    height = float(np.median(block.centres[down][:, 2])) - ground
    reach = float(np.abs((plan - middle) @ axes[1]).max())
    count = int(np.clip(len(block) ** 0.5, 4, MAX_CROSS))
    first = int(np.flatnonzero(down)[0])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotation = block.rotations[first] @ turn.T
    along = np.linspace(-reach, reach, count)[:, None] * axes[1]
    centres = np.column_stack([middle + along, np.full(count, ground + (1.0 + CROSS_STRIP_RISE) * height)])
    lens = block.lenses[int(block.lens_of[first])]
    photo, point, pixels = [], [], []
    for k, centre in enumerate(centres):
        rays = (block.points - centre) @ rotation.T
        ahead = rays[:, 2] > 0.1
        projected = np.full((len(rays), 2), np.nan)
        projected[ahead] = np.asarray(lens.camera.img_from_cam(rays[ahead]), np.float64)
        size = np.array([lens.camera.width, lens.camera.height])
        slope = np.hypot(rays[:, 0], rays[:, 1]) < 1.5 * np.maximum(rays[:, 2], 1e-9)
        inside = ((projected > 0.0) & (projected < size)).all(axis=1) & slope
        seen = np.flatnonzero(inside)
        photo.append(np.full(len(seen), len(block) + k))
        point.append(seen)
        pixels.append(projected[seen])
    order = np.argsort(np.concatenate([block.point, *point]), kind="stable")
    added = sum(map(len, point))
    return replace(
        block,
        rotations=np.concatenate([block.rotations, np.tile(rotation, (count, 1, 1))]),
        centres=np.concatenate([block.centres, centres]),
        lens_of=np.concatenate([block.lens_of, np.full(count, block.lens_of[first])]),
        photo=np.concatenate([block.photo, *photo])[order].astype(np.int64),
        point=np.concatenate([block.point, *point])[order].astype(np.int64),
        pixels=np.concatenate([block.pixels, *pixels])[order],
        sigmas=np.concatenate([block.sigmas, np.full(added, float(block.sigmas.mean()))])[order],
    )


def ninety_five(sigma: float) -> float:
    """Half of the interval that holds 95 of 100 normal errors."""
    return NORMAL_95 * sigma
