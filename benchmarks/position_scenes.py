"""Flights with known cameras, ground and position errors, drawn from a seed; geometry only, nothing is rendered.

Strips of 48 photos straight down from 44 m (GSD 2.3 cm), and the demo's oblique photos of a house. World: east, north,
up in metres.
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
from splatpipe.pipeline.survey.block import Block
from splatpipe.pipeline.survey.position_adjustment import LensKnowledge, prior_lens
from splatpipe.pipeline.survey.position_noise import StatedPositions
from splatpipe.pipeline.survey.tie_points import intersected

SCENES = ("flat", "relief", "alternating", "one heading", "demo")
FAULTS = ("none", "wrong", "no fix", "datum", "too small", "too large")

STRIPS, PER_STRIP = 6, 8
HEIGHT_M, FOCAL_PX, SIZE_PX = 44.0, 1920.0, (1600, 1300)
ALONG, ACROSS = 0.8, 0.7  # overlaps
APART_M = 8.0  # between the heights of alternating strips
RELIEF_M = 5.0
STEADY_M = np.array([0.2, 0.2, 0.1])  # of the aircraft about its plan
TILT_DEG = 0.5
TIES = 150  # of a photo
TIE_PX = 1.0
WIDEST = 0.9  # tangent of a ray's angle up to which the lens is drawn
CLUTCH = math.cos(math.radians(30.0))  # a point is matched among rays that differ by less

HOUSE_M = np.array([6.0, 4.5, 7.0])  # half length, half width, height
GARDEN_M, NEAR_M, FAR_M = 25.0, 5.0, 40.0
GRAZING = math.cos(math.radians(72.0))

WHITE_M = np.array([0.01, 0.01, 0.018])
DRIFT_M = np.array([0.01, 0.01, 0.018])
DRIFT = 0.9  # correlation from photo to photo
COMMON_M = np.array([0.01, 0.01, 0.015])
STATED_M = np.array([0.014, 0.014, 0.021])

LENS_SPREAD = {"f": 0.01, "c": 20.0, "k1": 0.02, "k2": 0.02, "p": 0.001}
START_M, START_DEG = 0.05, 0.1  # of the cameras before the adjustment

WRONG_SHARE, WRONG_M = 0.1, (0.3, 5.0)
NO_FIX_M, NO_FIX_DRIFT = 0.5, 0.98
DATUM_M = 47.0


@dataclass(frozen=True)
class Flight:
    """Cameras as flown: world to camera, centres (metres), the strip of each, and how far below them the ground is."""

    rotations: Float64[np.ndarray, "n 3 3"]
    centres: Float64[np.ndarray, "n 3"]
    strip: Int64[np.ndarray, " n"]


@dataclass(frozen=True)
class Scene:
    """A flight and what was observed of it.

    Attributes:
        flight: The true cameras.
        camera: The true lens.
        stated: The stated lens.
        points: True tie points.
        block: The observations, and the state in which structure from motion leaves it.
        positions: As stated by the receiver.
        wrong: Which of them have a blunder.
        gsd_m: Of a typical tie point.
    """

    flight: Flight
    camera: pycolmap.Camera
    stated: pycolmap.Camera
    points: Float64[np.ndarray, "p 3"]
    block: Block
    positions: StatedPositions
    wrong: Bool[np.ndarray, " n"]
    gsd_m: float


def draw_scene(name: str, fault: str, seed: int) -> Scene:
    """Draw a scene; all but its fault is the same for one name and seed.

    Args:
        name: One of ``SCENES``.
        fault: One of ``FAULTS``.
        seed: Of everything drawn.
    """
    rng = np.random.default_rng([SCENES.index(name), seed])
    flight = demo_flight() if name == "demo" else _strips(name, rng)
    stated, camera = _lenses(name, rng)
    points, normals = _garden(rng) if name == "demo" else _ground(name, flight, rng)
    photo, point, pixels = _observed(flight, camera, points, normals, name == "demo", rng)
    points, n = points[: point.max() + 1], len(flight.centres)
    away = np.linalg.norm(points[point] - flight.centres[photo], axis=1)
    turns = rotation_from_vector(math.radians(START_DEG) * rng.normal(size=(n, 3)))
    block = Block(
        turns @ flight.rotations,
        flight.centres + START_M * rng.normal(size=(n, 3)),
        np.zeros(n, dtype=np.int64),
        (prior_lens(stated, LensKnowledge(float(stated.params[0]), LENS_SPREAD["f"]), None),),
        points,
        photo,
        point,
        pixels + TIE_PX * rng.normal(size=pixels.shape),
        np.full(len(photo), TIE_PX),
        points,
        np.zeros_like(points),
    )
    positions, wrong = _positions(flight, fault, rng)
    gsd_m = float(np.median(away)) / FOCAL_PX if name == "demo" else HEIGHT_M / FOCAL_PX
    if name == "demo":
        gsd_m = float(np.median(away)) / float(stated.params[0])
    return Scene(flight, camera, stated, points, intersected(block), positions, wrong, gsd_m)


def demo_flight() -> Flight:
    """The demo's true cameras, in the order of their names."""
    photos = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))["photos"]
    poses = np.array([photo["cam_from_world"] for photo in photos])[:, :3, :3]
    centres = np.array([photo["centre_m"] for photo in photos])
    return Flight(poses, centres, np.arange(len(photos)) * STRIPS // len(photos))


def _strips(name: str, rng: np.random.Generator) -> Flight:
    """Strips to and fro, the longer side of the photos across them."""
    step = (1.0 - ALONG) * SIZE_PX[1] / FOCAL_PX * HEIGHT_M
    apart = (1.0 - ACROSS) * SIZE_PX[0] / FOCAL_PX * HEIGHT_M
    rotations, centres = [], []
    for strip in range(STRIPS):
        back = strip % 2 == 1
        level = HEIGHT_M + (APART_M * (0.5 - back) if name == "alternating" else 0.0)
        turned = -1.0 if back and name != "one heading" else 1.0
        for place in range(PER_STRIP):
            along = (place if not back else PER_STRIP - 1 - place) - 0.5 * (PER_STRIP - 1)
            centres.append([apart * (strip - 0.5 * (STRIPS - 1)), step * along, level])
            rotations.append(np.diag([turned, -turned, -1.0]))
    n = len(centres)
    tilts = np.column_stack([math.radians(TILT_DEG) * rng.normal(size=(n, 2)), np.zeros(n)])
    moved = np.array(centres) + STEADY_M * rng.normal(size=(n, 3))
    return Flight(rotation_from_vector(tilts) @ np.array(rotations), moved, np.arange(n) // PER_STRIP)


def _lenses(name: str, rng: np.random.Generator) -> tuple[pycolmap.Camera, pycolmap.Camera]:
    """The stated lens and the true one."""
    size, focal, k1, k2 = (1200, 900), 851.3, -0.052, 0.0
    if name != "demo":
        size, focal, k1, k2 = SIZE_PX, FOCAL_PX, -0.1, 0.05
    params = np.array([focal, focal, 0.5 * size[0], 0.5 * size[1], k1, k2, *np.zeros(6)])
    change = np.zeros(12)
    change[:2] = focal * LENS_SPREAD["f"] * rng.normal()
    change[2:4] = LENS_SPREAD["c"] * rng.normal(size=2)
    change[4:6] = np.array([LENS_SPREAD["k1"], LENS_SPREAD["k2"]]) * rng.normal(size=2)
    change[6:8] = LENS_SPREAD["p"] * rng.normal(size=2)
    stated, true = (
        pycolmap.Camera(camera_id=1, model="FULL_OPENCV", width=size[0], height=size[1], params=params + each)
        for each in (np.zeros(12), change)
    )
    return stated, true


def _ground(
    name: str, flight: Flight, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3"]]:
    """Points of the ground below a flight, and its normals: level, or hills of ``RELIEF_M`` from foot to top."""
    reach = np.abs(flight.centres[:, :2]).max(axis=0) + 0.5 * HEIGHT_M
    plan = rng.uniform(-reach, reach, (4000, 2))
    heights = np.zeros(len(plan))
    if name == "relief":
        for _ in range(4):
            wave, phase = rng.normal(size=2) * 2.0 * math.pi / 60.0, rng.uniform(0.0, 2.0 * math.pi)
            heights += np.sin(plan @ wave + phase)
        heights = RELIEF_M * (heights - heights.min()) / np.ptp(heights) - 0.5 * RELIEF_M
    return np.column_stack([plan, heights]), np.tile([0.0, 0.0, 1.0], (len(plan), 1))


def _garden(rng: np.random.Generator) -> tuple[Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3"]]:
    """Points of the demo's ground, and of a box in place of its house, with their normals."""
    count = 6000
    kind = rng.integers(0, 8, count)  # 0 to 3 ground, then walls and roof
    axis, side = np.where(kind == 7, 2, np.where(kind < 6, 0, 1)), np.where(rng.random(count) < 0.5, 1.0, -1.0)
    points = HOUSE_M * np.column_stack([rng.uniform(-1.0, 1.0, (count, 2)), rng.random(count)])
    side[kind == 7] = 1.0
    rows = np.arange(count)
    points[rows, axis] = side * HOUSE_M[axis]
    normals = np.zeros((count, 3))
    normals[rows, axis] = side
    yaw = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))["house_yaw_deg"]
    turn = rotation_from_vector(np.array([0.0, 0.0, math.radians(yaw)]))
    points, normals = points @ turn.T, normals @ turn.T
    ground = kind < 4
    points[ground] = np.column_stack([rng.uniform(-GARDEN_M, GARDEN_M, (count, 2)), np.zeros(count)])[ground]
    normals[ground] = [0.0, 0.0, 1.0]
    inside = ground & (np.abs((points @ turn)[:, :2]) < HOUSE_M[:2]).all(axis=1)
    return points[~inside], normals[~inside]


def _observed(
    flight: Flight,
    camera: pycolmap.Camera,
    points: Float64[np.ndarray, "p 3"],
    normals: Float64[np.ndarray, "p 3"],
    oblique: bool,
    rng: np.random.Generator,
) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"], Float64[np.ndarray, "m 2"]]:
    """Photo, point and exact pixel of the first points that give the photos ``TIES`` each, sorted by point."""
    n = len(flight.centres)
    ways = points[:, None] - flight.centres  # (p, n, 3)
    rays = np.einsum("nij,pnj->pni", flight.rotations, ways)
    seen = (rays[..., 2] > 1.0) & (np.hypot(rays[..., 0], rays[..., 1]) < WIDEST * rays[..., 2])
    pixels = np.full((*seen.shape, 2), np.nan)
    pixels[seen] = np.asarray(camera.img_from_cam(rays[seen]), np.float64)
    seen &= ((pixels > 0.0) & (pixels < [camera.width, camera.height])).all(axis=2)
    if oblique:
        away = np.linalg.norm(ways, axis=2)
        units = ways / away[..., None]
        seen &= (away > NEAR_M) & (away < FAR_M) & (-np.einsum("pna,pa->pn", units, normals) > GRAZING)
        seen &= ~_behind_house(flight.centres, points)
        home = np.argmax(np.where(seen, rng.random(seen.shape), -1.0), axis=1)
        seen &= np.einsum("pna,pa->pn", units, units[np.arange(len(points)), home]) > CLUTCH
    seen[seen.sum(axis=1) < 3] = False
    enough = int(np.searchsorted(np.cumsum(seen.sum(axis=1)), TIES * n))
    kept = np.flatnonzero(seen[:enough].any(axis=1))
    points[: len(kept)] = points[kept]
    point, photo = np.nonzero(seen[kept])
    return photo, point, pixels[kept][point, photo]


def _behind_house(
    centres: Float64[np.ndarray, "n 3"], points: Float64[np.ndarray, "p 3"]
) -> Bool[np.ndarray, "p n"]:
    """Whether the line from a camera to a point passes through the house."""
    yaw = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))["house_yaw_deg"]
    turn = rotation_from_vector(np.array([0.0, 0.0, math.radians(yaw)]))
    start, way = centres @ turn, (points @ turn)[:, None] - centres @ turn
    low, high = np.array([-HOUSE_M[0], -HOUSE_M[1], -1.0]), HOUSE_M
    with np.errstate(divide="ignore"):
        first, second = (low - start) / way, (high - start) / way
    enter = np.minimum(first, second).max(axis=2)
    leave = np.maximum(first, second).min(axis=2)
    return np.asarray((enter < leave) & (enter > 0.0) & (enter < 1.0 - 1e-6))


def drift(count: int, correlation: float, rng: np.random.Generator) -> Float64[np.ndarray, "k 3"]:
    """Errors of unit size that drift from photo to photo."""
    errors = rng.normal(size=(count, 3))
    for k in range(1, count):
        errors[k] = correlation * errors[k - 1] + math.sqrt(1.0 - correlation**2) * errors[k]
    return errors


def _positions(
    flight: Flight, fault: str, rng: np.random.Generator
) -> tuple[StatedPositions, Bool[np.ndarray, " n"]]:
    """The receiver's positions, and which of them have a blunder."""
    n = len(flight.centres)
    group = np.where(flight.strip >= STRIPS // 2, 1, 0) if fault == "datum" else np.zeros(n, dtype=np.int64)
    errors = WHITE_M * rng.normal(size=(n, 3))
    for number in range(group.max() + 1):
        mine = group == number
        errors[mine] += DRIFT_M * drift(int(mine.sum()), DRIFT, rng) + COMMON_M * rng.normal(size=3)
    wrong, state, sigmas = np.zeros(n, dtype=bool), np.full(n, "fixed", dtype=object), np.tile(STATED_M, (n, 1))
    apart = np.zeros((group.max() + 1, 3), dtype=bool)
    if fault == "wrong":
        wrong[rng.choice(n, round(WRONG_SHARE * n), replace=False)] = True
        ways = rng.normal(size=(n, 3))
        sizes = np.exp(rng.uniform(*np.log(WRONG_M), n))[:, None]
        errors[wrong] += (sizes * ways / np.linalg.norm(ways, axis=1, keepdims=True))[wrong]
    elif fault == "no fix":
        unfixed = flight.strip == rng.integers(STRIPS)
        state[unfixed] = "single"
        errors[unfixed] += NO_FIX_M * drift(int(unfixed.sum()), NO_FIX_DRIFT, rng)
    elif fault == "datum":
        errors[group == 1, 2] += DATUM_M
        apart[1, 2] = True
    elif fault in ("too small", "too large"):
        sigmas *= 0.1 if fault == "too small" else 10.0
    stated = flight.centres + errors
    return StatedPositions(np.arange(n), stated, sigmas, group, tuple(state.tolist()), apart), wrong
