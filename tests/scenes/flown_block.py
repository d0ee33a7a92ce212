"""A made flight straight down over relief: true cameras and points, observations, and stated positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from splatpipe.pipeline.survey.adjustment.block import Block
from splatpipe.pipeline.survey.adjustment.block_lens import Lens
from splatpipe.pipeline.survey.adjustment.position_adjustment import LensKnowledge, prior_lens
from splatpipe.pipeline.survey.adjustment.position_noise import StatedPositions
from splatpipe.pipeline.survey.adjustment.tie_points import intersected

WIDTH, HEIGHT, FOCAL = 800, 600, 900.0
SIGMAS_M = (0.014, 0.014, 0.021)


def camera(focal: float = FOCAL, k1: float = -0.08, centre: tuple[float, float] = (408.0, 294.0)) -> pycolmap.Camera:
    """A camera with distortion, of the wide model."""
    params = [focal, focal, *centre, k1, 0.03, 0.0005, -0.0004, 0.0, 0.0, 0.0, 0.0]
    return pycolmap.Camera(camera_id=1, model="FULL_OPENCV", width=WIDTH, height=HEIGHT, params=params)


@dataclass(frozen=True)
class FlownBlock:
    """A flight.

    Attributes:
        truth: The true block, with observed pixels.
        start: The block as SfM might leave it.
        positions: As stated, in the order of capture.
    """

    truth: Block
    start: Block
    positions: StatedPositions


def flown(
    seed: int = 0,
    strips: int = 4,
    photos: int = 6,
    steps_m: tuple[float, ...] = (0.0,),
    noise_px: float = 1.0,
    sigmas_m: tuple[float, float, float] = SIGMAS_M,
    focal_share: float = 0.01,
) -> FlownBlock:
    """Fly strips of photos at 40 m.

    Args:
        seed: Of all that is random.
        strips: Their number.
        photos: In each.
        steps_m: Height added to the strips in turn.
        noise_px: Of the observations.
        sigmas_m: Of the positions' errors, which are stated right.
        focal_share: Standard deviation of the stated focal length.
    """
    rng = np.random.default_rng(seed)
    centres, rotations = [], []
    for strip in range(strips):
        order = range(photos) if strip % 2 == 0 else reversed(range(photos))
        for k in order:
            centres.append([7.0 * k, 12.0 * strip, 40.0 + steps_m[strip % len(steps_m)]])
            down = Rotation.from_euler("x", 180.0, degrees=True)
            heading = Rotation.from_euler("z", 90.0 if strip % 2 == 0 else -90.0, degrees=True)
            tilt = Rotation.from_rotvec(np.radians(0.5) * rng.normal(size=3))
            rotations.append((tilt * down * heading).as_matrix())
    place, turn = np.array(centres), np.stack(rotations)
    ground = rng.uniform([-12.0, -12.0, 0.0], [7.0 * photos + 5.0, 12.0 * strips, 3.0], (400, 3))
    lens = camera()
    photo, point, pixels = [], [], []
    for k, (rotation, centre) in enumerate(zip(turn, place, strict=True)):
        projected = np.asarray(lens.img_from_cam((ground - centre) @ rotation.T))
        inside = np.flatnonzero(((projected > 0.0) & (projected < [WIDTH, HEIGHT])).all(axis=1))
        photo.append(np.full(len(inside), k))
        point.append(inside)
        pixels.append(projected[inside] + noise_px * rng.normal(size=(len(inside), 2)))
    order = np.lexsort((np.concatenate(photo), np.concatenate(point)))
    views = np.bincount(np.concatenate(point), minlength=len(ground))
    kept = (views >= 2)[np.concatenate(point)[order]]
    seen = views >= 2
    truth = Block(
        turn,
        place,
        np.zeros(len(place), dtype=np.int64),
        (lens_of(lens, FOCAL, focal_share),),
        ground[seen],
        np.concatenate(photo)[order][kept].astype(np.int64),
        (np.cumsum(seen) - 1)[np.concatenate(point)[order][kept]].astype(np.int64),
        np.concatenate(pixels)[order][kept],
        np.ones(int(kept.sum())),
        ground[seen],
        np.zeros((int(seen.sum()), 3)),
    )
    stated = FOCAL * (1.0 + focal_share * rng.normal())
    return FlownBlock(truth, disturbed(truth, stated, focal_share, rng), positions(truth, sigmas_m, rng))


def lens_of(lens: pycolmap.Camera, focal: float, share: float) -> Lens:
    """The lens with a stated focal length."""
    return prior_lens(lens, LensKnowledge(focal, share), None)


def disturbed(truth: Block, focal: float, share: float, rng: np.random.Generator) -> Block:
    """A block near the true one, with a lens that knows only the stated focal length."""
    turns = Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=(len(truth), 3))).as_matrix()
    centres = truth.centres + 0.1 * rng.normal(size=truth.centres.shape)
    plain = lens_of(camera(focal, 0.0, (WIDTH / 2, HEIGHT / 2)), focal, share)
    return intersected(replace(truth, rotations=turns @ truth.rotations, centres=centres, lenses=(plain,)))


def positions(truth: Block, sigmas_m: tuple[float, float, float], rng: np.random.Generator) -> StatedPositions:
    """Positions with independent errors, one flight."""
    count = len(truth)
    return StatedPositions(
        np.arange(count),
        truth.centres + rng.normal(size=(count, 3)) * sigmas_m,
        np.tile(np.array(sigmas_m), (count, 1)),
        np.zeros(count, dtype=np.int64),
        ("fixed",) * count,
        np.zeros((1, 3), dtype=bool),
    )
