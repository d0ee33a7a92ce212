"""A ring of photos as a view graph with known cameras, and models of it that are wrong in known ways."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from lens_scene import HEIGHT, WIDTH, look_from, make_lens

from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

FOCAL = 1000.0
NOISE_PX = 0.5

Pose = np.ndarray  # (3, 4) camera from world


@dataclass(frozen=True)
class Ring:
    """Photos 1, 2, … around a centre.

    Attributes:
        poses: Camera from world, by image id.
        points: (m, 3).
        rows: For each photo, the point that each keypoint shows.
        verified: Its view graph.
    """

    poses: Mapping[int, Pose]
    points: np.ndarray
    rows: Mapping[int, np.ndarray]
    verified: ViewGraph

    def centre(self, number: int) -> np.ndarray:
        pose = self.poses[number]
        return np.asarray(-pose[:, :3].T @ pose[:, 3])


def make_ring(
    count: int = 24, reach: int = 5, points: int = 400, most: int = 60, prior: bool = True, one_spot: bool = False
) -> Ring:
    """Return photos that match those up to ``reach`` places further on, with ``most`` matches each.

    They look inwards, or all outwards from one spot, where nothing determines distances.
    """
    rng = np.random.default_rng(7)
    places = rng.uniform(-1.0, 1.0, (points, 3)) * [6.0, 6.0, 3.0]
    lens = make_lens("SIMPLE_RADIAL", [FOCAL, WIDTH / 2, HEIGHT / 2, 0.0])
    lens.has_prior_focal_length = prior
    poses, rows, keypoints = {}, {}, {}
    for number in range(1, count + 1):
        angle = 2.0 * np.pi * number / count
        centre = np.array([20.0 * np.cos(angle), 20.0 * np.sin(angle), 6.0 + 2.0 * (number % 3)])
        pose = look_from(centre, rng.normal(0.0, 0.5, 3), 0.0)
        if one_spot:
            pose = look_from(np.zeros(3), centre * [1.0, 1.0, 0.1], 0.0)
        in_camera = places @ pose[:, :3].T + pose[:, 3]
        projected = np.asarray(lens.img_from_cam(in_camera))
        inside = (projected > 0.0).all(axis=1) & (projected < [WIDTH, HEIGHT]).all(axis=1)
        poses[number], rows[number] = pose, np.flatnonzero(inside)
        keypoints[number] = (projected[inside] + rng.normal(0.0, NOISE_PX, (inside.sum(), 2))).astype(np.float32)
    matches = {}
    for i in range(1, count + 1):
        for step in range(1, reach + 1):
            j = (i - 1 + step) % count + 1
            first, second = sorted((i, j))
            _, a, b = np.intersect1d(rows[first], rows[second], return_indices=True)
            kept = np.sort(rng.permutation(len(a))[: most - 5 * step])
            matches[first, second] = np.column_stack([a[kept], b[kept]]).astype(np.uint32)
    names = {number: f"{number:03}.jpg" for number in poses}
    verified = ViewGraph(names, dict.fromkeys(poses, 1), {1: lens}, keypoints, dict(sorted(matches.items())))
    return Ring(poses, places, rows, verified)


def model_of(
    ring: Ring, moved: Mapping[int, Pose] | None = None, focal: float = FOCAL, photos: Sequence[int] | None = None
) -> pycolmap.Reconstruction:
    """Return a model without points, with the ring's poses or others."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(make_lens("SIMPLE_RADIAL", [focal, WIDTH / 2, HEIGHT / 2, 0.0]))
    for number in photos or sorted(ring.poses):
        places = ring.verified.keypoints[number].astype(np.float64)
        image = pycolmap.Image(ring.verified.names[number], places, 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d((moved or {}).get(number, ring.poses[number])))
    return model


def add_points(model: pycolmap.Reconstruction, ring: Ring, photos: Sequence[int], world: np.ndarray) -> None:
    """Add the points that some photos see to a model, under a similarity (3, 4) of the world."""
    row_of = {number: {int(point): row for row, point in enumerate(ring.rows[number])} for number in photos}
    for index, point in enumerate(ring.points):
        seen = [(number, row_of[number][index]) for number in photos if index in row_of[number]]
        if len(seen) >= 2:
            track = pycolmap.Track([pycolmap.TrackElement(*element) for element in seen])
            model.add_point3D(world[:, :3] @ point + world[:, 3], track, np.zeros(3, np.uint8))


def moved(ring: Ring, photos: Sequence[int], about: np.ndarray, turn: np.ndarray, scale: float) -> dict[int, Pose]:
    """Return the poses of some photos after turning and scaling the world around them about a place."""
    result = {}
    for number in photos:
        rotation = ring.poses[number][:, :3] @ turn.T
        centre = about + scale * (turn @ (ring.centre(number) - about))
        result[number] = np.column_stack([rotation, -rotation @ centre])
    return result


def turn_up(degrees: float) -> np.ndarray:
    """Return a rotation about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def with_matches(ring: Ring, wrong: Mapping[tuple[int, int], int], seed: int = 1) -> ViewGraph:
    """Return the view graph with pairs whose matches only look alike."""
    rng = np.random.default_rng(seed)
    matches = dict(ring.verified.matches)
    for (i, j), count in wrong.items():
        a, b = (rng.permutation(len(ring.verified.keypoints[number]))[:count] for number in (i, j))
        matches[i, j] = np.column_stack([a, b]).astype(np.uint32)
    old = ring.verified
    return ViewGraph(old.names, old.camera_of, old.cameras, old.keypoints, dict(sorted(matches.items())))


def with_shifted_matches(ring: Ring, count: int, shift: float = 1.5) -> ViewGraph:
    """Return the view graph with pairs of distant photos that match as if the scene were shifted sideways by a bay.

    The wrong pairs agree with each other: their matches close, in rotation and translation.

    Args:
        ring: The ring.
        count: Number of wrong pairs.
        shift: World units.
    """
    rng = np.random.default_rng(3)
    matches, keypoints = dict(ring.verified.matches), {k: v.copy() for k, v in ring.verified.keypoints.items()}
    lens = ring.verified.cameras[1]
    far = [(i, j) for i in ring.poses for j in ring.poses if i < j and (i, j) not in matches]
    for i, j in [far[row] for row in np.sort(rng.permutation(len(far))[:count])]:
        places = ring.points[rng.permutation(len(ring.points))[:30]]
        projections = []
        for number, offset in ((i, 0.0), (j, shift)):
            pose = ring.poses[number]
            seen = np.asarray(lens.img_from_cam((places + np.array([0.0, offset, 0.0])) @ pose[:, :3].T + pose[:, 3]))
            projections.append(seen + rng.normal(0.0, NOISE_PX, seen.shape))
        inside = np.all([((it > 0.0) & (it < [WIDTH, HEIGHT])).all(axis=1) for it in projections], axis=0)
        columns = []
        for number, seen in zip((i, j), projections, strict=True):
            columns.append(len(keypoints[number]) + np.arange(inside.sum()))
            keypoints[number] = np.concatenate([keypoints[number], seen[inside].astype(np.float32)])
        matches[i, j] = np.column_stack(columns).astype(np.uint32)
    old = ring.verified
    return ViewGraph(old.names, old.camera_of, old.cameras, keypoints, dict(sorted(matches.items())))


def write_descriptors(ring: Ring, path: Path) -> None:
    """Write descriptors that match each point again into a database from ``write_database``."""
    rng = np.random.default_rng(11)
    of_point = rng.uniform(0.0, 1.0, (len(ring.points), 128)) ** 4
    of_point *= 512.0 / np.linalg.norm(of_point, axis=1, keepdims=True)
    with pycolmap.Database.open(path) as database:
        for number, rows in ring.rows.items():
            values = np.clip(of_point[rows] + rng.normal(0.0, 4.0, (len(rows), 128)), 0.0, 255.0).astype(np.uint8)
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, values))


def write_database(verified: ViewGraph, path: Path, keep: Callable[[int, int], bool] = lambda i, j: True) -> None:
    """Write the view graph as matching does."""
    with pycolmap.Database.open(path) as database:
        for camera in verified.cameras.values():
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for number, name in verified.names.items():
            image = pycolmap.Image(name=name, camera_id=verified.camera_of[number], image_id=number)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=verified.camera_of[number])
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            shapes = np.tile(np.array([1.0, 0.0, 0.0, 1.0], np.float32), (len(verified.keypoints[number]), 1))
            database.write_keypoints(number, np.hstack([verified.keypoints[number], shapes]))
        for (i, j), rows in verified.matches.items():
            if keep(i, j):
                one, two = (verified.cameras[verified.camera_of[number]] for number in (i, j))
                places = (verified.keypoints[i].astype(np.float64), verified.keypoints[j].astype(np.float64))
                geometry = pycolmap.estimate_calibrated_two_view_geometry(one, places[0], two, places[1], rows)
                database.write_two_view_geometry(i, j, geometry)
