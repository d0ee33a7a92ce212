"""Flights with known cameras, ground and position errors, drawn from a seed; geometry only, nothing is rendered.

Strips of 48 photos straight down from 44 m (GSD 2.3 cm), a large block of 1,120, and the demo's oblique photos of a
house, which is a box here. World: east, north, up in metres.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Int64

from splatpipe.demo import CAPTURE
from splatpipe.pipeline.geometry.similarity import rotation_from_vector
from splatpipe.pipeline.survey.adjustment.block import Block
from splatpipe.pipeline.survey.adjustment.position_adjustment import LensKnowledge, prior_lens
from splatpipe.pipeline.survey.adjustment.position_noise import StatedPositions
from splatpipe.pipeline.survey.adjustment.tie_points import intersected

SCENES = ("flat", "relief", "alternating", "one heading", "demo")
LARGE = "large"  # flat, too; takes minutes, so it is drawn only on request
FAULTS = ("none", "wrong", "no fix", "datum", "too small", "too large")
STRIPS, PER_STRIP, ALONG, ACROSS = 6, 8, 0.8, 0.7  # photos, and their overlaps
LARGE_STRIPS, LARGE_PER_STRIP = 28, 40
HEIGHT_M, FOCAL_PX, SIZE_PX = 44.0, 1920.0, (1600, 1300)
APART_M, RELIEF_M = 8.0, 5.0  # between the heights of alternating strips; of the hills, from foot to top
# Standard deviations of the aircraft's place and tilt about its plan.
STEADY_M, TILT_DEG = np.array([0.2, 0.2, 0.1]), 0.5
TIES_PER_PHOTO, TIE_PX = 150, 1.0  # tie points per photo, and standard deviation of their noise
CANDIDATES, PER_PHOTO = 5000, 14  # points drawn, and more of many photos
MAX_RAY_TANGENT = 0.9  # tangent of a ray's angle up to which the lens is drawn
MATCHED = math.cos(math.radians(30.0))  # a point is matched among rays that differ by less
GRAZING = math.cos(math.radians(72.0))
HOUSE_M, GARDEN_M = np.array([6.0, 4.5, 7.0]), 25.0  # half length, half width, height
NEAR_M, FAR_M = 5.0, 40.0
WHITE_M, DRIFT_M = np.array([0.01, 0.01, 0.018]), np.array([0.01, 0.01, 0.018])  # position noise
DRIFT, COMMON_M = 0.9, np.array([0.01, 0.01, 0.015])  # correlation from photo to photo; what a flight shares
STATED_M = np.array([0.014, 0.014, 0.021])
LENS_SPREAD = {"f": 0.01, "c": 20.0, "k": 0.02, "p": 0.001}  # about the stated one: relative, pixels, and as they are
START_M, START_DEG = 0.05, 0.1  # standard deviations of the cameras' errors before the adjustment
WRONG_SHARE, WRONG_M, NO_FIX_M, NO_FIX_DRIFT, DATUM_M = 0.1, (0.3, 5.0), 0.5, 0.98, 47.0


@dataclass(frozen=True)
class Scene:
    """A flight and what was observed of it.

    Attributes:
        rotations: World to camera, true.
        centres: True ones.
        camera: The true lens.
        stated: The stated lens.
        points: True tie points.
        block: The observations, and the state in which structure from motion leaves it.
        positions: As stated by the receiver.
        wrong: Which of them have a blunder.
        gsd_m: Of a typical tie point.
    """

    rotations: Float64[np.ndarray, "n 3 3"]
    centres: Float64[np.ndarray, "n 3"]
    camera: pycolmap.Camera
    stated: pycolmap.Camera
    points: Float64[np.ndarray, "p 3"]
    block: Block
    positions: StatedPositions
    wrong: Bool[np.ndarray, " n"]
    gsd_m: float


def draw_scene(name: str, fault: str, seed: int) -> Scene:
    """Draw a scene; all but the fault is the same for one name and seed.

    Args:
        name: One of ``SCENES``, or ``LARGE``.
        fault: One of ``FAULTS``.
        seed: Of everything drawn.
    """
    rng = np.random.default_rng([(*SCENES, LARGE).index(name), seed])
    truth = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))
    if name == "demo":
        rotations = np.array([photo["cam_from_world"] for photo in truth["photos"]])[:, :3, :3]
        centres = np.array([photo["centre_m"] for photo in truth["photos"]])
        points, normals = _garden(math.radians(truth["house_yaw_deg"]), rng)
    else:
        rotations, centres = _strips(name, rng)
        points, normals = _ground(centres, RELIEF_M if name == "relief" else 0.0, rng)
    stated, camera = _lenses(name, rng)
    rows, photo, point, pixels = _observed(rotations, centres, camera, points, normals, rng)
    points, n = points[rows], len(centres)
    known = LensKnowledge(float(stated.params[0]), LENS_SPREAD["f"])
    block = Block(
        rotation_from_vector(math.radians(START_DEG) * rng.normal(size=(n, 3))) @ rotations,
        centres + START_M * rng.normal(size=(n, 3)),
        np.zeros(n, dtype=np.int64),
        (prior_lens(stated, known, None),),
        points,
        photo,
        point,
        pixels + TIE_PX * rng.normal(size=pixels.shape),
        np.full(len(photo), TIE_PX),
        points,
        np.zeros_like(points),
    )
    gsd_m = float(np.median(np.linalg.norm(points[point] - centres[photo], axis=1))) / float(stated.params[0])
    positions, wrong = stated_positions(centres, fault, rng)
    return Scene(rotations, centres, camera, stated, points, intersected(block), positions, wrong, gsd_m)


def _strips(name: str, rng: np.random.Generator) -> tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3"]]:
    """Cameras of strips to and fro, the longer side of the photos across them."""
    strips, per_strip = (LARGE_STRIPS, LARGE_PER_STRIP) if name == LARGE else (STRIPS, PER_STRIP)
    strip, place = np.divmod(np.arange(strips * per_strip), per_strip)
    back = strip % 2 == 1
    along = np.where(back, -1.0, 1.0) * (place - 0.5 * (per_strip - 1)) * (1.0 - ALONG) * SIZE_PX[1]
    across = (strip - 0.5 * (strips - 1)) * (1.0 - ACROSS) * SIZE_PX[0]
    level = HEIGHT_M + (APART_M * (0.5 - back) if name == "alternating" else np.zeros(len(strip)))
    centres = np.column_stack([across * HEIGHT_M / FOCAL_PX, along * HEIGHT_M / FOCAL_PX, level])
    turned = np.where(back & (name != "one heading"), -1.0, 1.0)
    rotations = np.stack([turned, -turned, -np.ones(len(strip))], axis=1)[:, :, None] * np.eye(3)
    tilts = np.column_stack([math.radians(TILT_DEG) * rng.normal(size=(len(strip), 2)), np.zeros(len(strip))])
    return rotation_from_vector(tilts) @ rotations, centres + STEADY_M * rng.normal(size=centres.shape)


def _lenses(name: str, rng: np.random.Generator) -> tuple[pycolmap.Camera, pycolmap.Camera]:
    """The stated lens and the true one."""
    size, focal, k1, k2 = ((1200, 900), 851.3, -0.052, 0.0) if name == "demo" else (SIZE_PX, FOCAL_PX, -0.1, 0.05)
    params = np.array([focal, focal, 0.5 * size[0], 0.5 * size[1], k1, k2, *np.zeros(6)])
    drawn = rng.normal(size=7) * [LENS_SPREAD[key] for key in ("f", "c", "c", "k", "k", "p", "p")]
    true = params + np.array([focal * drawn[0], focal * drawn[0], *drawn[1:], *np.zeros(4)])
    stated, camera = (
        pycolmap.Camera(camera_id=1, model="FULL_OPENCV", width=size[0], height=size[1], params=each)
        for each in (params, true)
    )
    return stated, camera


def _ground(
    centres: Float64[np.ndarray, "n 3"], relief_m: float, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3"]]:
    """Points of the ground below a flight, and its normals, which are upright."""
    reach = np.abs(centres[:, :2]).max(axis=0) + 0.5 * HEIGHT_M
    count = max(CANDIDATES, PER_PHOTO * len(centres))
    plan = rng.uniform(-reach, reach, (count, 2))
    heights = np.sin(plan @ (0.1 * rng.normal(size=(2, 4))) + rng.uniform(0.0, 2.0 * math.pi, 4)).sum(axis=1)
    heights = relief_m * ((heights - heights.min()) / np.ptp(heights) - 0.5)
    return np.column_stack([plan, heights]), np.tile([0.0, 0.0, 1.0], (count, 1))


def _garden(yaw: float, rng: np.random.Generator) -> tuple[Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3"]]:
    """Points of the demo's ground, and of a box in place of its house, with their normals."""
    kind, rows = rng.integers(0, 8, CANDIDATES), np.arange(CANDIDATES)  # 0 to 3 ground; 4 to 6 walls; 7 roof
    axis = np.select([kind == 7, kind == 6], [2, 1], 0)
    side = np.where((kind == 7) | (rng.random(CANDIDATES) < 0.5), 1.0, -1.0)
    points = HOUSE_M * np.column_stack([rng.uniform(-1.0, 1.0, (CANDIDATES, 2)), rng.random(CANDIDATES)])
    points[rows, axis], normals = side * HOUSE_M[axis], np.zeros((CANDIDATES, 3))
    normals[rows, axis] = side
    ground = kind < 4
    points[ground] = rng.uniform(-GARDEN_M, GARDEN_M, (int(ground.sum()), 3)) * [1.0, 1.0, 0.0]
    normals[ground] = [0.0, 0.0, 1.0]
    outside = ~ground | (np.abs(points[:, :2]) > HOUSE_M[:2]).any(axis=1)
    turn = rotation_from_vector(np.array([0.0, 0.0, yaw]))
    return points[outside] @ turn.T, normals[outside] @ turn.T


def _observed(
    rotations: Float64[np.ndarray, "n 3 3"],
    centres: Float64[np.ndarray, "n 3"],
    camera: pycolmap.Camera,
    points: Float64[np.ndarray, "p 3"],
    normals: Float64[np.ndarray, "p 3"],
    rng: np.random.Generator,
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " m"], Int64[np.ndarray, " m"], Float64[np.ndarray, "m 2"]]:
    """The first points that give the photos ``TIES_PER_PHOTO`` each; photo, point and exact pixel of each."""
    ways = points[:, None] - centres  # (p, n, 3)
    rays = np.einsum("nij,pnj->pni", rotations, ways)
    away = np.linalg.norm(ways, axis=2)
    units = ways / away[..., None]
    seen = (rays[..., 2] > 1.0) & (np.hypot(rays[..., 0], rays[..., 1]) < MAX_RAY_TANGENT * rays[..., 2])
    seen &= (away > NEAR_M) & (away < 2.0 * FAR_M) & (-np.einsum("pna,pa->pn", units, normals) > GRAZING)
    pixels = np.full((*seen.shape, 2), np.nan)
    pixels[seen] = np.asarray(camera.img_from_cam(rays[seen]), np.float64)
    seen &= ((pixels > 0.0) & (pixels < [camera.width, camera.height])).all(axis=2)
    if not (rotations[:, 2, 2] < -0.9).all():  # oblique photos
        home = np.argmax(np.where(seen, rng.random(seen.shape), -1.0), axis=1)
        near = np.einsum("pna,pa->pn", units, units[np.arange(len(points)), home]) > MATCHED
        seen &= near & (away < FAR_M)
    seen[seen.sum(axis=1) < 3] = False
    enough = int(np.searchsorted(np.cumsum(seen.sum(axis=1)), TIES_PER_PHOTO * len(centres)))
    rows = np.flatnonzero(seen[:enough].any(axis=1))
    point, photo = np.nonzero(seen[rows])
    return rows, photo, point, pixels[rows][point, photo]


def _drift(count: int, correlation: float, rng: np.random.Generator) -> Float64[np.ndarray, "k 3"]:
    """Errors of unit size that drift from photo to photo."""
    errors = rng.normal(size=(count, 3))
    for k in range(1, count):
        errors[k] = correlation * errors[k - 1] + math.sqrt(1.0 - correlation**2) * errors[k]
    return errors


def stated_positions(
    centres: Float64[np.ndarray, "n 3"], fault: str, rng: np.random.Generator
) -> tuple[StatedPositions, Bool[np.ndarray, " n"]]:
    """The receiver's positions, and which of them have a blunder."""
    n = len(centres)
    group = 2 * np.arange(n) // n if fault == "datum" else np.zeros(n, dtype=np.int64)
    errors = WHITE_M * rng.normal(size=(n, 3))
    for number in range(int(group.max()) + 1):
        mine = group == number
        errors[mine] += DRIFT_M * _drift(int(mine.sum()), DRIFT, rng) + COMMON_M * rng.normal(size=3)
    state, sigmas, wrong = np.full(n, "fixed", dtype=object), np.tile(STATED_M, (n, 1)), np.zeros(n, dtype=bool)
    apart = np.zeros((int(group.max()) + 1, 3), dtype=bool)
    if fault == "wrong":
        wrong[rng.choice(n, round(WRONG_SHARE * n), replace=False)] = True
        ways, sizes = rng.normal(size=(n, 3)), np.exp(rng.uniform(*np.log(WRONG_M), (n, 1)))
        errors[wrong] += (sizes * ways / np.linalg.norm(ways, axis=1, keepdims=True))[wrong]
    elif fault == "no fix":
        unfixed = np.arange(n) // PER_STRIP == rng.integers(STRIPS)
        state[unfixed] = "single"
        errors[unfixed] += NO_FIX_M * _drift(int(unfixed.sum()), NO_FIX_DRIFT, rng)
    elif fault == "datum":
        errors[group == 1, 2] += DATUM_M
        apart[1, 2] = True
    elif fault in ("too small", "too large"):
        sigmas *= 0.1 if fault == "too small" else 10.0
    return StatedPositions(np.arange(n), centres + errors, sigmas, group, tuple(state.tolist()), apart), wrong
