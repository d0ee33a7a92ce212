"""Points seen through known lenses, as if after mapping: simple lenses, adjusted to noisy keypoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pycolmap

from splatpipe.pipeline.sfm.lenses.lens_model import simplest
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

WIDTH, HEIGHT = 1200, 900
TRACK = 9  # photos that would observe a point if it were in view of all


@dataclass(frozen=True)
class LensScene:
    """A model with simple lenses, its view graph, and the true lenses."""

    model: pycolmap.Reconstruction
    verified: ViewGraph
    lenses: Mapping[int, pycolmap.Camera]


def make_lens(model: str, params: Sequence[float], number: int = 1) -> pycolmap.Camera:
    """Return a camera of the scenes' size."""
    return pycolmap.Camera(camera_id=number, model=model, width=WIDTH, height=HEIGHT, params=list(params))


def look_from(centre: np.ndarray, at: np.ndarray, roll: float) -> np.ndarray:
    """Return the pose (camera from world, (3, 4)) of a camera that looks at a place."""
    forward = (at - centre) / np.linalg.norm(at - centre)
    side = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    down = np.cross(forward, side)
    turned = np.cos(roll) * side + np.sin(roll) * down
    rotation = np.stack([turned, np.cross(forward, turned), forward])
    return np.concatenate([rotation, -(rotation @ centre)[:, None]], axis=1)


def orbit(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return oblique poses from two heights around a place, some turned to portrait."""
    poses = []
    for k in range(count):
        angle, high = 2.0 * np.pi * k / count, k % 2
        centre = np.array([np.cos(angle), np.sin(angle), 0.5 + 0.6 * high]) * (14.0 if high else 17.0)
        poses.append(
            look_from(centre, rng.normal(0.0, 1.0, 3), rng.normal(0.0, 0.1) + (np.pi / 2 if k % 5 == 0 else 0))
        )
    return poses


def strips(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return nadir poses from one height, in parallel strips of one direction."""
    poses = []
    for k in range(count):
        centre = np.array([3.0 * (k % 6) - 7.5, 4.0 * (k // 6) - 6.0, 14.0]) + rng.normal(0.0, 0.1, 3)
        poses.append(look_from(centre, centre * [1.0, 1.0, 0.0], rng.normal(0.0, 0.01)))
    return poses


def make_scene(
    lenses: Sequence[pycolmap.Camera],
    poses: Sequence[np.ndarray],
    seed: int,
    flat: bool = False,
    points: int = 1000,
    noise_px: float = 0.5,
) -> LensScene:
    """Project points through the lenses, assigned to photos in turn, and adjust a model of simple lenses to them."""
    rng = np.random.default_rng(seed)
    spread = [12.0, 10.0, 0.02] if flat else [11.0, 11.0, 3.0]
    places = rng.uniform(-1.0, 1.0, (points, 3)) * spread
    lens_of = [lenses[k % len(lenses)] for k in range(len(poses))]
    model, cameras = pycolmap.Reconstruction(), {}
    for lens in lenses:
        name, params = simplest(lens)
        cameras[lens.camera_id] = make_lens(name, params, lens.camera_id)
        cameras[lens.camera_id].has_prior_focal_length = True
        model.add_camera_with_trivial_rig(cameras[lens.camera_id])
    seen: list[list[tuple[int, int]]] = [[] for _ in places]
    keypoints = {}
    for number, (pose, lens) in enumerate(zip(poses, lens_of, strict=True), start=1):
        in_camera = places @ pose[:, :3].T + pose[:, 3]
        projected = np.asarray(lens.img_from_cam(in_camera))
        inside = (in_camera[:, 2] > 0.1) & (projected > 0.0).all(axis=1) & (projected < [WIDTH, HEIGHT]).all(axis=1)
        keypoints[number] = np.zeros((0, 2), np.float32)
        rows = []
        for index in np.flatnonzero(inside).tolist():
            if rng.uniform() < TRACK / len(poses):
                seen[index].append((number, len(rows)))
                rows.append(projected[index] + rng.normal(0.0, noise_px, 2))
        keypoints[number] = np.array(rows, np.float32).reshape(-1, 2)
        image = pycolmap.Image(f"{number:03}.jpg", keypoints[number].astype(np.float64), lens.camera_id, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    matches: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for place, elements in zip(places, seen, strict=True):
        if len(elements) >= 2:
            track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
            model.add_point3D(place, track, np.zeros(3, np.uint8))
            for (first, k), (second, j) in pairwise(elements):
                matches.setdefault((first, second), []).append((k, j))
    verified = ViewGraph(
        {number: f"{number:03}.jpg" for number in keypoints},
        {number: lens.camera_id for number, lens in enumerate(lens_of, start=1)},
        {number: pycolmap.Camera(camera.todict()) for number, camera in cameras.items()},
        keypoints,
        {pair: np.array(rows, np.uint32) for pair, rows in sorted(matches.items())},
    )
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.solver_options.num_threads = 1
    options.refine_focal_length = not flat  # which mapping holds fixed if it is not set
    pycolmap.bundle_adjustment(model, options)
    return LensScene(model, verified, {lens.camera_id: lens for lens in lenses})
