"""Predict from metadata how well a flight will know the ground, before anything is reconstructed.

A block is made of the photos' stated positions, angles and lenses, with tie points drawn at random on flat ground; its
normal equations are those of the adjustment that `georef` will make. No photo is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.upright import display_from_stored, enu_from_gimbal
from splatpipe.pipeline.sfm.lenses.lens_model import NAMES, WIDE
from splatpipe.pipeline.survey.adjustment.adjusted_positions import ACCURATE_M, MIN_POSITIONS
from splatpipe.pipeline.survey.adjustment.block import Block, reduce_block
from splatpipe.pipeline.survey.adjustment.block_accuracy import (
    BlockAccuracy,
    accuracy_of,
    with_control,
    with_cross_strip,
)
from splatpipe.pipeline.survey.adjustment.block_adjustment import AdjustedBlock, PositionObservations
from splatpipe.pipeline.survey.adjustment.block_lens import Lens
from splatpipe.pipeline.survey.adjustment.position_adjustment import MIN_PHOTOS, SIMPLE, LensKnowledge, prior_lens
from splatpipe.pipeline.survey.adjustment.position_noise import StatedPositions, as_stated
from splatpipe.pipeline.survey.adjustment.tie_points import MIN_SIGMA_PX, PER_PHOTO
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.positions.photo_positions import Position

MAX_PHOTOS = 120  # more are predicted from a part: two or three seconds
DRAWN_POINTS = 100  # points per photo, of which those that two photos show are thinned to PER_PHOTO in each
MIN_VIEWS = 2
RELIEF_SHARE = 0.02  # standard deviation of the ground's heights over the flying height
MAX_DISTANCE_RATIO = 4.0  # distance over a photo's height beyond which points are not matched
SEED = 41
HEIGHT_BOUNDS_M = (2.0, 3000.0)  # bounds of a photo's height above ground
SIMILAR_HEIGHTS = (0.25, 4.0)  # bounds on height over the typical one: others see something else, or are wrong
MIN_REACH_RATIO = 0.1  # median reach of the photos over the height, below which they see nothing in space
NEW_GROUND_SHARE = 0.07  # share of a footprint seen by no other photo: overlaps of 75-80 % along, 65-70 % across
MIN_ASPECT = 0.2  # least width over length of the flown area, to tell its density
NADIR_COSINE = math.cos(math.radians(15.0))  # views less steep show walls, which determine the focal length
MAX_HEIGHT_RANGE = 0.1  # range of the camera heights over the flying height
ONE_HEADING = math.cos(math.radians(20.0))
ODD_TILT, ODD_HEIGHT = math.sin(math.radians(5.0)), 0.05  # photos that tell focal length from height


@dataclass(frozen=True)
class FlightCamera:
    """What is known of a camera.

    Attributes:
        width: Of its photos, pixels.
        height: Likewise.
        focal_px: Focal length, pixels.
        focal_share: Its relative standard deviation.
        held: Whether the adjustment will keep the lens as it is.
        number: Distinguishes cameras of one kind.
    """

    width: int
    height: int
    focal_px: float
    focal_share: float
    held: bool = False
    number: int = 0


@dataclass(frozen=True)
class ControlSpot:
    """A place for a control point: degrees, WGS 84, and the photo taken nearest above it."""

    latitude: float
    longitude: float
    photo: str


@dataclass(frozen=True)
class PredictedAccuracy:
    """Predicted standard deviations of the ground's mean position, metres.

    Attributes:
        height_m: In height, with the photos' positions alone.
        plan_m: Horizontally, along the worse axis, likewise.
        control_1_m: In height, with a control point at the first of ``spots``.
        control_3_m: With one at each.
        cross_strip_m: With a strip of photos across, from another height; None if nothing can be said.
        spots: Where control points help most.
        gsd_m: Ground sample distance.
        flying_height_m: Above ground.
        height_guessed: Whether that is guessed from the photos' density.
        stated_m: Typical stated standard deviation of a position: horizontally along each axis, and in height.
        photos: Number of photos that the prediction is for.
        of_photos: Number of photos with a position.
        angles_stated: Whether the angles of most photos are stated; if not, they count as straight down.
        straight_down: Whether all photos look straight down.
        one_height: Whether all are taken from one height.
        one_heading: Whether all have one heading.
    """

    height_m: float
    plan_m: float
    control_1_m: float
    control_3_m: float
    cross_strip_m: float | None
    spots: tuple[ControlSpot, ...]
    gsd_m: float
    flying_height_m: float
    height_guessed: bool
    stated_m: tuple[float, float]
    photos: int
    of_photos: int
    angles_stated: bool
    straight_down: bool
    one_height: bool
    one_heading: bool


@dataclass(frozen=True)
class _Flight:
    """Photos with positions, in the order of capture; east, north, up in metres.

    Attributes:
        positions: As stated.
        cameras: Of each photo.
        centres: Projection centres.
        rotations: World to camera.
        ground: Height of the ground.
        guessed: Whether that is guessed.
        angles_stated: Whether most photos' angles are stated.
    """

    positions: tuple[Position, ...]
    cameras: tuple[FlightCamera, ...]
    centres: Float64[np.ndarray, "n 3"]
    rotations: Float64[np.ndarray, "n 3 3"]
    ground: float
    guessed: bool
    angles_stated: bool

    def only(self, index: Int64[np.ndarray, " k"]) -> _Flight:
        """Some of the photos."""
        chosen = index.tolist()
        return _Flight(
            tuple(self.positions[k] for k in chosen),
            tuple(self.cameras[k] for k in chosen),
            self.centres[index],
            self.rotations[index],
            self.ground,
            self.guessed,
            self.angles_stated,
        )

    @property
    def heights(self) -> Float64[np.ndarray, " n"]:
        """Above ground."""
        return np.asarray(self.centres[:, 2] - self.ground)


def predict_accuracy(
    positions: Sequence[Position], cameras: Mapping[str, FlightCamera], times: Mapping[str, str | None]
) -> PredictedAccuracy | None:
    """Predict how well a flight with accurate positions will know the ground.

    Args:
        positions: The photos' positions and angles.
        cameras: By photo.
        times: Of capture, ISO 8601, by photo.

    Returns:
        None where positions are poor or few, or where the metadata do not say what the photos show.
    """
    origin, flight = _read_flight(positions, cameras, times)
    if origin is None or flight is None:
        return None
    part = flight.only(_part(flight))
    block = _synthetic_block(part)
    if block is None:
        return None
    stated = _stated_positions(part)
    observed = as_stated(stated).observations(stated)
    accuracy = _accuracy(block, observed)
    together = accuracy.mean_sigmas()
    if not len(accuracy.points) or not np.isfinite(together).all():
        return None
    control, strip = with_control(accuracy), with_cross_strip(accuracy)
    height = float(np.median(flight.heights))
    focal = float(np.median([camera.focal_px for camera in flight.cameras]))
    places = _around_site(np.array(control[3].places), flight, part)
    sigmas = np.median([[each.sigma_horizontal_m, each.sigma_vertical_m] for each in flight.positions], axis=0)
    return PredictedAccuracy(
        _rounded(together[2]),
        _rounded(together[:2].max()),
        _rounded(control[1].height_sigma_m),
        _rounded(control[3].height_sigma_m),
        None if strip is None else _rounded(strip.height_sigma_m),
        _spots(places, flight, origin),
        _rounded(height / focal),
        _rounded(height),
        flight.guessed,
        (_rounded(sigmas[0]), _rounded(sigmas[1])),
        len(part.positions),
        len(positions),
        flight.angles_stated,
        bool((flight.rotations[:, 2, 2] <= -NADIR_COSINE).all()),
        bool(np.ptp(flight.heights) <= MAX_HEIGHT_RANGE * height),
        _has_one_heading(flight),
    )


def _read_flight(
    positions: Sequence[Position], cameras: Mapping[str, FlightCamera], times: Mapping[str, str | None]
) -> tuple[Origin | None, _Flight | None]:
    """The photos as a flight about an origin; None where positions are poor or few, or the ground is unknown."""
    usable = [each for each in positions if each.name in cameras and _is_finite(each)]
    if len(usable) < MIN_POSITIONS:
        return None, None
    sigmas = [[each.sigma_horizontal_m, each.sigma_horizontal_m, each.sigma_vertical_m] for each in usable]
    if float(np.median(sigmas)) > ACCURATE_M:
        return None, None
    usable.sort(key=lambda each: (each.flight, times.get(each.name) or "", each.name))
    middle = sorted(usable, key=lambda each: (each.latitude, each.longitude))[len(usable) // 2]
    origin = Origin(middle.latitude, middle.longitude, 0.0)
    centres = origin.enu_from_geodetic(np.array([[p.latitude, p.longitude, p.altitude_m] for p in usable], np.float64))
    angled = sum(each.yaw_deg is not None and each.pitch_deg is not None for each in usable)
    found = _Flight(
        tuple(usable),
        tuple(cameras[each.name] for each in usable),
        centres,
        _rotations(usable, centres),
        0.0,
        False,
        2 * angled > len(usable),
    )
    ground = _ground(found)
    if ground is None:
        return None, None
    heights = centres[:, 2] - ground
    typical = float(np.median(heights))
    similar = np.flatnonzero((heights > SIMILAR_HEIGHTS[0] * typical) & (heights < SIMILAR_HEIGHTS[1] * typical))
    reach = np.linalg.norm(centres[similar] - np.median(centres[similar], axis=0), axis=1)
    if len(similar) < MIN_POSITIONS or float(np.median(reach)) < MIN_REACH_RATIO * typical:
        return None, None
    guessed = _takeoff(found) is None
    return origin, _Flight(
        found.positions, found.cameras, centres, found.rotations, ground, guessed, found.angles_stated
    ).only(similar)


def _is_finite(position: Position) -> bool:
    numbers = (position.latitude, position.longitude, position.sigma_horizontal_m, position.sigma_vertical_m)
    angles = (position.yaw_deg, position.pitch_deg, position.roll_deg)
    return (
        position.altitude_m is not None
        and math.isfinite(position.altitude_m)
        and all(map(math.isfinite, numbers))
        and min(numbers[2:]) > 0.0
        and all(angle is None or math.isfinite(angle) for angle in angles)
    )


def _rotations(positions: Sequence[Position], centres: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3 3"]:
    """World to camera, by the stated angles; without them straight down, headed along the flight."""
    direction = np.gradient(centres[:, :2], axis=0)
    along = np.degrees(np.arctan2(direction[:, 0], direction[:, 1])).tolist()
    angles = np.array(
        [
            (each.yaw_deg, each.pitch_deg, each.roll_deg or 0.0)
            if each.yaw_deg is not None and each.pitch_deg is not None
            else (heading, -90.0, 0.0)
            for each, heading in zip(positions, along, strict=True)
        ],
        dtype=np.float64,
    )
    turns = np.stack([display_from_stored(each.orientation) for each in positions])
    enu_from_camera = enu_from_gimbal(angles[:, 0], angles[:, 1], angles[:, 2]) @ turns
    return np.asarray(np.swapaxes(enu_from_camera, 1, 2))


def _ground(flight: _Flight) -> float | None:
    """Height of the ground: of the take-off, or guessed from the photos' density; None where neither is known."""
    takeoff = _takeoff(flight)
    if takeoff is not None:
        return takeoff
    extent = np.linalg.svd(flight.centres[:, :2] - flight.centres[:, :2].mean(axis=0), compute_uv=False)
    if extent[0] <= 0.0 or extent[1] < MIN_ASPECT * extent[0]:
        return None
    area = 12.0 * float(extent[0] * extent[1]) / len(flight.centres)  # area of a rectangle with this spread
    frame = float(np.median([camera.width * camera.height / camera.focal_px**2 for camera in flight.cameras]))
    height = math.sqrt(area / len(flight.centres) / (NEW_GROUND_SHARE * frame))
    if not HEIGHT_BOUNDS_M[0] <= height <= HEIGHT_BOUNDS_M[1]:
        return None
    return float(np.median(flight.centres[:, 2])) - height


def _takeoff(flight: _Flight) -> float | None:
    """Height of the take-off by the drones' heights above it; None unless most photos state a plausible one."""
    steps = [
        float(centre[2]) - each.relative_altitude_m
        for each, centre in zip(flight.positions, flight.centres, strict=True)
        if each.relative_altitude_m is not None and math.isfinite(each.relative_altitude_m)
    ]
    if 2 * len(steps) <= len(flight.positions):
        return None
    takeoff = float(np.median(steps))
    height = float(np.median(flight.centres[:, 2])) - takeoff
    return takeoff if HEIGHT_BOUNDS_M[0] <= height <= HEIGHT_BOUNDS_M[1] else None


def _part(flight: _Flight) -> Int64[np.ndarray, " k"]:
    """A contiguous part of a large flight, around the photos whose tilt or height tells most of the focal length."""
    count = len(flight.positions)
    if count <= MAX_PHOTOS:
        return np.arange(count, dtype=np.int64)
    plan = flight.centres[:, :2]
    tilts = np.hypot(flight.rotations[:, 2, 0], flight.rotations[:, 2, 1])
    lifts = np.abs(flight.heights / float(np.median(flight.heights)) - 1.0)
    odd = (np.abs(tilts - np.median(tilts)) > ODD_TILT) | (lifts > ODD_HEIGHT)
    middle = np.median(plan[odd] if odd.any() else plan, axis=0)
    away = np.linalg.norm(plan - middle, axis=1)
    return np.sort(np.argsort(away, kind="stable")[:MAX_PHOTOS]).astype(np.int64)


def _synthetic_block(flight: _Flight) -> Block | None:
    """The block of a flight with tie points on the ground; None where photos do not overlap."""
    points = _draw_points(flight)
    projected = [_pixels(flight, k, points) for k in range(len(flight.positions))]
    seen = np.stack([np.isfinite(each[:, 0]) for each in projected], axis=1)  # (p, n)
    chosen = np.flatnonzero(seen.sum(axis=1) >= MIN_VIEWS)
    wanted = PER_PHOTO * len(flight.positions) / max(int(seen[chosen].sum()), 1)
    chosen = chosen[np.random.default_rng(SEED).permutation(len(chosen))[: round(wanted * len(chosen))]]
    if len(chosen) < MIN_POSITIONS:
        return None
    seen = seen[chosen]
    point, photo = (each.astype(np.int64) for each in np.nonzero(seen))
    pixels = np.stack([each[chosen] for each in projected], axis=1)[seen]
    kinds = tuple(dict.fromkeys(flight.cameras))
    place = points[chosen]
    return Block(
        flight.rotations,
        flight.centres,
        np.array([kinds.index(camera) for camera in flight.cameras], dtype=np.int64),
        tuple(_lens(camera, flight.cameras.count(camera)) for camera in kinds),
        place,
        photo,
        point,
        pixels,
        np.full(len(photo), MIN_SIGMA_PX),
        place,
        np.zeros_like(place),
    )


def _draw_points(flight: _Flight) -> Float64[np.ndarray, "p 3"]:
    """Points on the ground, uniform in each photo."""
    rng = np.random.default_rng(SEED)
    found = []
    for camera, centre, rotation in zip(flight.cameras, flight.centres, flight.rotations, strict=True):
        size = np.array([camera.width, camera.height])
        flat = (rng.uniform(size=(DRAWN_POINTS, 2)) - 0.5) * size / camera.focal_px
        rays = np.column_stack([flat, np.ones(DRAWN_POINTS)]) @ rotation
        height = float(centre[2]) - flight.ground
        rays = rays[-rays[:, 2] * MAX_DISTANCE_RATIO > np.linalg.norm(rays, axis=1)]
        found.append(centre + height * rays / -rays[:, 2:])
    points = np.concatenate(found)
    points[:, 2] += RELIEF_SHARE * float(np.median(flight.heights)) * rng.normal(size=len(points))
    return points


def _pixels(flight: _Flight, photo: int, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 2"]:
    """Where a photo shows points; NaN where it does not."""
    camera, away = flight.cameras[photo], points - flight.centres[photo]
    rays = away @ flight.rotations[photo].T
    near = (rays[:, 2] > 0.0) & (np.linalg.norm(away, axis=1) < MAX_DISTANCE_RATIO * float(flight.heights[photo]))
    size = np.array([camera.width, camera.height], dtype=np.float64)
    pixels = 0.5 * size + camera.focal_px * rays[:, :2] / np.where(near, rays[:, 2], 1.0)[:, None]
    inside = near & (pixels > 0.0).all(axis=1) & (pixels < size).all(axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def _lens(camera: FlightCamera, photos: int) -> Lens:
    """A lens without distortion, as free as `georef` will have it."""
    params = dict.fromkeys(NAMES[WIDE], 0.0)
    params |= {"fx": camera.focal_px, "fy": camera.focal_px, "cx": 0.5 * camera.width, "cy": 0.5 * camera.height}
    made = pycolmap.Camera(model=WIDE, width=camera.width, height=camera.height, params=list(params.values()))
    names = () if camera.held else SIMPLE if photos < MIN_PHOTOS else None
    return prior_lens(made, LensKnowledge(camera.focal_px, camera.focal_share), names)


def _stated_positions(flight: _Flight) -> StatedPositions:
    flights = sorted({each.flight for each in flight.positions})
    return StatedPositions(
        np.arange(len(flight.positions), dtype=np.int64),
        flight.centres,
        np.array([[p.sigma_horizontal_m, p.sigma_horizontal_m, p.sigma_vertical_m] for p in flight.positions]),
        np.array([flights.index(each.flight) for each in flight.positions], dtype=np.int64),
        tuple(each.rtk or "unstated" for each in flight.positions),
        np.zeros((len(flights), 3), dtype=bool),
    )


def _accuracy(block: Block, observed: PositionObservations) -> BlockAccuracy:
    offsets = np.zeros_like(observed.offset_sigmas)
    return accuracy_of(AdjustedBlock(block, offsets, reduce_block(block), 0.0, True), observed)


def _has_one_heading(flight: _Flight) -> bool:
    """Whether the tops of all images point the same way on the ground, to within 20°."""
    right = flight.rotations[:, 0, :2]
    sizes = np.linalg.norm(right, axis=1)
    mean = right.sum(axis=0)
    if float(sizes.min()) < 0.5 or float(np.linalg.norm(mean)) < 1e-9:
        return False
    return bool(((right @ mean) > ONE_HEADING * sizes * np.linalg.norm(mean)).all())


def _around_site(places: Float64[np.ndarray, "k 3"], flight: _Flight, part: _Flight) -> Float64[np.ndarray, "k 3"]:
    """Places for control points; for a part, those after the first moved to where they surround the whole flight."""
    if len(part.positions) == len(flight.positions):
        return places
    below = np.column_stack([flight.centres[:, :2], np.full(len(flight.positions), flight.ground)])
    chosen = [places[0]]
    while len(chosen) < len(places):
        away = np.min([np.linalg.norm(below - place, axis=1) for place in chosen], axis=0)
        chosen.append(below[int(np.argmax(away))])
    return np.stack(chosen)


def _spots(places: Float64[np.ndarray, "k 3"], flight: _Flight, origin: Origin) -> tuple[ControlSpot, ...]:
    geodetic = origin.geodetic_from_enu(places)
    spots = []
    for place, (latitude, longitude, _) in zip(places, geodetic.tolist(), strict=True):
        nearest = int(np.argmin(np.linalg.norm(flight.centres[:, :2] - place[:2], axis=1)))
        spots.append(ControlSpot(round(latitude, 6), round(longitude, 6), flight.positions[nearest].name))
    return tuple(spots)


def _rounded(metres: float) -> float:
    """To a tenth of a millimetre: the same for any number of threads."""
    return round(float(metres), 4)
