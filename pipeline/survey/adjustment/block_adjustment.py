"""Adjust a block to camera positions: Gauss-Newton steps of its normal equations, damped where they do not help."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float64, Int64

from splatpipe.pipeline.survey.adjustment.block import Block, Normal, ReducedBlock, reduce_block, settle_points

ROUNDS = 60
MIN_DECREASE = 1e-3  # decrease of the sum of squares: a thirtieth of a standard deviation
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-12, 1e8
# factors on the damping: after a step that helped, the same once one has not, after one that did not help
EASIER, CAUTIOUS, HARDER = 0.01, 0.3, 10.0


@dataclass(frozen=True)
class PositionObservations:
    """Stated positions of a block's photos.

    Attributes:
        photo: Index of the photo of each.
        stated: World metres.
        precision: Inverse covariance of the errors along each axis.
        group: Index of each one's flight.
        offset_sigmas: Standard deviations of each flight's common error, metres.
    """

    photo: Int64[np.ndarray, " k"]
    stated: Float64[np.ndarray, "k 3"]
    precision: Float64[np.ndarray, "3 k k"]
    group: Int64[np.ndarray, " k"]
    offset_sigmas: Float64[np.ndarray, "g 3"]

    def __len__(self) -> int:
        return len(self.photo)

    def errors(self, block: Block, offsets: Float64[np.ndarray, "g 3"]) -> Float64[np.ndarray, "k 3"]:
        """Adjusted position plus its flight's offset less the stated position, metres."""
        return np.asarray(block.centres[self.photo] + offsets[self.group] - self.stated)

    def cost(self, block: Block, offsets: Float64[np.ndarray, "g 3"]) -> float:
        """The positions' part of the sum of squares."""
        errors = self.errors(block, offsets)
        own = float(np.einsum("ka,akl,la->", errors, self.precision, errors))
        return own + float(((offsets / self.offset_sigmas) ** 2).sum())


@dataclass(frozen=True)
class AdjustedBlock:
    """A block at the minimum of its sum of squares.

    Attributes:
        block: Its state.
        offsets: Each flight's common error, stated less true, metres.
        reduced: Its normal equations there, without the positions.
        cost: The sum of squares.
        converged: Whether the minimum was reached.
    """

    block: Block
    offsets: Float64[np.ndarray, "g 3"]
    reduced: ReducedBlock
    cost: float
    converged: bool


def adjust_block(
    block: Block,
    positions: PositionObservations,
    offsets: Float64[np.ndarray, "g 3"] | None = None,
    rounds: int = ROUNDS,
) -> AdjustedBlock:
    """Adjust photos, lenses, tie points and the flights' offsets together.

    Args:
        block: Near the solution.
        positions: Of its photos.
        offsets: The flights' initial ones; zero by default.
        rounds: Steps at most.
    """
    if offsets is None:
        offsets = np.zeros_like(positions.offset_sigmas)
    cost, converged = block.cost() + positions.cost(block, offsets), False
    damping, easier = DAMPING, EASIER
    reduced = reduce_block(block)
    for _ in range(rounds):
        normal, gradient = joint_system(reduced, positions, block, offsets)
        step = solve(_damped(normal, damping), -gradient)
        gain = -float(gradient @ step)
        if gain < MIN_DECREASE:
            converged = True
            break
        moved = block.moved(step[: block.unknowns], reduced.points_after(step[: block.unknowns]))
        moved = settle_points(moved)
        shifted = offsets + step[block.unknowns :].reshape(-1, 3)
        after = moved.cost() + positions.cost(moved, shifted)

        if after < cost:
            block, offsets, damping = moved, shifted, max(easier * damping, LEAST_DAMPING)
            converged = cost - after < MIN_DECREASE
            cost = after
            reduced = reduce_block(block)
            if converged:
                break
        elif damping > MOST_DAMPING:
            break
        else:
            damping, easier = HARDER * damping, CAUTIOUS
    return AdjustedBlock(block, offsets, reduced, cost, converged)


def joint_system(
    reduced: ReducedBlock, positions: PositionObservations, block: Block, offsets: Float64[np.ndarray, "g 3"]
) -> tuple[Normal, Float64[np.ndarray, " r"]]:
    """Normal matrix and gradient with positions: the block's unknowns, then the flights' offsets."""
    q, n, groups = block.unknowns, len(block), len(positions.offset_sigmas)
    if scipy.sparse.issparse(reduced.normal):
        normal = scipy.sparse.lil_array((q + 3 * groups, q + 3 * groups))
    else:
        normal = np.zeros((q + 3 * groups, q + 3 * groups))
        normal[:q, :q] = reduced.normal
    gradient = np.concatenate([reduced.gradient, np.zeros(3 * groups)])
    errors = positions.errors(block, offsets)
    member = (positions.group[:, None] == np.arange(groups)).astype(np.float64)
    for axis in range(3):
        precision = positions.precision[axis]
        centres = 3 * n + 3 * positions.photo + axis
        shared = q + 3 * np.arange(groups) + axis
        crossed = precision @ member
        if scipy.sparse.issparse(normal):
            across, along = np.nonzero(precision)
            normal[centres[across], centres[along]] = precision[across, along]
        else:
            normal[np.ix_(centres, centres)] += precision
        normal[np.ix_(centres, shared)] += crossed
        normal[np.ix_(shared, centres)] += crossed.T
        normal[np.ix_(shared, shared)] += member.T @ crossed
        weighted = precision @ errors[:, axis]
        gradient[centres] += weighted
        gradient[shared] += member.T @ weighted
    index = np.arange(q, q + 3 * groups)
    normal[index, index] += (1.0 / positions.offset_sigmas**2).ravel()
    if scipy.sparse.issparse(normal):
        wider = scipy.sparse.csr_array(reduced.normal)
        wider.resize(normal.shape)
        normal = normal.tocsr() + wider
    gradient[index] += (offsets / positions.offset_sigmas**2).ravel()
    return normal, gradient


def solve(normal: Normal, right: Float64[np.ndarray, " r *k"]) -> Float64[np.ndarray, " r *k"]:
    """Solve a positive definite system whose unknowns differ in size; undetermined directions stay put."""
    if scipy.sparse.issparse(normal):
        return _solve_sparse(normal, right)
    diagonal = np.diag(normal)
    sizes = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = normal / sizes[:, None] / sizes[None, :]
    scale = sizes if right.ndim == 1 else sizes[:, None]
    factor = factorised(scaled)
    return np.asarray(scipy.linalg.cho_solve((factor, True), right / scale, check_finite=False) / scale)


def factorised(scaled: Float64[np.ndarray, "r r"]) -> Float64[np.ndarray, "r r"]:
    """Lower Cholesky factor of a matrix with ones on its diagonal; the diagonal is raised where rounding demands it.

    Raises:
        np.linalg.LinAlgError: if it is not finite.
    """
    ridge = 0.0
    while ridge < 1.0:
        try:
            return np.asarray(scipy.linalg.cholesky(scaled + ridge * np.eye(len(scaled)), lower=True))
        except np.linalg.LinAlgError:
            ridge = max(100.0 * ridge, 1e-13)
        except ValueError:
            break
    raise np.linalg.LinAlgError("the normal equations are not finite")


def _solve_sparse(normal: scipy.sparse.csr_array, right: Float64[np.ndarray, " r *_"]) -> Float64[np.ndarray, " r *_"]:
    diagonal = normal.diagonal()
    sizes = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scale = scipy.sparse.diags_array(1.0 / sizes)
    scaled = scale @ normal @ scale + 1e-13 * scipy.sparse.eye_array(len(sizes))
    factor = scipy.sparse.linalg.splu(
        scipy.sparse.csc_array(scaled),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    over = sizes if right.ndim == 1 else sizes[:, None]
    return np.asarray(factor.solve(right / over) / over)


def _damped(normal: Normal, damping: float) -> Normal:
    """A normal matrix with its diagonal raised by a share."""
    if scipy.sparse.issparse(normal):
        return normal + scipy.sparse.diags_array(damping * normal.diagonal())
    return normal + np.diag(damping * np.diag(normal))
