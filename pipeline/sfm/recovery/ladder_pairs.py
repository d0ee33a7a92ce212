"""Propose more pairs of photos for a finished model, and add their verified matches to a copy of the database.

Photos have COLMAP's numbers here, as in ``ViewGraph``.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.sfm.capture import MappingInput
from splatpipe.pipeline.sfm.matching.matching import match_pairs
from splatpipe.pipeline.sfm.model.structure import Structure, poses_of, read_structure
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.pairing.pairs import Pair

SAMPLE = 64  # points of a photo that are projected into the others
MIN_POINTS = 8  # points projected from a photo; fewer say nothing about what it shows
ALIKE_COS = float(np.cos(np.radians(40.0)))  # beyond it SIFT matches little, and other sides of objects are visible
MIN_SCALE = 0.4  # ratio of the distances to a point: beyond a factor of 2.5 the keypoint scales differ
MIN_SHARE = 0.2  # share of a photo's points that must lie in the other image
NEAREST = 60  # candidate photos per photo, nearest by the points they observe: the cost grows linearly with the photos


def propose_pairs(
    model: pycolmap.Reconstruction, verified: ViewGraph, count: int, avoided: Collection[Pair] = ()
) -> list[Pair]:
    """Propose pairs of placed photos that show the same thing according to the model but have no verified matches.

    Pairs that close a loop, those where no third photo has matches with both, come first. Pairs are spread over the
    photos.

    Args:
        model: A model with points.
        verified: Its view graph.
        count: Maximum number of pairs.
        avoided: (i, j), i < j, pairs to exclude because matching has already tried them.

    Returns:
        (i, j), i < j, COLMAP's numbers; the most informative first.
    """
    poses, structure = poses_of(model), read_structure(model)
    numbers = np.array(sorted(poses))
    shares = shared_views(model, structure, numbers)
    joined = np.zeros((len(numbers), len(numbers)), bool)
    place = {int(number): at for at, number in enumerate(numbers)}
    for i, j in verified.matches:
        if i in place and j in place:
            joined[place[i], place[j]] = joined[place[j], place[i]] = True
    common = (joined.astype(np.float32) @ joined.astype(np.float32)) > 0.0
    open_ = (shares >= MIN_SHARE) & ~joined
    for i, j in avoided:
        if i in place and j in place:
            open_[place[i], place[j]] = False
    first, second = np.nonzero(np.triu(open_, 1))
    candidates = sorted(
        (bool(common[i, j]), -float(shares[i, j]), int(i), int(j)) for i, j in zip(first, second, strict=True)
    )
    most = max(1, -(-2 * count // max(len(numbers), 1)))
    taken = np.zeros(len(numbers), int)
    chosen, later = [], []
    for _, _, i, j in candidates:
        if taken[i] < most and taken[j] < most:
            taken[[i, j]] += 1
            chosen.append((i, j))
        else:
            later.append((i, j))
    return [(int(numbers[i]), int(numbers[j])) for i, j in (chosen + later)[:count]]


def shared_views(
    model: pycolmap.Reconstruction, structure: Structure, numbers: np.ndarray
) -> Float64[np.ndarray, "n n"]:
    """Estimate the overlap of each two photos: the share of one's points that the other sees from a similar view.

    Entry (i, j) is the mean of both directions. Occlusion is not considered.

    Args:
        model: With the poses and cameras.
        structure: Its points.
        numbers: (n,) placed photos, sorted.
    """
    samples = _samples(structure, numbers)
    centres = np.array([model.images[int(number)].projection_center() for number in numbers])
    middles = np.array([np.median(points, axis=0) if len(points) else np.full(3, np.inf) for points in samples])
    shares = np.zeros((len(numbers), len(numbers)))
    for j, number in enumerate(numbers.tolist()):
        image = model.images[number]
        others = _nearest(middles, j)
        stacked = [samples[i] for i in others.tolist()]
        if not stacked:
            continue
        points = np.concatenate(stacked)
        owners = np.repeat(others, [len(rows) for rows in stacked])
        seen = _seen_alike(points, centres[owners], image, model.cameras[image.camera_id], centres[j])
        totals = np.bincount(owners, minlength=len(numbers))
        hits = np.bincount(owners[seen], minlength=len(numbers))
        shares[:, j] = np.where(totals >= MIN_POINTS, hits / np.maximum(totals, 1), 0.0)
    return (shares + shares.T) / 2.0


def _samples(structure: Structure, numbers: np.ndarray) -> list[Float64[np.ndarray, "_ 3"]]:
    """Return an evenly strided sample of the points that each photo observes."""
    rows: dict[int, list[int]] = {int(number): [] for number in numbers}
    for row, track in enumerate(structure.tracks):
        for photo, _ in track:
            rows[photo].append(row)
    return [structure.points[found[:: max(1, -(-len(found) // SAMPLE))]] for found in rows.values()]


def _nearest(middles: Float64[np.ndarray, "n 3"], j: int) -> np.ndarray:
    """Return the photos whose points lie nearest to those of photo j, excluding j and photos without points."""
    if not np.isfinite(middles[j]).all():
        return np.zeros(0, int)
    with np.errstate(invalid="ignore"):
        distances = ((middles - middles[j]) ** 2).sum(axis=1)
    order = np.argsort(distances, kind="stable")
    order = order[np.isfinite(distances[order]) & (order != j)]
    return np.asarray(order[:NEAREST])


def _seen_alike(
    points: Float64[np.ndarray, "m 3"],
    owners: Float64[np.ndarray, "m 3"],
    image: pycolmap.Image,
    camera: pycolmap.Camera,
    centre: Float64[np.ndarray, " 3"],
) -> Bool[np.ndarray, " m"]:
    """Return the mask of points inside an image that it sees at a similar angle and distance as their owners do."""
    pixels, _ = project_through_lens(camera, image.cam_from_world().matrix(), points)
    inside = ((pixels >= 0.0) & (pixels < [camera.width, camera.height])).all(
        axis=1
    )  # NaN behind the camera, hence False
    here, there = points - centre, points - owners
    far, near = np.linalg.norm(here, axis=1), np.linalg.norm(there, axis=1)
    cosines = (here * there).sum(axis=1) / np.maximum(far * near, 1e-12)
    alike = (cosines >= ALIKE_COS) & (np.minimum(far, near) >= MIN_SCALE * np.maximum(far, near))
    return np.asarray(inside & alike)


def match_more(capture: MappingInput, base: Path, pairs: Sequence[Pair], seed: int, report: Reporter) -> Path:
    """Match and verify more pairs with the keypoints of ``capture.features``.

    Args:
        capture: The photos; the new database is written to its scratch folder.
        base: Database of the verified pairs so far; its keypoints start with those of ``capture.features``. Only read.
        pairs: (i, j), COLMAP's numbers. Pairs that are already verified are matched again.
        seed: For the verification.
        report: Receives progress.

    Returns:
        A database with everything in ``base`` and the verified matches of the pairs, even if there are none.
    """
    folder = Path(tempfile.mkdtemp(prefix="pairs-", dir=capture.scratch))
    target = folder / "database.db"
    work = folder / "work.db"
    zero_based = sorted({(min(i, j) - 1, max(i, j) - 1) for i, j in pairs})
    shutil.copyfile(base, target)
    if zero_based:
        match_pairs(capture.features, work, zero_based, seed, capture.threads, report)
        take_verified(work, target)
    work.unlink(missing_ok=True)
    return target


def take_verified(work: Path, target: Path, starts: dict[int, int] | None = None) -> int:
    """Copy the verified matches of one database into another, replacing those of the same keypoints.

    Args:
        work: The database in which pairs were matched.
        target: The database to write to.
        starts: For photos whose keypoints in ``work`` were appended to those in ``target``, the index of the first.

    Returns:
        Number of copied pairs with verified matches.
    """
    starts = starts or {}
    held = 0
    with pycolmap.Database.open(work) as matched, pycolmap.Database.open(target) as database:
        numbers, geometries = matched.read_two_view_geometries()
        for pair_id, geometry in sorted(zip(numbers, geometries, strict=True), key=lambda entry: entry[0]):
            i, j = pycolmap.pair_id_to_image_pair(pair_id)
            rows = np.asarray(geometry.inlier_matches, np.uint32).reshape(-1, 2)
            if len(rows) == 0 and database.exists_two_view_geometry(i, j):
                continue
            held += len(rows) > 0
            rows = rows + np.array([starts.get(i, 0), starts.get(j, 0)], np.uint32)
            if database.exists_two_view_geometry(i, j):
                if starts:
                    before = np.asarray(database.read_two_view_geometry(i, j).inlier_matches, np.uint32)
                    rows = np.concatenate([before.reshape(-1, 2), rows])
                database.delete_two_view_geometry(i, j)
            geometry.inlier_matches = rows
            database.write_two_view_geometry(i, j, geometry)
    return held


def tried_pairs(database: Path) -> set[Pair]:
    """Return the pairs with a two-view geometry in a database, verified or not; `matches` keeps only verified ones."""
    with pycolmap.Database.open(database) as opened:
        numbers, _ = opened.read_two_view_geometries()
    return {tuple(sorted(pycolmap.pair_id_to_image_pair(number))) for number in numbers}
