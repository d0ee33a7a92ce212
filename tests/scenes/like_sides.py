"""A building with two like sides, photographed all around, and the model in which one side is taken for the other."""

from __future__ import annotations

import numpy as np
import pycolmap
from lens_scene import HEIGHT, WIDTH, look_from, make_lens
from view_graph import FOCAL, NOISE_PX, Ring, add_points, model_of, moved, turn_up

from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

FACING = np.cos(np.radians(70.0))  # a side is seen by photos within this angle of its normal


def make_sides(alike: float, count: int = 24, reach: int = 3, points: int = 1600, most: int = 150) -> Ring:
    """Return photos around a building whose sides share a part of their points' looks.

    Photos match those up to ``reach`` places further on that see the same side, and where the sides are alike, those
    that see the other side from the same place; the pairs around the corners are missing.

    Args:
        alike: Share of a side's points that have a double on the other side.
        count: Photos.
        reach: Places.
        points: Of a side.
        most: Matches of a pair.
    """
    rng = np.random.default_rng(5)
    doubles = int(alike * points)
    side = rng.uniform(-1.0, 1.0, (2, points, 3)) * [1.0, 6.0, 3.0] + [5.0, 0.0, 0.0]
    side = np.take_along_axis(side, np.argsort(side[:, :, 1:2], axis=1), axis=1)  # the left is alike, the right is not
    side[1, :doubles] = side[0, :doubles]
    places = np.concatenate([side[0], side[1] @ turn_up(180.0).T])
    lens = make_lens("SIMPLE_RADIAL", [FOCAL, WIDTH / 2, HEIGHT / 2, 0.0])
    lens.has_prior_focal_length = True
    poses, rows, keypoints = {}, {}, {}
    for number in range(1, count + 1):
        angle = 2.0 * np.pi * (number - (count + 2) / 4.0) / count  # the first half faces the first side
        centre = np.array([20.0 * np.cos(angle), 20.0 * np.sin(angle), 2.0 + 2.0 * (number % 3)])
        pose = look_from(centre, rng.normal(0.0, 0.5, 3), 0.0)
        in_camera = places @ pose[:, :3].T + pose[:, 3]
        projected = np.asarray(lens.img_from_cam(in_camera))
        inside = (projected > 0.0).all(axis=1) & (projected < [WIDTH, HEIGHT]).all(axis=1)
        seen = (np.arange(2 * points) < points) == (number <= count // 2)
        rows[number] = np.flatnonzero(inside & seen & (abs(np.cos(angle)) > FACING))
        poses[number] = pose
        keypoints[number] = (projected[rows[number]] + rng.normal(0.0, NOISE_PX, (len(rows[number]), 2))).astype(
            np.float32
        )
    matches = {}
    for i in range(1, count + 1):
        for j in range(i + 1, count + 1):
            same = (i <= count // 2) == (j <= count // 2)
            there = j if same else j - count // 2
            if abs(there - i) > reach:
                continue
            patterns = [rows[i] % points if not same else rows[i], rows[j] % points if not same else rows[j]]
            kept = [pattern[pattern < doubles] if not same else pattern for pattern in patterns]
            shared = np.intersect1d(*kept)
            shared = np.sort(shared[rng.permutation(len(shared))[:most]])
            if len(shared) >= 15:
                columns = [np.searchsorted(pattern, shared) for pattern in patterns]
                matches[i, j] = np.column_stack(columns).astype(np.uint32)
    names = {number: f"{number:03}.jpg" for number in poses}
    verified = ViewGraph(names, dict.fromkeys(poses, 1), {1: lens}, keypoints, dict(sorted(matches.items())))
    return Ring(poses, places, rows, verified)


def folded(ring: Ring, alike: float) -> pycolmap.Reconstruction:
    """Return the model with the second half of the photos turned onto the first, and the doubles merged."""
    count, points = len(ring.poses), len(ring.points) // 2
    second = range(count // 2 + 1, count + 1)
    model = model_of(ring, moved(ring, second, np.zeros(3), turn_up(180.0), 1.0))
    doubles = int(alike * points)
    back = np.concatenate([ring.points[:points], ring.points[points:] @ turn_up(180.0).T])
    seen: dict[int, list[tuple[int, int]]] = {}
    for number, rows in ring.rows.items():
        for keypoint, row in enumerate(rows.tolist()):
            pattern = row % points if row % points < doubles else row
            seen.setdefault(pattern, []).append((number, keypoint))
    for pattern, track in sorted(seen.items()):
        if len(track) >= 2:
            elements = [pycolmap.TrackElement(*element) for element in track]
            model.add_point3D(back[pattern], pycolmap.Track(elements), np.zeros(3, np.uint8))
    return model


def unfolded(ring: Ring) -> pycolmap.Reconstruction:
    """Return the right model."""
    model = model_of(ring)
    add_points(model, ring, sorted(ring.poses), np.eye(3, 4))
    return model
