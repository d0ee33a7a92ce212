"""Reduce the matches that mapping starts from to those of each photo's best keypoints, spread over the photo.

A keypoint verified in more pairs ties more cameras together, and a few hundred that are well spread over a photo place
it as well as thousands. The cost of mapping grows with its matches, so the others are added once the cameras are known.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Int64

from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

GRID = 8  # cells along each side of a photo; its keypoints are chosen cell by cell
PAIR_FLOOR = 60  # matches that every pair keeps if it has them: twice COLMAP's minimum for placing a photo


def best_keypoints(verified: ViewGraph, wanted: int) -> dict[int, Bool[np.ndarray, " n"]]:
    """Choose the keypoints of each photo that mapping starts from.

    Photos are processed in the order of their numbers. Each keeps the keypoints already chosen because they match one
    of an earlier photo, then adds the most often verified of each cell in turn until there are enough. The direct
    matches of an added keypoint are chosen too, to keep tracks together.

    Args:
        verified: The view graph.
        wanted: Keypoints per photo; matches with other photos may add more.

    Returns:
        By COLMAP's number of the photo, a flag for each of its keypoints.
    """
    numbers = sorted(verified.keypoints)
    counts = np.array([len(verified.keypoints[number]) for number in numbers], np.int64)
    starts = dict(zip(numbers, (np.cumsum(counts) - counts).tolist(), strict=True))
    first, second, pair = _edges(verified, starts)
    degree = np.bincount(np.concatenate([first, second]), minlength=int(counts.sum()))
    chosen = np.zeros(int(counts.sum()), bool)
    partners, offsets = _neighbours(first, second, len(chosen))
    for number in numbers:
        begin, end = starts[number], starts[number] + len(verified.keypoints[number])
        new = begin + _spread_best(verified.keypoints[number], degree[begin:end], chosen[begin:end], wanted)
        chosen[new] = True
        chosen[_gather(partners, offsets, new)] = True
    more = _up_to_floor(pair, chosen[first] & chosen[second], degree[first] + degree[second])
    chosen[first[more]] = chosen[second[more]] = True
    return {number: chosen[starts[number] : starts[number] + len(verified.keypoints[number])] for number in numbers}


def _edges(
    verified: ViewGraph, starts: dict[int, int]
) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"], Int64[np.ndarray, " m"]]:
    """Return both ends of each verified match, as indices into all keypoints photo after photo, and its pair number."""
    pairs = sorted(verified.matches)
    if not pairs:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows = [verified.matches[pair].astype(np.int64) for pair in pairs]
    first = np.concatenate([starts[i] + matches[:, 0] for (i, _), matches in zip(pairs, rows, strict=True)])
    second = np.concatenate([starts[j] + matches[:, 1] for (_, j), matches in zip(pairs, rows, strict=True)])
    return first, second, np.repeat(np.arange(len(pairs)), [len(matches) for matches in rows])


def _up_to_floor(
    pair: Int64[np.ndarray, " m"], kept: Bool[np.ndarray, " m"], degree: Int64[np.ndarray, " m"]
) -> Int64[np.ndarray, " _"]:
    """Return the matches to add so that each pair reaches its floor: those whose ends are verified most often."""
    missing = PAIR_FLOOR - np.bincount(pair[kept], minlength=int(pair.max(initial=-1)) + 1)
    left = np.flatnonzero(~kept & (missing[pair] > 0))
    order = left[np.lexsort((left, -degree[left], pair[left]))]
    sizes = np.bincount(pair[order], minlength=len(missing))
    rank = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.asarray(order[rank < missing[pair[order]]])


def _neighbours(
    first: Int64[np.ndarray, " m"], second: Int64[np.ndarray, " m"], count: int
) -> tuple[Int64[np.ndarray, " twice"], Int64[np.ndarray, " offsets"]]:
    """Return all matched keypoints, keypoint after keypoint, and the offset at which each keypoint's begin."""
    ends = np.concatenate([first, second])
    order = np.argsort(ends, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=count))])
    return np.concatenate([second, first])[order], offsets


def _gather(
    partners: Int64[np.ndarray, " twice"], offsets: Int64[np.ndarray, " offsets"], rows: Int64[np.ndarray, " n"]
) -> Int64[np.ndarray, " _"]:
    lengths = offsets[rows + 1] - offsets[rows]
    places = np.repeat(offsets[rows] - (np.cumsum(lengths) - lengths), lengths) + np.arange(int(lengths.sum()))
    return np.asarray(partners[places])


def _spread_best(
    places: np.ndarray, degree: Int64[np.ndarray, " n"], chosen: Bool[np.ndarray, " n"], wanted: int
) -> Int64[np.ndarray, " _"]:
    """Return the rows to add so that ``wanted`` are chosen: each cell's best, then each cell's second, and so on."""
    usable = np.flatnonzero(degree > 0)
    missing = wanted - int(np.count_nonzero(chosen))
    if missing <= 0 or len(usable) == 0:
        return np.zeros(0, np.int64)
    low, high = places[usable].min(axis=0), places[usable].max(axis=0)
    at = np.minimum(((places[usable] - low) / np.maximum(high - low, 1e-6) * GRID).astype(np.int64), GRID - 1)
    cell = at[:, 1] * GRID + at[:, 0]
    order = np.lexsort((usable, -degree[usable], ~chosen[usable], cell))  # the last key leads
    sizes = np.bincount(cell, minlength=GRID * GRID)
    rank = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    best_first = usable[order[np.lexsort((usable[order], -degree[usable[order]], rank))]]
    return np.asarray(best_first[~chosen[best_first]][:missing])


def write_reduced(database: Path, target: Path, chosen: Mapping[int, Bool[np.ndarray, " n"]]) -> tuple[int, int]:
    """Write a database with only the verified matches between chosen keypoints; keypoints keep their indices.

    Args:
        database: The complete database; only read.
        target: The database to write.
        chosen: Flags of each photo's keypoints.

    Returns:
        Number of verified matches kept, and the total.
    """
    kept, total = 0, 0
    with pycolmap.Database.open(database) as source, pycolmap.Database.open(target) as reduced:
        copy_photos(source, reduced)
        numbers, geometries = source.read_two_view_geometries()
        for pair, geometry in sorted(zip(numbers, geometries, strict=True), key=lambda entry: entry[0]):
            i, j = pycolmap.pair_id_to_image_pair(pair)
            matches = geometry.inlier_matches
            rows = matches[chosen[i][matches[:, 0]] & chosen[j][matches[:, 1]]] if len(matches) else matches
            kept, total = kept + len(rows), total + len(matches)
            geometry.inlier_matches = rows
            reduced.write_two_view_geometry(i, j, geometry)
    return kept, total


def copy_photos(
    source: pycolmap.Database, target: pycolmap.Database, keypoints_of: Container[int] | None = None
) -> None:
    """Copy cameras, rigs, frames, images and keypoints (of all photos, or of some) under their numbers."""
    for camera in sorted(source.read_all_cameras(), key=lambda camera: camera.camera_id):
        target.write_camera(camera, use_camera_id=True)
    for rig in sorted(source.read_all_rigs(), key=lambda rig: rig.rig_id):
        target.write_rig(rig, use_rig_id=True)
    for frame in sorted(source.read_all_frames(), key=lambda frame: frame.frame_id):
        target.write_frame(frame, use_frame_id=True)
    for image in sorted(source.read_all_images(), key=lambda image: image.image_id):
        target.write_image(image, use_image_id=True)
        if keypoints_of is None or image.image_id in keypoints_of:
            target.write_keypoints(image.image_id, source.read_keypoints(image.image_id))
