"""A film's frames of points, taken through a shutter of known readout time, as if after mapping."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pycolmap

from splatpipe.pipeline.photos.video.film_times import FilmTimes
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

WIDTH, HEIGHT, FRAME_S = 1920, 1080, 1.0 / 30.0
TRACK = 7  # frames in a row, of those that have it in view, that observe a point
Poses = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class FilmScene:
    """A model adjusted as if the shutter were global, its view graph, the frames' times and true centres."""

    model: pycolmap.Reconstruction
    verified: ViewGraph
    film: FilmTimes
    centres: Mapping[int, np.ndarray]


def around(times_s: np.ndarray) -> np.ndarray:
    """The poses (camera from world, (n, 3, 4)) of a flight around a house, climbing and sinking, 5 m/s."""
    angle, climb = 2.0 * np.pi * times_s / 30.0, 2.0 * np.pi * times_s / 60.0
    centres = np.stack([24.0 * np.sin(angle), 24.0 * np.cos(angle), 10.5 - 3.5 * np.cos(climb)], axis=1)
    return _looking(centres, np.array([0.0, 0.0, 2.5]) - centres)


def along(times_s: np.ndarray) -> np.ndarray:
    """The poses of a flight straight on at 8 m/s and a height of 30 m, swaying, looking obliquely ahead."""
    centres = np.stack([0.3 * np.sin(0.7 * times_s), 8.0 * times_s - 100.0, 30.0 + 0.5 * np.sin(0.4 * times_s)], axis=1)
    sway = 0.02 * np.sin(0.9 * times_s)
    return _looking(centres, np.stack([30.0 * sway, np.full(len(sway), 12.0), np.full(len(sway), -30.0)], axis=1))


def _looking(centres: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    turns = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return np.concatenate([turns, -np.einsum("nij,nj->ni", turns, centres)[:, :, None]], axis=2)


def film_scene(
    poses_at: Poses,
    times_s: Sequence[float],
    readout_s: float,
    seed: int,
    lens: Sequence[float] = (1382.0, WIDTH / 2, HEIGHT / 2, -0.02),
    model_name: str = "SIMPLE_RADIAL",
    noise_px: float = 0.4,
    points: int = 3000,
    size_m: Sequence[float] = (25.0, 25.0, 4.0),
) -> FilmScene:
    """Take frames of random points: each row when the shutter is there, found by iteration."""
    rng = np.random.default_rng(seed)
    camera = pycolmap.Camera(camera_id=1, model=model_name, width=WIDTH, height=HEIGHT, params=list(lens))
    places = rng.uniform(-1.0, 1.0, (points, 3)) * size_m
    taken = [_taken(camera, poses_at, time_s, readout_s, places) for time_s in times_s]
    observed = np.zeros((len(times_s), points), bool)
    for index in range(points):
        frames = np.flatnonzero([np.isfinite(pixels[index, 0]) for pixels in taken])
        begin = rng.integers(0, max(1, len(frames) - TRACK + 1))
        observed[frames[begin : begin + TRACK], index] = True
    seen: list[list[tuple[int, int]]] = [[] for _ in places]
    keypoints = {}
    poses = dict(enumerate(poses_at(np.array(times_s)), start=1))
    for number in poses:
        inside = np.flatnonzero(observed[number - 1])
        for row, index in enumerate(inside.tolist()):
            seen[index].append((number, row))
        noise = rng.normal(0.0, noise_px, (len(inside), 2))
        keypoints[number] = (taken[number - 1][inside] + noise).astype(np.float32)
    mapped = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[lens[0], WIDTH / 2, HEIGHT / 2, 0.0]
    )
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(mapped)
    for number, pose in poses.items():
        image = pycolmap.Image(f"film_{number:06}.jpg", keypoints[number].astype(np.float64), 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    matches: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for place, elements in zip(places, seen, strict=True):
        if len(elements) >= 2:
            track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
            model.add_point3D(place, track, np.zeros(3, np.uint8))
            for (first, k), (second, j) in combinations(elements, 2):
                matches.setdefault((first, second), []).append((k, j))
    names = {number: f"film_{number:06}.jpg" for number in poses}
    verified = ViewGraph(
        names,
        dict.fromkeys(poses, 1),
        {1: pycolmap.Camera(mapped.todict())},
        keypoints,
        {pair: np.array(rows, np.uint32) for pair, rows in sorted(matches.items())},
    )
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.gradient_tolerance = 1e-6
    options.ceres.solver_options.function_tolerance = 1e-7
    options.ceres.solver_options.max_num_iterations = 200
    pycolmap.bundle_adjustment(model, options)
    film = FilmTimes(FRAME_S, {names[number]: time_s for number, time_s in enumerate(times_s, start=1)})
    centres = {number: -pose[:, :3].T @ pose[:, 3] for number, pose in poses.items()}
    return FilmScene(model, verified, film, centres)


def _taken(camera: pycolmap.Camera, poses_at: Poses, time_s: float, readout_s: float, places: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of all points in a frame, NaN outside: each when its row is exposed, found by iteration."""
    pixels = np.full((len(places), 2), HEIGHT / 2.0)
    for _ in range(6 if readout_s else 1):
        poses = poses_at(time_s + readout_s * (pixels[:, 1] / HEIGHT - 0.5))
        in_camera = np.einsum("nij,nj->ni", poses[:, :, :3], places) + poses[:, :, 3]
        pixels = np.asarray(camera.img_from_cam(in_camera), np.float64).reshape(-1, 2)
        pixels = np.where(np.isfinite(pixels), np.clip(pixels, -1e4, 1e4), -1e4)
    inside = (in_camera[:, 2] > 0.5) & (pixels > 0.0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def centre_errors_m(scene: FilmScene, model: pycolmap.Reconstruction) -> np.ndarray:
    """Distances of a model's centres from the true ones after the best similarity."""
    from splatpipe.pipeline.geometry.similarity import fit_similarity

    numbers = sorted(model.reg_image_ids())
    found = np.stack([model.images[number].projection_center() for number in numbers])
    truth = np.stack([scene.centres[number] for number in numbers])
    scale, rotation, shift = fit_similarity(found, truth, np.ones(len(numbers)))
    return np.asarray(np.linalg.norm(scale * found @ rotation.T + shift - truth, axis=1))
