"""A synthetic flight with known cameras, written as a database of matches: grid strips and oblique strips.

The ground is rough (with houses and trees), keypoints are noisy, and the stated focal length is wrong. A fifth of each
pair's verified matches are outliers close to the epipolar line, like those that pass two-view verification. Pairs are
chosen by the pipeline's own rules from noisy positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.photos.intake.camera_groups import DEFAULT_FOCAL
from splatpipe.pipeline.sfm.pairing.footprints import StatedPoses
from splatpipe.pipeline.sfm.pairing.pairs import Layout, Pair, select_pairs

WIDTH, HEIGHT, FOCAL_PX, RADIAL = 2000, 1500, 1500.0, -0.04
FLYING_M = 60.0
GSD_M = FLYING_M / FOCAL_PX
RELIEF_M = 8.0  # range of the ground's heights
FORWARD_M, SIDE_M = 15.0, 26.0  # between photos of a strip and between strips: 3/4 and 2/3 overlap
OBLIQUE = 5  # every n-th strip looks to the side, 35° off the vertical
OBLIQUE_DEG = 35.0
MAX_TRACK = 12
OBSERVATIONS = 1700  # per photo; fewer near the border
DETECTED = 0.75  # share of the points in a photo that have a keypoint there
MATCHED = 0.8  # share of the keypoints common to two photos
NOISE_PX = 0.7
WRONG = 0.2  # share of the verified matches
EPIPOLAR_PX = 4.0  # distance from the epipolar line that COLMAP's two-view verification accepts
FOCAL_OFF = 1.03
POSITION_NOISE_M = 2.0
MIN_MATCHES = 15


@dataclass(frozen=True)
class SyntheticFlight:
    """The true geometry; photo i is COLMAP's image i + 1.

    Attributes:
        centres_m: East, north, up.
        cam_from_enu: Rotations; camera x right, y down, z forward.
        points_m: Points on the ground and on the objects that stand there.
        photo: Photo of each observation, sorted by photo.
        point: Point of each observation.
        places: Noisy image position of each observation, pixels.
    """

    centres_m: Float64[np.ndarray, "n 3"]
    cam_from_enu: Float64[np.ndarray, "n 3 3"]
    points_m: Float64[np.ndarray, "p 3"]
    photo: Int64[np.ndarray, " m"]
    point: Int64[np.ndarray, " m"]
    places: Float64[np.ndarray, "m 2"]

    def rows(self, photo: int) -> slice:
        """Return the rows of a photo's observations; its keypoint k is the k-th of them."""
        first, last = np.searchsorted(self.photo, [photo, photo + 1])
        return slice(int(first), int(last))


def lens(off: float = 1.0) -> pycolmap.Camera:
    """Return the true camera; with a factor other than 1, its focal length is scaled and its distortion dropped."""
    parameters = [FOCAL_PX * off, WIDTH / 2, HEIGHT / 2, RADIAL if off == 1.0 else 0.0]
    return pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=parameters)


def make_flight(count: int, seed: int, observations: int = OBSERVATIONS) -> SyntheticFlight:
    """Fly ``count`` photos over unbounded ground, with about ``observations`` points in each."""
    rng = np.random.default_rng(seed)
    centres, rotations = _poses(count, rng)
    low, high = centres[:, :2].min(axis=0) - FLYING_M, centres[:, :2].max(axis=0) + FLYING_M
    visible = (WIDTH / FOCAL_PX) * (HEIGHT / FOCAL_PX) * FLYING_M**2
    points = np.empty((int(np.prod(high - low) * observations / DETECTED / visible), 3))
    points[:, :2] = rng.uniform(low, high, (len(points), 2))
    points[:, 2] = _heights(points[:, :2], rng)
    seen = [_see(points, centres[i], rotations[i], rng) for i in range(count)]
    photo = np.repeat(np.arange(count), [len(found) for found, _ in seen])
    point = np.concatenate([found for found, _ in seen])
    places = np.concatenate([where for _, where in seen])
    kept = _capped(point, rng)
    return SyntheticFlight(centres, rotations, points, photo[kept], point[kept], places[kept])


def _poses(count: int, rng: np.random.Generator) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3 3"]]:
    """Return poses of back-and-forth strips over a square, with a drone's jitter."""
    across = max(1, round(np.sqrt(count * FORWARD_M / SIDE_M)))
    along = -(-count // across)
    centres, rotations = np.empty((count, 3)), np.empty((count, 3, 3))
    for number in range(count):
        strip, step = divmod(number, along)
        north = step if strip % 2 == 0 else along - 1 - step
        centres[number] = [strip * SIDE_M, north * FORWARD_M, FLYING_M]
        heading = 0.0 if strip % 2 == 0 else np.pi
        tilt = np.radians(OBLIQUE_DEG) if strip % OBLIQUE == OBLIQUE - 1 else 0.0
        rotations[number] = _tremble(rng) @ _turn(1, tilt) @ np.diag([1.0, -1.0, -1.0]) @ _turn(2, heading)
    return centres + rng.normal(0.0, [0.8, 0.8, 0.5], (count, 3)), rotations


def _turn(axis: int, angle: float) -> Float64[np.ndarray, "3 3"]:
    first, second = [other for other in range(3) if other != axis]
    turn = np.eye(3)
    turn[first, first] = turn[second, second] = np.cos(angle)
    turn[first, second], turn[second, first] = -np.sin(angle), np.sin(angle)
    return turn


def _tremble(rng: np.random.Generator) -> Float64[np.ndarray, "3 3"]:
    angles = rng.normal(0.0, np.radians(1.5), 3)
    return _turn(0, angles[0]) @ _turn(1, angles[1]) @ _turn(2, angles[2])


def _heights(places: Float64[np.ndarray, "p 2"], rng: np.random.Generator) -> Float64[np.ndarray, " p"]:
    """Return the heights of rolling ground with boxes on it."""
    rolling = np.sin(places[:, 0] / 37.0) * np.cos(places[:, 1] / 51.0)
    block = np.floor(places / 14.0).astype(np.int64)
    houses = rng.uniform(-1.0, 1.0, 4096)[(block[:, 0] * 61 + block[:, 1] * 17) % 4096]
    return np.asarray(RELIEF_M / 4.0 * rolling + RELIEF_M / 2.0 * np.maximum(houses, 0.0))


def _see(
    points: Float64[np.ndarray, "p 3"],
    centre: Float64[np.ndarray, " 3"],
    rotation: Float64[np.ndarray, "3 3"],
    rng: np.random.Generator,
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 2"]]:
    """Return the points visible in a photo, and their noisy pixel positions."""
    near = np.flatnonzero((np.abs(points[:, :2] - centre[:2]) < 2.5 * FLYING_M).all(axis=1))
    local = (points[near] - centre) @ rotation.T
    near, local = near[local[:, 2] > 1.0], local[local[:, 2] > 1.0]
    inside = (np.abs(local[:, :2] / local[:, 2:]) < 1.0).all(
        axis=1
    )  # far outside, the distortion polynomial turns back
    near, local = near[inside], local[inside]
    places = np.asarray(lens().img_from_cam(local)) + rng.normal(0.0, NOISE_PX, (len(local), 2))
    visible = (places > 0.0).all(axis=1) & (places < [WIDTH, HEIGHT]).all(axis=1) & (rng.random(len(local)) < DETECTED)
    order = rng.permutation(np.flatnonzero(visible))  # the keypoints' order must not help mapping
    return near[order], places[order]


def _capped(point: Int64[np.ndarray, " m"], rng: np.random.Generator) -> np.ndarray:
    """Return (m,) whether an observation is kept if tracks are limited to the longest length."""
    order = np.lexsort((rng.random(len(point)), point))
    counts = np.bincount(point)
    rank = np.arange(len(point)) - np.repeat(np.cumsum(counts) - counts, counts)
    kept = np.empty(len(point), bool)
    kept[order] = rank < MAX_TRACK
    return kept


def choose_pairs(flight: SyntheticFlight, seed: int, neighbours: int = 20) -> list[Pair]:
    """Choose pairs by the pipeline's rules, from noisy positions and gimbal angles."""
    rng = np.random.default_rng(seed)
    count = len(flight.centres_m)
    centres = flight.centres_m + rng.normal(0.0, POSITION_NOISE_M, (count, 3))
    enu_from_camera = np.swapaxes(flight.cam_from_enu, 1, 2)
    half = np.tile([WIDTH / FOCAL_PX / 2.0, HEIGHT / FOCAL_PX / 2.0], (count, 1))
    views = StatedPoses(centres, enu_from_camera, half, np.zeros(count), POSITION_NOISE_M)
    names = [f"{number:05d}.jpg" for number in range(count)]
    sigmas = np.full(count, POSITION_NOISE_M)
    layout = Layout(names, np.arange(count, dtype=np.float64), centres, sigmas, views.axes, views)

    def nothing() -> None:
        raise AssertionError("all photos have positions")

    return select_pairs(layout, "spatial", neighbours, nothing)  # type: ignore[arg-type]


def matches(
    flight: SyntheticFlight, pairs: list[Pair], seed: int
) -> Iterator[tuple[Pair, Int64[np.ndarray, "_ 2"], np.ndarray]]:
    """Yield verified matches of the pairs that have enough, a fifth of them wrong, with the true fundamental matrix."""
    rng = np.random.default_rng(seed)
    pinhole = lens().calibration_matrix()
    for i, j in pairs:
        rows = flight.rows(i), flight.rows(j)
        _, first, second = np.intersect1d(flight.point[rows[0]], flight.point[rows[1]], return_indices=True)
        drawn = np.flatnonzero(rng.random(len(first)) < MATCHED)
        true = np.stack([first[drawn], second[drawn]], axis=1)
        fundamental = _fundamental(flight, i, j, pinhole)
        wrong = _wrong(flight, rows, true, fundamental, round(len(true) * WRONG / (1.0 - WRONG)), rng)
        found = np.concatenate([true, wrong])
        if len(found) >= MIN_MATCHES:
            yield (i, j), found[np.lexsort((found[:, 1], found[:, 0]))], fundamental


def _fundamental(
    flight: SyntheticFlight, i: int, j: int, pinhole: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "3 3"]:
    rotation = flight.cam_from_enu[j] @ flight.cam_from_enu[i].T
    x, y, z = flight.cam_from_enu[j] @ (flight.centres_m[i] - flight.centres_m[j])
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    inverse = np.linalg.inv(pinhole)
    return np.asarray(inverse.T @ cross @ rotation @ inverse)


def _wrong(
    flight: SyntheticFlight,
    rows: tuple[slice, slice],
    true: Int64[np.ndarray, "t 2"],
    fundamental: Float64[np.ndarray, "3 3"],
    wanted: int,
    rng: np.random.Generator,
) -> Int64[np.ndarray, "_ 2"]:
    """Return wrong matches of keypoints without a true match, close to the epipolar line, each keypoint used once."""
    places = flight.places[rows[0]], flight.places[rows[1]]
    free = [np.delete(np.arange(len(places[side])), true[:, side]) for side in (0, 1)]
    tried = rng.permutation(free[0])[: 2 * wanted]
    lines = np.column_stack([places[0][tried], np.ones(len(tried))]) @ fundamental.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    other = places[1][free[1]]
    off = np.abs(lines[:, :1] * other[:, 0] + lines[:, 1:2] * other[:, 1] + lines[:, 2:])
    lots = np.where(off <= EPIPOLAR_PX, rng.random(off.shape, np.float32), np.float32(2.0))
    if not lots.size:
        return np.zeros((0, 2), np.int64)
    pick = lots.argmin(axis=1)
    near = np.flatnonzero(lots[np.arange(len(tried)), pick] <= 1.0)
    near = near[np.unique(pick[near], return_index=True)[1]]
    near = rng.permutation(near)[:wanted]
    return np.column_stack([tried[near], free[1][pick[near]]])


def anonymous(flight: SyntheticFlight, seed: int) -> SyntheticFlight:
    """Return the flight with its photos in a random order, as if their names said nothing."""
    order = np.random.default_rng(seed).permutation(len(flight.centres_m))
    rows = [np.arange(len(flight.photo))[flight.rows(number)] for number in order.tolist()]
    photo = np.repeat(np.arange(len(order)), [len(mine) for mine in rows])
    taken = np.concatenate(rows)
    turned = flight.centres_m[order], flight.cam_from_enu[order]
    return SyntheticFlight(*turned, flight.points_m, photo, flight.point[taken], flight.places[taken])


def write_features(flight: SyntheticFlight, path: Path, seed: int) -> None:
    """Write keypoints with descriptors: those of one point differ by noise, those of two points by all."""
    rng = np.random.default_rng(seed)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        _write_photos(flight, database, guessed())
        for number in range(1, len(flight.centres_m) + 1):
            drawn = [
                np.random.default_rng(point).random(128) for point in flight.point[flight.rows(number - 1)].tolist()
            ]
            values = np.sqrt(np.array(drawn).reshape(-1, 128) + 0.1 * rng.random((len(drawn), 128)))
            values *= 512.0 / np.linalg.norm(values, axis=1, keepdims=True)
            stored = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, np.rint(values).astype(np.uint8))
            database.write_descriptors(number, stored)


def guessed() -> pycolmap.Camera:
    """Return the camera of photos that do not state a focal length, as `ingest` guesses it."""
    parameters = [DEFAULT_FOCAL * WIDTH, WIDTH / 2, HEIGHT / 2, 0.0]
    return pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=parameters)


def stated() -> pycolmap.Camera:
    """Return the camera of photos whose metadata state a focal length that is a little wrong."""
    prior = lens(FOCAL_OFF)
    prior.has_prior_focal_length = True
    return prior


def write_database(flight: SyntheticFlight, path: Path, seed: int, camera: pycolmap.Camera | None = None) -> int:
    """Write what matching would produce, with the stated camera or another; return the number of pairs with matches."""
    prior = camera or stated()
    known = prior.has_prior_focal_length
    pinhole = prior.calibration_matrix()
    written = 0
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        _write_photos(flight, database, prior)
        for (i, j), found, fundamental in matches(flight, choose_pairs(flight, seed), seed):
            geometry = pycolmap.TwoViewGeometry()
            configurations = pycolmap.TwoViewGeometryConfiguration
            geometry.config = configurations.CALIBRATED if known else configurations.UNCALIBRATED
            geometry.F = fundamental
            if known:
                geometry.E = pinhole.T @ fundamental @ pinhole
            geometry.inlier_matches = found.astype(np.uint32)
            database.write_two_view_geometry(i + 1, j + 1, geometry)
            written += 1
    return written


def _write_photos(flight: SyntheticFlight, database: pycolmap.Database, camera: pycolmap.Camera) -> None:
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)
    for number in range(1, len(flight.centres_m) + 1):
        image = pycolmap.Image(name=f"{number - 1:05d}.jpg", camera_id=1, image_id=number)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=number, rig_id=1)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        places = flight.places[flight.rows(number - 1)]
        affine = np.tile([1.0, 0.0, 0.0, 1.0], (len(places), 1))
        database.write_keypoints(number, np.hstack([places, affine]).astype(np.float32))
