"""Held-out tracks: how well adjusted cameras predict tracks that the adjustment did not use.

Each observation of a held-out track is predicted from the others: their rays are intersected, and the point is
projected into the observation's photo. This tests cameras and lenses, independently of the adjusted points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.meeting_rays import ray_equations

MIN_VIEWS = 3  # two that intersect, and one that is predicted
REWEIGHTINGS = 2  # rounds of weighting rays by the distance to the point from the previous round
MIN_ANGLE = 0.02  # its square is the minimum eigenvalue ratio: nearly parallel rays do not determine a point
MAX_ERROR_RATIO = 4.0  # times the median error: a single wrong match must not decide
BOOTSTRAPS = 500
MAX_UNIMPROVED_SHARE = 0.01  # share of the bootstrap samples that may show no improvement


@dataclass(frozen=True)
class TrackObservations:
    """Observations of tracks, track after track.

    Attributes:
        track: Track number of each observation, from 0; ascending for ``predicted_errors``.
        image: COLMAP's image id of each observation.
        pixels: Image coordinates of each observation, pixels.
    """

    track: Int64[np.ndarray, " n"]
    image: Int64[np.ndarray, " n"]
    pixels: Float64[np.ndarray, "n 2"]


def tracks_of(model: pycolmap.Reconstruction, points: Int64[np.ndarray, " k"]) -> TrackObservations:
    """Return the observations of some of a model's points, in the order given."""
    rows = [
        (number, element.image_id, *model.images[element.image_id].points2D[element.point2D_idx].xy)
        for number, point in enumerate(points.tolist())
        for element in model.points3D[point].track.elements
    ]
    table = np.array(rows, np.float64).reshape(-1, 4)
    return TrackObservations(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:])


def of_photos(tracks: TrackObservations, images: set[int]) -> TrackObservations:
    """Restrict tracks to some photos, and keep those with three observations or more."""
    inside = np.isin(tracks.image, sorted(images))
    lengths = np.bincount(tracks.track[inside], minlength=int(tracks.track.max(initial=-1)) + 1)
    inside &= lengths[tracks.track] >= MIN_VIEWS
    _, numbers = np.unique(tracks.track[inside], return_inverse=True)
    return TrackObservations(numbers.astype(np.int64), tracks.image[inside], tracks.pixels[inside])


def predicted_errors(model: pycolmap.Reconstruction, tracks: TrackObservations) -> Float64[np.ndarray, " n"]:
    """Compute the distance of each observation from its prediction by the others of its track.

    Args:
        model: Supplies poses and lenses; its points are not used.
        tracks: Tracks of three observations or more.

    Returns:
        Errors, pixels; infinite where the other observations do not determine a point.
    """
    rotations, centres, rays = world_rays(model, tracks)
    count = int(tracks.track[-1]) + 1 if len(tracks.track) else 0
    weights = np.any(rays, axis=1).astype(np.float64)
    predicted = np.zeros((len(rays), 3))
    for _ in range(REWEIGHTINGS):
        equations = ray_equations(tracks.track, count, centres, rays, weights)
        left = equations.whole[tracks.track] - equations.across
        sound = np.isfinite(left).all(axis=(1, 2)) & (weights > 0.0)
        sound[sound] = _well_placed(left[sound])
        left[~sound] = np.eye(3)
        sides = equations.side[tracks.track] - equations.pulled
        predicted = np.linalg.solve(left, sides[:, :, None])[:, :, 0]
        distance = np.linalg.norm(predicted - centres, axis=1)
        weights = np.where(sound, 1.0 / np.maximum(distance, 1e-9) ** 2, 0.0)
    errors = np.full(len(rays), np.inf)
    in_camera = np.einsum("nij,nj->ni", rotations, predicted - centres)
    ahead = (in_camera[:, 2] > 0.0) & (weights > 0.0)
    for number, rows in rows_by_camera(model, tracks):
        rows = rows[ahead[rows]]
        if len(rows):
            projected = np.asarray(model.cameras[number].img_from_cam(in_camera[rows]), np.float64)
            distance = np.linalg.norm(projected - tracks.pixels[rows], axis=1)
            errors[rows] = np.where(np.isfinite(distance), distance, np.inf)
    return errors


def improves(
    before: Float64[np.ndarray, " n"],
    after: Float64[np.ndarray, " n"],
    images: Int64[np.ndarray, " n"],
    least: float,
    seed: int,
) -> tuple[float, bool]:
    """Test whether errors decreased significantly, by a bootstrap over photos.

    Args:
        before: Errors, pixels.
        after: Errors of the same observations, pixels.
        images: Photo of each observation: errors within a photo are correlated.
        least: Required relative reduction of the sum of squares.
        seed: For the bootstrap.

    Returns:
        The relative reduction, and whether it reaches ``least`` and nearly all bootstrap samples show a reduction.
    """
    if not len(before):
        return 0.0, False
    _, photo = np.unique(images, return_inverse=True)
    cap = MAX_ERROR_RATIO * float(np.median(before))
    if not math.isfinite(cap):
        return 0.0, False
    was = np.bincount(photo, np.minimum(before, cap) ** 2)
    gained = was - np.bincount(photo, np.minimum(after, cap) ** 2)
    share = float(gained.sum() / max(float(was.sum()), 1e-300))
    drawn = np.random.default_rng(seed).integers(0, len(was), (BOOTSTRAPS, len(was)))
    wrong = float((gained[drawn].sum(axis=1) <= 0.0).mean())
    return share, share >= least and wrong <= MAX_UNIMPROVED_SHARE


def _well_placed(left: Float64[np.ndarray, "n 3 3"]) -> Bool[np.ndarray, " n"]:
    values = np.linalg.eigvalsh(left)
    return np.asarray(values[:, 0] > MIN_ANGLE**2 * values[:, 2])


def rows_by_camera(
    model: pycolmap.Reconstruction, tracks: TrackObservations
) -> list[tuple[int, Int64[np.ndarray, " k"]]]:
    of_image = {number: model.images[number].camera_id for number in np.unique(tracks.image).tolist()}
    cameras = np.array([of_image[number] for number in tracks.image.tolist()], np.int64)
    return [(number, np.flatnonzero(cameras == number)) for number in np.unique(cameras).tolist()]


def world_rays(
    model: pycolmap.Reconstruction, tracks: TrackObservations
) -> tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Return for each observation the photo's rotation, its centre, and the unit ray in the model's frame.

    Rays that a lens cannot invert are zeros.
    """
    numbers, which = np.unique(tracks.image, return_inverse=True)
    matrices = [model.images[number].cam_from_world().matrix() for number in numbers.tolist()]
    poses = np.array(matrices, np.float64).reshape(-1, 3, 4)
    turns = poses[:, :, :3]
    centres = -np.einsum("nji,nj->ni", turns, poses[:, :, 3])
    flat = np.full((len(tracks.track), 3), 1.0)
    for number, rows in rows_by_camera(model, tracks):
        flat[rows, :2] = model.cameras[number].cam_from_img(tracks.pixels[rows])
    flat = np.where(np.isfinite(flat).all(axis=1)[:, None], flat, 0.0)
    flat /= np.maximum(np.linalg.norm(flat, axis=1), 1e-12)[:, None]
    return turns[which], centres[which], np.einsum("nji,nj->ni", turns[which], flat)
