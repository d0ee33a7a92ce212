"""A photogrammetric block: photos, lenses and tie points as arrays, and the normal equations of its adjustment.

The unknowns of all photos and lenses form one dense system, from which the tie points are eliminated (the reduced
system of bundle adjustment: Brown 1958; Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6). All
that depends on the cameras alone follows from it: their adjustment, their covariance, the covariance of ground points,
and what another observation would change.

Unknowns, in this order: a rotation vector of each photo (radians, in the camera's axes), the projection centre of each
photo (metres), and the free parameters of each lens.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.similarity import cross_matrix, rotation_from_vector
from splatpipe.pipeline.survey.adjustment.block_distances import NO_DISTANCES, Distances, JoinedPoints
from splatpipe.pipeline.survey.adjustment.block_lens import MIN_DEPTH, Lens, lens_derivatives, project

MAX_DENSE = 6000  # unknowns of a dense system: a thousand photos
MIN_EIGENVALUE_RATIO = 1e-12  # least ratio of a tie point's eigenvalues: nearly parallel rays


# A symmetric matrix of normal equations: an array, or scipy's sparse array for very many unknowns.
Normal = Any


@dataclass(frozen=True)
class Block:
    """Photos, lenses and tie points in world metres.

    Attributes:
        rotations: World to camera.
        centres: Projection centres.
        lens_of: Index of each photo's lens.
        lenses: The lenses.
        points: Tie points and control points.
        photo: Of each observation.
        point: Of each observation, ascending.
        pixels: Of each observation.
        sigmas: Standard deviations of the observations, pixels.
        stated: Surveyed positions of points; anything finite where unknown.
        weights: Inverse variances of ``stated``; 0 where unknown.
        distances: Measured between points: scale bars.
    """

    rotations: Float64[np.ndarray, "n 3 3"]
    centres: Float64[np.ndarray, "n 3"]
    lens_of: Int64[np.ndarray, " n"]
    lenses: tuple[Lens, ...]
    points: Float64[np.ndarray, "p 3"]
    photo: Int64[np.ndarray, " m"]
    point: Int64[np.ndarray, " m"]
    pixels: Float64[np.ndarray, "m 2"]
    sigmas: Float64[np.ndarray, " m"]
    stated: Float64[np.ndarray, "p 3"]
    weights: Float64[np.ndarray, "p 3"]
    distances: Distances = NO_DISTANCES

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def lens_slices(self) -> list[slice]:
        """The unknowns of each lens."""
        ends = 6 * len(self) + np.cumsum([0] + [len(lens.names) for lens in self.lenses])
        return [slice(a, b) for a, b in itertools.pairwise(ends.tolist())]

    @property
    def unknowns(self) -> int:
        """The number of unknowns without the tie points."""
        return 6 * len(self) + sum(len(lens.names) for lens in self.lenses)

    def moved(self, step: Float64[np.ndarray, " q"], shifts: Float64[np.ndarray, "p 3"]) -> Block:
        """The block after a step of its unknowns and shifts of its tie points.

        What all photos turn by alike is applied as a rotation of the whole block: along the tangent, a turn that only
        loose control resists would stretch the block, and steps would have to stay small.
        """
        n = len(self)
        turns, shift = step[: 3 * n].reshape(n, 3), step[3 * n : 6 * n].reshape(n, 3)
        turned = -np.einsum("nij,ni->nj", self.rotations, turns).mean(axis=0)  # world axes, radians
        rotation, tangent, pivot = rotation_from_vector(turned), cross_matrix(turned), self.centres.mean(axis=0)

        def placed(places: Float64[np.ndarray, "k 3"], by: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3"]:
            around = places - pivot
            return np.asarray(pivot + (around + by - around @ tangent.T) @ rotation.T)

        return replace(
            self,
            rotations=rotation_from_vector(turns + self.rotations @ turned) @ self.rotations @ rotation.T,
            centres=placed(self.centres, shift),
            lenses=tuple(lens.moved(step[where]) for lens, where in zip(self.lenses, self.lens_slices, strict=True)),
            points=placed(self.points, shifts),
        )

    def residuals(self) -> Float64[np.ndarray, "m 2"]:
        """Projected less observed, over the standard deviations; not finite where a point is behind its camera."""
        rays = self._rays()
        projected = np.full((len(rays), 2), np.nan)
        for number, lens in enumerate(self.lenses):
            rows = (self.lens_of[self.photo] == number) & (rays[:, 2] > MIN_DEPTH)
            projected[rows] = project(lens.camera, rays[rows])
        return np.asarray((projected - self.pixels) / self.sigmas[:, None])

    def cost(self) -> float:
        """Sum of squares of all weighted residuals, positions apart; infinite where the block has come apart."""
        total = float((self.residuals() ** 2).sum()) + float((self.weights * (self.points - self.stated) ** 2).sum())
        total += float((self.distances.residuals(self.points) ** 2).sum())
        for lens in self.lenses:
            total += float((((lens.values - lens.mean) / lens.sigmas) ** 2).sum())
        return total if np.isfinite(total) else np.inf

    def _rays(self) -> Float64[np.ndarray, "m 3"]:
        away = self.points[self.point] - self.centres[self.photo]
        return np.asarray(np.einsum("mij,mj->mi", self.rotations[self.photo], away))


@dataclass(frozen=True)
class ReducedBlock:
    """Normal equations of a block's cameras at its present state, for a sum of squares.

    Attributes:
        normal: (q, q) information of photos and lenses with the tie points eliminated, priors of lenses included;
            sparse for very many photos.
        gradient: (q,) half of the derivative of the sum of squares.
        own: (p, 3, 3) covariance of each tie point for known cameras.
        shift: (p, 3) step of each tie point for unmoved cameras.
        carry: (3p, q) sparse derivative of the tie points by the unknowns.
    """

    normal: Normal
    gradient: Float64[np.ndarray, " q"]
    own: Float64[np.ndarray, "p 3 3"]
    shift: Float64[np.ndarray, "p 3"]
    carry: scipy.sparse.csr_array

    def points_after(self, step: Float64[np.ndarray, " q"]) -> Float64[np.ndarray, "p 3"]:
        """Steps of the tie points that go with a step of the unknowns."""
        return np.asarray(self.shift + (self.carry @ step).reshape(-1, 3))


def reduce_block(block: Block) -> ReducedBlock:
    """Linearise a block and eliminate its tie points."""
    pose, lens_columns, point, residual = _jacobians(block)
    q, p = block.unknowns, len(block.points)
    starts = np.searchsorted(block.point, np.arange(p))
    information = _summed(np.einsum("mka,mkb->mab", point, point), starts, block.point, p)
    diagonal = np.arange(3)
    information[:, diagonal, diagonal] += block.weights
    gradient_points = _summed(np.einsum("mka,mk->ma", point, residual), starts, block.point, p)
    gradient_points += block.weights * (block.points - block.stated) + _pull(block)
    information[:, diagonal, diagonal] += (
        MIN_EIGENVALUE_RATIO * np.trace(information, axis1=1, axis2=2)[:, None] + 1e-30
    )
    root = np.linalg.cholesky(information)  # information = root root'
    inverse_root = np.linalg.inv(root)
    own = np.swapaxes(inverse_root, 1, 2) @ inverse_root
    shift = -np.einsum("pab,pb->pa", own, gradient_points)

    columns = _columns(block)  # (m, 6 + l), -1 for none
    every = np.concatenate([pose, lens_columns], axis=2)
    crossed = np.einsum("mka,mkc->mac", point, every)  # (m, 3, 6 + l)
    whitened = inverse_root[block.point] @ crossed
    rows = np.broadcast_to((3 * block.point)[:, None, None] + diagonal[:, None], whitened.shape)
    cols = np.broadcast_to(columns[:, None, :], whitened.shape)
    used = cols >= 0
    half = scipy.sparse.csr_array((whitened[used], (rows[used], cols[used])), shape=(3 * p, q))
    carried = (np.swapaxes(inverse_root, 1, 2)[block.point]) @ whitened
    carry = scipy.sparse.csr_array((-carried[used], (rows[used], cols[used])), shape=(3 * p, q))

    normal = _direct(every, columns, block) - half.T @ half
    gradient = np.zeros(q)
    direct = np.einsum("mkc,mk->mc", every, residual)
    np.add.at(gradient, columns[columns >= 0], direct[columns >= 0])
    gradient -= half.T @ np.einsum("pab,pb->pa", inverse_root, gradient_points).ravel()
    prior = np.zeros(q)
    for lens, where in zip(block.lenses, block.lens_slices, strict=True):
        known = 1.0 / lens.sigmas**2
        prior[where] = known
        gradient[where] += known * (lens.values - lens.mean)
    normal = 0.5 * (normal + normal.T) + scipy.sparse.diags_array(prior)
    dense = normal if q > MAX_DENSE else np.asarray(normal.todense())
    return _with_distances(ReducedBlock(dense, gradient, own, shift, carry), block)


def _pull(block: Block) -> Float64[np.ndarray, "p 3"]:
    """Gradient of the distances by the points."""
    bars = block.distances
    if not len(bars):
        return np.zeros_like(block.points)
    return np.asarray(bars.design(block.points).T @ bars.residuals(block.points)).reshape(-1, 3)


def _with_distances(reduced: ReducedBlock, block: Block) -> ReducedBlock:
    """Add distances to equations whose gradient has them already."""
    if not len(block.distances):
        return reduced
    joined = JoinedPoints.of(block.distances, block.points, reduced.own)
    crossed = scipy.sparse.csr_array(joined.design @ reduced.carry)
    weighed = scipy.sparse.csr_array(joined.inverse @ crossed.todense())
    own = reduced.own.copy()
    for point in np.unique(block.distances.ends).tolist():
        mine = joined.spread[3 * point : 3 * point + 3].todense()
        own[point] -= mine @ joined.inverse @ mine.T
    added = crossed.T @ weighed
    return ReducedBlock(
        reduced.normal + (added if scipy.sparse.issparse(reduced.normal) else added.todense()),
        reduced.gradient + weighed.T @ (joined.design @ reduced.shift.ravel()),
        own,
        joined.corrected(reduced.shift),
        scipy.sparse.csr_array(reduced.carry - joined.spread @ weighed),
    )


def settle_points(block: Block, rounds: int = 2) -> Block:
    """Move the tie points to where their observations want them for the cameras as they are."""
    p, diagonal = len(block.points), np.arange(3)
    starts = np.searchsorted(block.point, np.arange(p))
    for _ in range(rounds):
        _, _, point, residual = _jacobians(block, lenses=False)
        information = _summed(np.einsum("mka,mkb->mab", point, point), starts, block.point, p)
        information[:, diagonal, diagonal] += block.weights
        information[:, diagonal, diagonal] += (
            MIN_EIGENVALUE_RATIO * np.trace(information, axis1=1, axis2=2)[:, None] + 1e-30
        )
        gradient = _summed(np.einsum("mka,mk->ma", point, residual), starts, block.point, p)
        gradient += block.weights * (block.points - block.stated) + _pull(block)
        step = -np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        if len(block.distances):
            step = JoinedPoints.of(block.distances, block.points, np.linalg.inv(information)).corrected(step)
        block = replace(block, points=block.points + step)
    return block


def _direct(
    every: Float64[np.ndarray, "m 2 c"], columns: Int64[np.ndarray, "m c"], block: Block
) -> scipy.sparse.csr_array:
    """The cameras' own part of the normal matrix, summed photo by photo."""
    rows_of, columns_of, values = [], [], []
    order = np.argsort(block.photo, kind="stable")
    starts = np.searchsorted(block.photo[order], np.arange(len(block) + 1))
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        if start == end:
            continue
        rows = order[start:end]
        used = columns[rows[0]] >= 0
        design = every[rows][:, :, used].reshape(-1, int(used.sum()))
        where = columns[rows[0]][used]
        values.append((design.T @ design).ravel())
        rows_of.append(np.repeat(where, len(where)))
        columns_of.append(np.tile(where, len(where)))
    at = (np.concatenate(rows_of), np.concatenate(columns_of)) if values else (np.zeros(0, int), np.zeros(0, int))
    flat = np.concatenate(values) if values else np.zeros(0)
    return scipy.sparse.csr_array((flat, at), shape=(block.unknowns, block.unknowns))


def part_of(block: Block, photos: Bool[np.ndarray, " n"]) -> Block:
    """The block of some photos, with all its lenses and the points that two of them see or a survey knows."""
    rows = photos[block.photo]
    views = np.bincount(block.point[rows], minlength=len(block.points))
    seen = (views >= 2) | ((block.weights > 0.0).any(axis=1) & (views > 0))
    rows &= seen[block.point]
    return replace(
        block,
        rotations=block.rotations[photos],
        centres=block.centres[photos],
        lens_of=block.lens_of[photos],
        points=block.points[seen],
        photo=(np.cumsum(photos) - 1)[block.photo[rows]],
        point=(np.cumsum(seen) - 1)[block.point[rows]],
        pixels=block.pixels[rows],
        sigmas=block.sigmas[rows],
        stated=block.stated[seen],
        weights=block.weights[seen],
        distances=block.distances.of_points(seen),
    )


def _columns(block: Block) -> Int64[np.ndarray, "m c"]:
    """The unknowns that each observation depends on: rotation, centre, lens; -1 beyond its lens's parameters."""
    n, widest = len(block), max((len(lens.names) for lens in block.lenses), default=0)
    of_lens = np.full((len(block.lenses), widest), -1, dtype=np.int64)
    for number, where in enumerate(block.lens_slices):
        of_lens[number, : where.stop - where.start] = np.arange(where.start, where.stop)
    axes = np.arange(3)
    rotation = 3 * block.photo[:, None] + axes
    return np.concatenate([rotation, rotation + 3 * n, of_lens[block.lens_of[block.photo]]], axis=1)


def _jacobians(
    block: Block, lenses: bool = True
) -> tuple[
    Float64[np.ndarray, "m 2 6"],
    Float64[np.ndarray, "m 2 l"],
    Float64[np.ndarray, "m 2 3"],
    Float64[np.ndarray, "m 2"],
]:
    """Derivatives of the weighted residuals by pose, lens (zeros if not asked for) and point, and the residuals."""
    rays = block._rays()
    m, widest = len(rays), max((len(lens.names) for lens in block.lenses), default=0)
    by_ray, by_lens, projected = np.zeros((m, 2, 3)), np.zeros((m, 2, widest)), np.zeros((m, 2))
    for number, lens in enumerate(block.lenses):
        rows = np.flatnonzero(block.lens_of[block.photo] == number)
        by_ray[rows], by_lens[rows, :, : len(lens.names)], projected[rows] = lens_derivatives(lens, rays[rows], lenses)
    turned = block.rotations[block.photo]
    by_point = by_ray @ turned
    by_turn = -by_ray @ cross_matrix(rays)
    scale = 1.0 / block.sigmas[:, None, None]
    residual = (projected - block.pixels) / block.sigmas[:, None]
    sound = np.isfinite(residual).all(axis=1) & (rays[:, 2] > MIN_DEPTH)
    scale = np.where(sound[:, None, None], scale, 0.0)
    pose = scale * np.nan_to_num(np.concatenate([by_turn, -by_point], axis=2))
    residual = np.where(sound[:, None], residual, 0.0)
    return pose, scale * np.nan_to_num(by_lens), scale * np.nan_to_num(by_point), residual


def _summed(
    values: Float64[np.ndarray, " m *r"], starts: Int64[np.ndarray, " p"], point: Int64[np.ndarray, " m"], p: int
) -> Float64[np.ndarray, " p *r"]:
    """Sums over each point's observations, which are contiguous; zeros for a point without any."""
    result = np.zeros((p, *values.shape[1:]))
    seen = np.bincount(point, minlength=p) > 0
    if len(values):
        result[seen] = np.add.reduceat(values, starts[seen], axis=0)
    return result


def ground_carry(reduced: ReducedBlock, points: Sequence[int]) -> Float64[np.ndarray, "k 3 q"]:
    """Dense derivative of some tie points by the unknowns."""
    rows = (3 * np.asarray(points, dtype=np.int64)[:, None] + np.arange(3)).ravel()
    return np.asarray(reduced.carry[rows].todense()).reshape(len(points), 3, -1)
