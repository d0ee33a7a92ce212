"""Look for another arrangement of the cameras that explains more of the verified matches than a model does.

Pairs that contradict a right model are wrong matches, of windows or tiles that repeat: no arrangement of the cameras
explains them without losing more than it gains. Pairs that contradict a bent or ghosted model are right, and the true
arrangement explains nearly all of them. So a model is refuted by what is found, not by the number of contradictions.

Poses are adjusted to the epipolar lines of all pairs' matches, without points, by graduated non-convexity (Yang et al.,
RA-L 2020) with Geman and McClure's loss: wide at first, with more weight for the contradicting pairs, and in the end as
narrow as the judge's own bound. It starts from the model, once more with a narrow loss alone, and from models in which
a group of cameras is moved by the similarity that its contradicting pairs ask for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.robust import absolute_weights
from splatpipe.pipeline.geometry.similarity import rotation_from_vector
from splatpipe.pipeline.sfm.judging.agreement import EXPLAINED_PX, Agreement, Rays, compare, contradicting
from splatpipe.pipeline.sfm.judging.cuts import find_cut
from splatpipe.pipeline.sfm.model.pixel_tolerance_scale import pixel_tolerance_scale
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

SAMPLE = 24  # matches per pair: the adjustment has six unknowns per photo
LOSS_WIDTHS = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0)  # widths of the robust loss, times EXPLAINED_PX, one after another
GAUSS_NEWTON_STEPS = 4  # Gauss-Newton steps at each width
CONTRADICTION_WEIGHT, MIN_FAVOURED_WIDTH = 4.0, 8.0  # weight of contradicting pairs from that width of the loss on
MOVED_LOSS_WIDTHS = (4.0, 2.0, 1.0)  # where a group was moved: its place is nearly right
SLIGHT_LOSS_WIDTHS = (2.0, 1.0)  # for a slight bend among many wrong pairs, which a wider loss would follow
DAMPING = 1e-4  # added share of the normal matrix' diagonal: the world's frame and chains of photos are undetermined
IRLS_ROUNDS = 10  # rounds of the reweighted fit of a group's place
WEAK_SCALE = 0.01  # weight of a group's scale staying as it is: a single line of sight leaves it open
MAX_MOVED_GROUPS = 3  # groups of photos moved at most, one after another
MIN_CONTRADICTION_RATIO = 0.5  # contradicting over agreeing matches of a group with the others
MAX_LINKS = 16  # two-view geometries for a group's place, those of the most matches
MIN_SAMPLED_GAIN = 0.003  # gain of the sampled score that is worth a full comparison: below the least that matters
LINK_SAMPLE = 100  # matches for a two-view geometry
DIGITS = 6  # decimals of angles that are compared: the last ones vary with the number of threads
TURN_MOST = 0.2  # radians a step; more is outside of the linearisation


@dataclass(frozen=True)
class Samples:
    """Sampled matches of the pairs that are rearranged, as rays in the cameras' frames.

    Attributes:
        ends: (n, 2) rows of the pairs' photos.
        first: (n, s, 3) unit rays in the first photo.
        second: The same in the second.
        weights: (n, s), 0 where a pair has fewer matches; a pair's add up to the square root of its matches.
        bounds: (n,) ``EXPLAINED_PX`` in units of the focal length.
    """

    ends: Int64[np.ndarray, "n 2"]
    first: Float64[np.ndarray, "n s 3"]
    second: Float64[np.ndarray, "n s 3"]
    weights: Float64[np.ndarray, "n s"]
    bounds: Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Arrangement:
    """Poses of cameras.

    Attributes:
        turns: (m, 3, 3) world from camera.
        centres: (m, 3).
    """

    turns: Float64[np.ndarray, "m 3 3"]
    centres: Float64[np.ndarray, "m 3"]

    def matrices(self) -> Float64[np.ndarray, "m 3 4"]:
        """Return camera from world."""
        back = self.turns.transpose(0, 2, 1)
        return np.concatenate([back, -back @ self.centres[:, :, None]], axis=2)


def arrangement_of(model: pycolmap.Reconstruction, numbers: Sequence[int]) -> Arrangement:
    """Return the poses of some photos of a model, scaled to a root mean square distance of 1 from their mean."""
    poses = np.array([model.images[number].cam_from_world().matrix() for number in numbers])
    turns = poses[:, :, :3].transpose(0, 2, 1)
    centres = -(turns @ poses[:, :, 3:])[:, :, 0]
    centres = centres - centres.mean(axis=0)
    return Arrangement(turns, centres / max(float(np.sqrt((centres**2).sum(axis=1).mean())), 1e-12))


def sample(
    model: pycolmap.Reconstruction, verified: ViewGraph, agreement: Agreement, rays: Mapping[int, Rays]
) -> Samples:
    """Return evenly strided matches of all pairs of placed photos."""
    rows = np.flatnonzero(agreement.placed)
    row_of = {number: row for row, number in enumerate(sorted(rays))}
    units = {number: _unit(each) for number, each in rays.items()}
    first, second = np.zeros((len(rows), SAMPLE, 3)), np.zeros((len(rows), SAMPLE, 3))
    first[:, :, 2] = second[:, :, 2] = 1.0
    weights, bounds = np.zeros((len(rows), SAMPLE)), np.zeros(len(rows))
    ends = np.zeros((len(rows), 2), np.int64)
    for at, row in enumerate(rows.tolist()):
        i, j = agreement.pairs[row].tolist()
        found = verified.matches[i, j]
        found = found[np.linspace(0, len(found) - 1, min(len(found), SAMPLE)).astype(np.int64)]
        one, two = units[i][found[:, 0]], units[j][found[:, 1]]
        known = np.isfinite(one).all(axis=1) & np.isfinite(two).all(axis=1)
        count = int(known.sum())
        ends[at] = row_of[i], row_of[j]
        first[at, :count], second[at, :count] = one[known], two[known]
        weights[at, :count] = np.sqrt(agreement.matches[row]) / max(count, 1)
        focal = (model.images[i].camera.mean_focal_length() + model.images[j].camera.mean_focal_length()) / 2.0
        bounds[at] = agreement.bounds_px[row] / focal
    return Samples(ends, first, second, weights, bounds)


def rearrange(
    start: Arrangement, samples: Samples, contradicts: Bool[np.ndarray, " n"], widths: Sequence[float] = LOSS_WIDTHS
) -> Arrangement:
    """Adjust poses to the epipolar lines of all samples, robustly.

    Args:
        start: The poses to begin with.
        samples: The matches.
        contradicts: Which of the pairs the model contradicts: they have more weight where the loss is wide.
        widths: Of the loss, one after another.
    """
    here = start
    for width in widths:
        favour = CONTRADICTION_WEIGHT if width >= MIN_FAVOURED_WIDTH else 1.0
        weights = samples.weights * np.where(contradicts, favour, 1.0)[:, None]
        for _ in range(GAUSS_NEWTON_STEPS):
            here = _stepped(here, samples, weights, width)
    return here


def move_group(
    here: Arrangement, group: Sequence[int], links: Sequence[tuple[int, int, Float64[np.ndarray, "3 4"]]]
) -> Arrangement:
    """Move a group of cameras by the similarity that two-view geometries between it and the others ask for.

    Args:
        here: The poses.
        group: Rows of the group's cameras.
        links: Row of a camera outside of the group, one inside, and the second's pose from the first's frame, its
            translation of any length.
    """
    outside, inside = (np.array([link[at] for link in links]) for at in (0, 1))
    relative = np.array([link[2] for link in links])
    wanted = here.turns[outside] @ relative[:, :, :3].transpose(0, 2, 1)  # world from camera
    turns = wanted @ here.turns[inside].transpose(0, 2, 1)
    turn = _middle_rotation(turns)
    back = -np.einsum("nji,nj->ni", relative[:, :, :3], relative[:, :, 3])  # the second's centre from the first
    towards = np.einsum("nij,nj->ni", here.turns[outside], back)
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    about = here.centres[list(group)].mean(axis=0)
    arms = (here.centres[inside] - about) @ turn.T
    # What of (about + shift + scale arm - outside) is across the line of sight is to be 0.
    across = np.eye(3) - towards[:, :, None] * towards[:, None, :]
    left = np.concatenate([across, across @ arms[:, :, None]], axis=2)
    right = (across @ (here.centres[outside] - about)[:, :, None])[:, :, 0]
    weights = np.ones(len(links))
    for _ in range(IRLS_ROUNDS):
        weighted = np.sqrt(weights)[:, None, None]
        rows, values = (weighted * left).reshape(-1, 4), (weighted[:, :, 0] * right).ravel()
        held = np.concatenate([rows, [[0.0, 0.0, 0.0, WEAK_SCALE]]]), np.append(values, WEAK_SCALE)
        found = np.linalg.lstsq(*held, rcond=None)[0]
        off = np.linalg.norm(left @ found - right, axis=1)
        weights = absolute_weights(off)
        weights /= weights.max()
    turned, centres = here.turns.copy(), here.centres.copy()
    rows_of = list(group)
    turned[rows_of] = turn @ here.turns[rows_of]
    centres[rows_of] = about + found[:3] + found[3] * (here.centres[rows_of] - about) @ turn.T
    return Arrangement(turned, centres)


def _middle_rotation(turns: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation that is nearest to most of the given ones: the one with the least sum of angles to all."""
    cosines = (np.einsum("aij,bij->ab", turns, turns) - 1.0) / 2.0
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.asarray(turns[int(np.argmin(np.round(angles.sum(axis=1), DIGITS)))])


def _sampled_score(here: Arrangement, samples: Samples) -> float:
    """Return the score by the samples alone, and without regard to which side of a camera a point is on."""
    near = np.maximum(1.0 - np.abs(_residuals(here, samples)[0]), 0.0)
    return float((samples.weights * near).sum() / max(float(samples.weights.sum()), 1e-12))


def _stepped(here: Arrangement, samples: Samples, weights: Float64[np.ndarray, "n s"], width: float) -> Arrangement:
    """Return the poses after a damped Gauss-Newton step with the weights of Geman and McClure's loss."""
    off, slopes = _residuals(here, samples)
    robust = weights / (1.0 + (off / width) ** 2) ** 2
    blocks = np.einsum("nsa,ns,nsb->nab", slopes, robust, slopes)
    pulls = np.einsum("nsa,ns->na", slopes, robust * off)
    size = 6 * len(here.turns)
    columns = (6 * samples.ends[:, :, None] + np.arange(6)).reshape(len(off), 12)
    across = np.broadcast_to(columns[:, :, None], blocks.shape), np.broadcast_to(columns[:, None, :], blocks.shape)
    shape = (size, size)
    normal = scipy.sparse.coo_matrix((blocks.ravel(), (across[0].ravel(), across[1].ravel())), shape).tocsc()
    diagonal = normal.diagonal()
    damped = normal + scipy.sparse.diags(DAMPING * diagonal + 1e-9 * max(float(diagonal.max()), 1e-12))
    right = np.bincount(columns.ravel(), pulls.ravel(), minlength=size)
    step = -scipy.sparse.linalg.splu(damped.tocsc()).solve(right).reshape(-1, 6)
    angles = np.linalg.norm(step[:, :3], axis=1)
    step *= (np.minimum(1.0, TURN_MOST / np.maximum(angles, 1e-12)))[:, None]
    return Arrangement(rotation_from_vector(step[:, :3]) @ here.turns, here.centres + step[:, 3:])


def _residuals(here: Arrangement, samples: Samples) -> tuple[Float64[np.ndarray, "n s"], Float64[np.ndarray, "n s 12"]]:
    """Return signed errors over the bound, and their derivatives by both photos' turns (world frame) and centres."""
    i, j = samples.ends.T
    turn_i, turn_j = here.turns[i], here.turns[j]
    one = samples.first @ turn_i.transpose(0, 2, 1)
    two = samples.second @ turn_j.transpose(0, 2, 1)
    base = here.centres[j] - here.centres[i]
    length = np.maximum(np.linalg.norm(base, axis=1), 1e-9)
    base = base / length[:, None]
    along = np.broadcast_to(base[:, None], one.shape)
    normal = np.cross(one, two)
    off = np.einsum("nsk,nk->ns", normal, base)
    # Sampson's denominator for rays of length 1: the parts of the epipolar normals across each ray.
    back, ahead = np.cross(two, along), np.cross(along, one)
    slope = _across(back, one) + _across(ahead, two)
    scale = 1.0 / (np.sqrt(np.maximum(slope, 1e-12)) * samples.bounds[:, None])
    move = (normal - off[:, :, None] * base[:, None]) / length[:, None, None]
    slopes = np.concatenate([np.cross(one, back), -move, np.cross(two, ahead), move], axis=2)
    return off * scale, slopes * scale[:, :, None]


def _across(normals: Float64[np.ndarray, "n s 3"], rays: Float64[np.ndarray, "n s 3"]) -> Float64[np.ndarray, "n s"]:
    along = np.einsum("nsk,nsk->ns", normals, rays)
    return np.asarray((normals**2).sum(axis=2) - along**2)


def _unit(rays: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    whole = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(whole / np.linalg.norm(whole, axis=1, keepdims=True))


@dataclass(frozen=True)
class Rearrangement:
    """The best arrangement found; at worst the model's own.

    Attributes:
        agreement: How well it explains the matches.
        poses: Camera from world, by image id, in a frame of its own.
    """

    agreement: Agreement
    poses: Mapping[int, Float64[np.ndarray, "3 4"]]


def find_better(
    model: pycolmap.Reconstruction, verified: ViewGraph, agreement: Agreement, rays: Mapping[int, Rays]
) -> Rearrangement:
    """Look for an arrangement of the cameras that explains more of the matches.

    Args:
        model: With the keypoints of ``verified``.
        verified: The view graph.
        agreement: How well the model explains it.
        rays: ``rays_of`` these.
    """
    numbers = sorted(rays)
    samples = sample(model, verified, agreement, rays)
    here, now = arrangement_of(model, numbers), agreement
    for number in range(MAX_MOVED_GROUPS + 1):
        against = contradicting(now)
        starts: list[tuple[Arrangement, Sequence[float]]] = []
        if number == 0:
            starts = [(here, LOSS_WIDTHS), (here, SLIGHT_LOSS_WIDTHS)]
        group = find_cut(now, against)
        if group.ratio >= MIN_CONTRADICTION_RATIO:
            moved = _moved_group(model, verified, (now, here), group.group, numbers)
            starts += [(moved, MOVED_LOSS_WIDTHS)] if moved is not None else []
        before = now
        for start, widths in starts:
            moved = rearrange(start, samples, against[agreement.placed], widths)
            if _sampled_score(moved, samples) < _sampled_score(here, samples) + MIN_SAMPLED_GAIN:
                continue
            found = compare(model, verified, dict(zip(numbers, moved.matrices(), strict=True)), rays)
            if found.score > now.score:
                here, now = moved, found
        if now is before:
            break
    return Rearrangement(now, dict(zip(numbers, here.matrices(), strict=True)))


def _moved_group(
    model: pycolmap.Reconstruction,
    verified: ViewGraph,
    best: tuple[Agreement, Arrangement],
    group: Sequence[int],
    numbers: Sequence[int],
) -> Arrangement | None:
    """Return the arrangement with a group moved to where its contradicting pairs with the others want it."""
    agreement, here = best
    inside = set(group)
    rows = np.flatnonzero(contradicting(agreement))
    rows = rows[np.argsort(-agreement.matches[rows], kind="stable")]
    row_of = {number: row for row, number in enumerate(numbers)}
    links: list[tuple[int, int, Float64[np.ndarray, "3 4"]]] = []
    for i, j in agreement.pairs[rows].tolist():
        if (i in inside) != (j in inside) and len(links) < MAX_LINKS:
            one, two = (j, i) if i in inside else (i, j)
            pose = _two_view(model, verified, one, two)
            if pose is not None:
                links.append((row_of[one], row_of[two], pose))
    return move_group(here, [row_of[number] for number in group], links) if links else None


def _two_view(
    model: pycolmap.Reconstruction, verified: ViewGraph, one: int, two: int
) -> Float64[np.ndarray, "3 4"] | None:
    """Return the second photo's pose from the first's frame by their matches alone."""
    rows = verified.matches[min(one, two), max(one, two)]
    rows = rows[:: max(1, -(-len(rows) // LINK_SAMPLE))]
    rows = rows if one < two else rows[:, ::-1]
    places = [verified.keypoints[number][rows[:, at]].astype(np.float64) for at, number in enumerate((one, two))]
    cameras = [model.images[number].camera for number in (one, two)]
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = EXPLAINED_PX * pixel_tolerance_scale(cameras), 0
    found = pycolmap.estimate_essential_matrix(places[0], places[1], cameras[0], cameras[1], options)
    return None if found is None else np.asarray(found["cam2_from_cam1"].matrix())
