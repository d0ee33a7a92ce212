"""Join a sub-model to another model through points of both that matched keypoints observe.

The similarity transform is estimated by RANSAC and checked in pixels both ways: a point of one model must project to
where a photo of the other observed it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity
from splatpipe.pipeline.sfm.model.structure import (
    Observations,
    Structure,
    Track,
    cameras_of,
    make_model,
    poses_of,
    read_observations,
)
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.recovery.ladder_poses import (
    CELLS,
    HELD_OUT,
    LARGE_SHARE,
    MANY_INLIERS,
    MAX_ERROR_SHARE,
    MIN_CELLS,
    MIN_ERROR_PX,
    MIN_INLIERS,
    MIN_SHARE,
)

TOLERANCE_FACTOR = 3.0  # times a pose's tolerance: both models have errors, and neither was adjusted to the other
TRIALS = 2000  # draws three correct ties with 99.9 % probability if a sixth of all are correct
SCORED = 1000  # ties that score a trial: enough to find the best, whatever the models' size
REFITS = 5  # rounds of refitting to the inliers
MIN_LINKS = 2  # pairs of photos between the models; a single pair may show a look-alike


@dataclass(frozen=True)
class TiePoints:
    """Pairs of points, one from each model, that should coincide, with the photos that observe them.

    Values come in pairs: "here" is the model whose frame stays, "there" the other one.

    Attributes:
        rows: (k, 2) row of the point, here and there.
        links: (k, 2) the photos whose keypoints were matched, here and there.
        points: (k, 3) here; (k, 3) there.
        poses: (k, 3, 4) cam_from_world of the photo here; of the photo there, each in its own model's frame.
        places: (k, 2) undistorted observation in the photo, on the plane at depth 1; here; there.
        pixels: (k,) pixels per unit of that plane; here; there.
        limits: (k,) tolerance of the reprojection, pixels; here; there.
        cells: (k,) grid cell of the image here that contains the observation.
    """

    rows: Int64[np.ndarray, "k 2"]
    links: Int64[np.ndarray, "k 2"]
    points: tuple[Float64[np.ndarray, "k 3"], Float64[np.ndarray, "k 3"]]
    poses: tuple[Float64[np.ndarray, "k 3 4"], Float64[np.ndarray, "k 3 4"]]
    places: tuple[Float64[np.ndarray, "k 2"], Float64[np.ndarray, "k 2"]]
    pixels: tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]
    limits: tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]
    cells: Int64[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.rows)

    def only(self, chosen: Int64[np.ndarray, " n"]) -> TiePoints:
        """Return the chosen rows."""
        both = (self.points, self.poses, self.places, self.pixels, self.limits)
        points, poses, places, pixels, limits = ((one[chosen], two[chosen]) for one, two in both)
        cells = self.cells[chosen]
        return TiePoints(self.rows[chosen], self.links[chosen], points, poses, places, pixels, limits, cells)


def join(
    model: pycolmap.Reconstruction, other: pycolmap.Reconstruction, verified: ViewGraph, seed: int
) -> pycolmap.Reconstruction | None:
    """Join two models into one, not yet adjusted; None if their relative placement is uncertain.

    Args:
        model: The model whose frame and cameras are kept.
        other: Another model of the same view graph.
        verified: The view graph; keypoints may have been added since.
        seed: For RANSAC.
    """
    here, there = read_observations(model), read_observations(other)
    ties = find_ties(model, here, other, there, verified)
    fitted = fit_ties(ties, np.ones(len(ties), bool), seed)
    if fitted is None:
        return None
    similarity, inliers = fitted
    if not _is_certain(ties, inliers) or not _cross_validates(ties, seed):
        return None
    return _united(model, here.structure(), other, there.structure(), verified, similarity, ties.rows[inliers])


def find_ties(
    model: pycolmap.Reconstruction,
    here: Observations,
    other: pycolmap.Reconstruction,
    there: Observations,
    verified: ViewGraph,
) -> TiePoints:
    """Return the ties given by verified matches between photos of both models, and by photos that are in both."""
    counts = {number: len(places) for number, places in verified.keypoints.items()}
    ours, theirs = set(model.reg_image_ids()), set(other.reg_image_ids())
    rows_here = {number: rows for number, rows in here.rows(counts).items() if number in ours}
    rows_there = {number: rows for number, rows in there.rows(counts).items() if number in theirs}
    candidates = [(i, j, matches.astype(np.int64)) for (i, j), matches in sorted(verified.matches.items())]
    candidates += [(j, i, matches[:, ::-1]) for i, j, matches in candidates]
    candidates += [(i, i, np.repeat(np.arange(counts[i])[:, None], 2, axis=1)) for i in sorted(ours & theirs)]
    found: dict[tuple[int, int], tuple[int, int, int, int]] = {}
    for i, j, matches in candidates:
        if i in ours and j in theirs:
            first, second = rows_here[i][matches[:, 0]], rows_there[j][matches[:, 1]]
            both = (first >= 0) & (second >= 0)
            for a, b, p, q in zip(first[both], second[both], matches[both, 0], matches[both, 1], strict=True):
                found.setdefault((int(a), int(b)), (i, j, int(p), int(q)))
    return _tied(model, here, other, there, verified, found)


def _tied(
    model: pycolmap.Reconstruction,
    here: Observations,
    other: pycolmap.Reconstruction,
    there: Observations,
    verified: ViewGraph,
    found: Mapping[tuple[int, int], tuple[int, int, int, int]],
) -> TiePoints:
    rows = np.array(sorted(found), np.int64).reshape(-1, 2)
    seen = np.array([found[int(a), int(b)] for a, b in rows], np.int64).reshape(-1, 4)
    sides = []
    for side, (of, observed) in enumerate(((model, here), (other, there))):
        photos, keypoints = seen[:, side], seen[:, 2 + side]
        poses, places = np.zeros((len(rows), 3, 4)), np.zeros((len(rows), 2))
        pixels, limits, cells = np.zeros(len(rows)), np.zeros(len(rows)), np.zeros(len(rows), np.int64)
        for number in np.unique(photos).tolist():
            mine = photos == number
            camera = of.cameras[of.images[number].camera_id]
            spots = verified.keypoints[number][keypoints[mine]].astype(np.float64)
            poses[mine] = of.images[number].cam_from_world().matrix()
            places[mine] = camera.cam_from_img(spots)
            pixels[mine] = camera.mean_focal_length()
            limits[mine] = TOLERANCE_FACTOR * max(MIN_ERROR_PX, MAX_ERROR_SHARE * max(camera.width, camera.height))
            part = np.clip((spots / [camera.width, camera.height] * CELLS).astype(int), 0, CELLS - 1)
            cells[mine] = part[:, 0] * CELLS + part[:, 1]
        sides.append((observed.points[rows[:, side]], poses, places, pixels, limits, cells))
    points, poses_, places_, pixels_, limits_, cells_ = zip(*sides, strict=True)
    return TiePoints(rows, seen[:, :2], points, poses_, places_, pixels_, limits_, cells_[0])


def fit_ties(
    ties: TiePoints, chosen: Bool[np.ndarray, " k"], seed: int, least: int = MIN_INLIERS
) -> tuple[Similarity, Bool[np.ndarray, " k"]] | None:
    """Fit the similarity from there to here that most of the chosen ties agree with.

    Args:
        ties: All ties.
        chosen: (k,) mask of those to fit to.
        seed: For the random draws.
        least: Minimum number of chosen ties that must agree.

    Returns:
        The similarity and the mask of all ties that agree with it, or None if too few of the chosen ties do.
    """
    rows = np.flatnonzero(chosen)
    if len(rows) < least:
        return None
    generator = np.random.default_rng(seed)
    draws = np.stack([generator.permutation(len(rows))[:3] for _ in range(TRIALS)])
    there, here = ties.points[1][rows[draws]], ties.points[0][rows[draws]]
    scales, rotations, translations = fit_similarity(there, here, np.ones(draws.shape))
    scored = ties.only(np.sort(generator.permutation(rows)[:SCORED]))
    best: tuple[int, Similarity | None] = (0, None)
    for scale, rotation, translation in zip(scales, rotations, translations, strict=True):
        if np.isfinite(scale) and scale > 0.0:
            trial = Similarity(float(scale), rotation, translation)
            held = int(np.count_nonzero(agree(scored, trial)))
            if held > best[0]:
                best = held, trial
    similarity = best[1]
    for _ in range(REFITS):
        if similarity is None:
            return None
        inliers = agree(ties, similarity) & chosen
        if np.count_nonzero(inliers) < least:
            return None
        scale, rotation, translation = fit_similarity(
            ties.points[1][inliers], ties.points[0][inliers], np.ones(int(inliers.sum()))
        )
        again = Similarity(float(scale), rotation, translation)
        if np.count_nonzero(agree(ties, again) & chosen) < np.count_nonzero(inliers):
            break
        similarity = again
    assert similarity is not None
    return similarity, agree(ties, similarity)


def agree(ties: TiePoints, similarity: Similarity) -> Bool[np.ndarray, " k"]:
    """Return the mask of ties that a similarity brings within tolerance, both in the photo here and the one there."""
    moved = similarity.apply(ties.points[1]), similarity.inverse().apply(ties.points[0])
    good = np.ones(len(ties), bool)
    for side in (0, 1):
        in_camera = np.einsum("kxy,ky->kx", ties.poses[side][:, :, :3], moved[side]) + ties.poses[side][:, :, 3]
        depth = np.where(in_camera[:, 2] > 0.0, in_camera[:, 2], np.nan)
        errors = np.linalg.norm(in_camera[:, :2] / depth[:, None] - ties.places[side], axis=1) * ties.pixels[side]
        with np.errstate(invalid="ignore"):
            good &= errors <= ties.limits[side]
    return good


def _is_certain(ties: TiePoints, inliers: Bool[np.ndarray, " k"]) -> bool:
    """Whether the inliers are numerous enough, a large enough share, and spread over the images and photo pairs."""
    held = min(len(np.unique(ties.rows[inliers, side])) for side in (0, 1))
    share = held / max(1, min(len(np.unique(ties.rows[:, side])) for side in (0, 1)))
    enough = (held >= MANY_INLIERS and share >= MIN_SHARE) or (held >= MIN_INLIERS and share >= LARGE_SHARE)
    links = len(np.unique(ties.links[inliers], axis=0))
    return enough and links >= MIN_LINKS and len(np.unique(ties.cells[inliers])) >= MIN_CELLS


def _cross_validates(ties: TiePoints, seed: int) -> bool:
    """Cross-validate: whether the fit to either half of the points explains the other half nearly as well."""
    _, order = np.unique(ties.rows[:, 0], return_inverse=True)
    for odd in (0, 1):
        mine = order % 2 == odd
        fitted = fit_ties(ties, mine, seed, MIN_INLIERS // 2)
        if fitted is None:
            return False
        own, others = fitted[1][mine].mean(), fitted[1][~mine].mean()
        if others < HELD_OUT * own:
            return False
    return True


def _united(
    model: pycolmap.Reconstruction,
    here: Structure,
    other: pycolmap.Reconstruction,
    there: Structure,
    verified: ViewGraph,
    similarity: Similarity,
    same: Int64[np.ndarray, "_ 2"],
) -> pycolmap.Reconstruction:
    """Return both models merged in the first's frame; for a photo or camera in both, the first's is kept."""
    poses = poses_of(model)
    for number, pose in poses_of(other).items():
        if number not in poses:
            matrix = np.eye(4)
            matrix[:3] = pose.matrix()
            poses[number] = pycolmap.Rigid3d(similarity.camera_pose(matrix)[:3])
    used = {element for track in here.tracks for element in track}
    tracks: list[Track] = [list(track) for track in here.tracks]
    points = [here.points]
    meets: dict[int, int] = {}
    for first, second in same.tolist():
        meets.setdefault(second, first)
    moved = similarity.apply(there.points)
    for row, track in enumerate(there.tracks):
        free = [element for element in track if element not in used]
        used.update(free)
        if row in meets:
            target = tracks[meets[row]]
            photos = {photo for photo, _ in target}
            target.extend(element for element in free if element[0] not in photos)
            target.sort()
        else:
            tracks.append(free)
            points.append(moved[row : row + 1])
    cameras = {**cameras_of(other), **cameras_of(model)}
    return make_model(cameras.values(), poses, verified, Structure(np.concatenate(points), tracks))
