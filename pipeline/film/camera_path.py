"""Camera paths through a scene: upright, smooth in speed and turn, timed into the frames of a film.

A camera on a path has a position, a heading and a pitch, so that it cannot roll; looking down, where there is no
horizon, it may lean sideways as its photo did. A path along photos is the polyline through them, smoothed by a
Gaussian; a path through keyframes is a spline that passes through each of them: Catmull-Rom with centripetal knots,
which does not overshoot at uneven spacing (Yuksel, Schaefer, Keyser: "Parameterization and Applications of Catmull-Rom
Curves", 2011).

Path lengths combine moving and turning: moving by the distance of what is viewed counts as much as turning by one
radian. Films run at an even speed along that length, with a soft start and stop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.upright import rotation_to_up

STEEP_PITCH_RAD = math.radians(-60.0)  # steeper, a camera has no heading of its own: the horizon is too far away
MIN_HORIZONTAL_PART = 0.1  # minimum horizontal part of the mean view of nadir cameras to define what is ahead
MIN_OBLIQUE_SHARE = 0.2  # share of oblique cameras up to which the others do not take their headings
FINE_STEPS, FINE_STEPS_A_PLACE = 4000, 10  # linear steps of a path, at least, and per position
ACCELERATION_SHARE, MAX_ACCELERATION_S = 0.2, 1.0  # to accelerate, and to brake: share of the film, and at most seconds
SLOW_SPEED_RATIO = 0.5  # speed of the route over its median speed, below which the film slows down with the route
KERNEL_SIGMAS = 4.0  # half width of the smoothing kernel, in its standard deviations
MIN_PATH_LENGTH = 1e-6  # length of a path (as its ``distance`` measures it) below which nothing moves

Doubles = Float64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Route:
    """Positions and viewing directions along a path, in an upright frame: z is up.

    Attributes:
        places: Positions, world units.
        headings: Radians from x to y, without jumps by full turns.
        pitches: 0 level, -π/2 straight down, radians; beyond that the camera looks backwards.
        leans: To the right out of the vertical plane of heading and pitch, radians; 0 except for nadir photos.
    """

    places: Float64[np.ndarray, "n 3"]
    headings: Float64[np.ndarray, " n"]
    pitches: Float64[np.ndarray, " n"]
    leans: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, chosen: slice) -> Route:
        return Route(self.places[chosen], self.headings[chosen], self.pitches[chosen], self.leans[chosen])

    def values(self) -> Float64[np.ndarray, "n 6"]:
        """Positions, headings, pitches and leans side by side."""
        return np.column_stack((self.places, self.headings, self.pitches, self.leans))

    def directions(self) -> Float64[np.ndarray, "n 3"]:
        """Unit vectors of the viewing directions."""
        flat = np.cos(self.pitches)
        level = np.column_stack((flat * np.cos(self.headings), flat * np.sin(self.headings), np.sin(self.pitches)))
        return np.asarray(np.cos(self.leans)[:, None] * level + np.sin(self.leans)[:, None] * self.rights())

    def rights(self) -> Float64[np.ndarray, "n 3"]:
        """Level unit vectors to the right of the headings."""
        return np.column_stack((np.sin(self.headings), -np.cos(self.headings), np.zeros(len(self))))

    def steps(self, distance: float) -> Float64[np.ndarray, " m"]:
        """Length from each position to the next: the norm of (distance moved / ``distance``, radians turned)."""
        moved = np.linalg.norm(np.diff(self.places, axis=0), axis=1) / distance
        turned = angles_between(self.directions()[:-1], self.directions()[1:])
        return np.asarray(np.hypot(moved, turned))


def route_of(values: Float64[np.ndarray, "n 6"]) -> Route:
    """The inverse of ``Route.values``."""
    return Route(values[:, :3], values[:, 3], values[:, 4], values[:, 5])


def angles_between(first: Float64[np.ndarray, "n 3"], second: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Angles between unit vectors, radians, accurate for small ones."""
    return np.asarray(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(second - first, axis=1), 0.0, 1.0)))


@dataclass(frozen=True)
class FilmCamera:
    """The pinhole camera of a film: central principal point, square pixels.

    Attributes:
        width: Pixels.
        height: Pixels.
        focal_px: Focal length, pixels.
    """

    width: int
    height: int
    focal_px: float

    @staticmethod
    def of_angle(width: int, height: int, angle_deg: float) -> FilmCamera:
        """The camera with a field of view of ``angle_deg`` along the image's longer side."""
        return FilmCamera(width, height, 0.5 * max(width, height) / math.tan(math.radians(0.5 * angle_deg)))


def angle_of(cameras: Sequence[Camera]) -> float:
    """Median field of view of the cameras along their longer side, degrees."""
    sizes = [(camera.width, camera.fx) if camera.width >= camera.height else (camera.height, camera.fy)
             for camera in cameras]  # fmt: skip
    return math.degrees(2.0 * math.atan(float(np.median([0.5 * size / focal for size, focal in sizes]))))


def upright_route(cameras: Sequence[Camera], up: Float64[np.ndarray, " 3"]) -> Route:
    """The route of cameras, without their roll.

    A nadir camera takes its heading from its neighbours in the sequence; if nearly all are nadir, all get the same
    heading, along the images' shorter sides, and the film is a map that slides by.

    Args:
        cameras: In path order.
        up: Unit vector against gravity, in the cameras' world.
    """
    upright = rotation_to_up(up)
    places = np.array([camera.centre() for camera in cameras]) @ upright.T
    views = np.array([camera.cam_from_world[2, :3] for camera in cameras]) @ upright.T
    own = np.flatnonzero(views[:, 2] > math.sin(STEEP_PITCH_RAD))
    if len(own) > MIN_OBLIQUE_SHARE * len(cameras):
        known = np.unwrap(np.arctan2(views[own, 1], views[own, 0]))
        headings = np.interp(np.arange(len(cameras)), own, known)
    else:
        short = [-camera.cam_from_world[0 if camera.height > camera.width else 1, :3] for camera in cameras]
        headings = np.full(len(cameras), _common_axis(np.array(short) @ upright.T, views.mean(axis=0)))
    right = views[:, 0] * np.sin(headings) - views[:, 1] * np.cos(headings)
    along = views[:, 0] * np.cos(headings) + views[:, 1] * np.sin(headings)
    return Route(places, headings, np.arctan2(views[:, 2], along), np.arcsin(np.clip(right, -1.0, 1.0)))


def _common_axis(axes: Float64[np.ndarray, "n 3"], ahead: Float64[np.ndarray, " 3"]) -> float:
    """Azimuth of the mean axis, radians, ignoring signs; its sign follows ``ahead``, or else most axes."""
    doubled = 2.0 * np.arctan2(axes[:, 1], axes[:, 0])
    azimuth = 0.5 * math.atan2(float(np.sin(doubled).sum()), float(np.cos(doubled).sum()))
    mean = np.array([math.cos(azimuth), math.sin(azimuth)])
    sense = float(mean @ ahead[:2])
    if abs(sense) < MIN_HORIZONTAL_PART:
        sense = float(mean @ axes[:, :2].mean(axis=0))
    return azimuth if sense >= 0.0 else azimuth + math.pi


def cameras_along(
    route: Route, lenses: FilmCamera | Sequence[FilmCamera], up: Float64[np.ndarray, " 3"]
) -> list[Camera]:
    """The level cameras of a route.

    Args:
        route: In the upright frame of ``up``.
        lenses: One for all, or one each.
        up: As for ``upright_route``; the cameras' world is its frame.
    """
    upright = rotation_to_up(up)
    each = [lenses] * len(route) if isinstance(lenses, FilmCamera) else lenses
    cameras = []
    level = replace(route, leans=np.zeros(len(route))).directions()
    each_one = zip(route.places, route.directions(), np.cross(level, route.rights()), each, strict=True)
    for number, (place, view, down, lens) in enumerate(each_one):
        pose = np.eye(4)
        pose[:3, :3] = np.stack((np.cross(down, view), down, view)) @ upright
        pose[:3, 3] = -pose[:3, :3] @ (upright.T @ place)
        middle = (0.5 * lens.width, 0.5 * lens.height)
        cameras.append(Camera(f"{number:05d}", lens.width, lens.height, lens.focal_px, lens.focal_px, *middle, pose))
    return cameras


def smoothed(route: Route, distance: float, width: float) -> tuple[Route, Doubles]:
    """The polyline through a route, in many small steps, with rounded corners.

    Smoothed by a Gaussian that is applied again to the residual (Tukey's twicing): it rounds corners just as well, but
    a circle keeps its radius. The ends stay fixed.

    Args:
        route: At least two positions.
        distance: Distance of what is viewed, world units: see ``Route.steps``.
        width: Standard deviation of the Gaussian, in path lengths.

    Returns:
        The fine path, and the fractional step on it of each position of the route.

    Raises:
        UsageError: if nothing moves.
    """
    along = np.append(0.0, np.cumsum(route.steps(distance)))
    if not along[-1] > MIN_PATH_LENGTH:
        raise UsageError("All photos were taken from one position, so there is no path between them.")
    count = max(FINE_STEPS, FINE_STEPS_A_PLACE * len(route))
    values = np.column_stack([np.interp(np.linspace(0.0, along[-1], count + 1), along, v) for v in route.values().T])
    own = along / along[-1] * count
    half = min(count // 2, math.ceil(KERNEL_SIGMAS * width / along[-1] * count))
    if half == 0:
        return route_of(values), own
    once = np.exp(-0.5 * (np.arange(-half, half + 1) / (half / KERNEL_SIGMAS)) ** 2)
    once /= once.sum()
    kernel = 2.0 * np.pad(once, half) - np.convolve(once, once)
    reach = 2 * half
    before, after = 2.0 * values[0] - values[reach:0:-1], 2.0 * values[-1] - values[-2 : -reach - 2 : -1]
    padded = np.vstack((before, values, after))
    return route_of(np.column_stack([np.convolve(column, kernel, mode="valid") for column in padded.T])), own


def evenly_timed(route: Route, distance: float, frames: int, seconds: float) -> Doubles:
    """Position of each frame of a film on a fine route: at a nearly even speed, with a soft start and stop.

    Where the route itself slows down, as a smoothed one does in sharp turns, the film slows down too.

    Args:
        route: Fine enough for linear interpolation.
        distance: As for ``smoothed``.
        frames: Number of frames, at least one.
        seconds: Duration.

    Returns:
        Fractional indices into the route, for ``sampled``.
    """
    steps = route.steps(distance)
    along = np.append(0.0, np.cumsum(np.hypot(steps, SLOW_SPEED_RATIO * np.median(steps))))
    start = min(MAX_ACCELERATION_S, ACCELERATION_SHARE * seconds) / seconds
    at = along[-1] * soft_progress(np.linspace(0.0, 1.0, frames), start)
    return np.asarray(np.interp(at, along, np.arange(len(route))))


def sampled(route: Route, at: Doubles) -> Route:
    """A route interpolated linearly.

    Args:
        route: A fine route.
        at: Fractional indices into the route.
    """
    return route_of(np.column_stack([np.interp(at, np.arange(len(route)), column) for column in route.values().T]))


def soft_progress(share: Doubles, start: float) -> Doubles:
    """Progress of a motion at a share of its time, with smoothstep acceleration and deceleration.

    Args:
        share: Share of the time, 0..1.
        start: Share of the time to accelerate: > 0, at most a half.
    """

    def begun(part: Doubles) -> Doubles:  # the integral of 3t² - 2t³, linear from 1
        ramp = np.clip(part, 0.0, 1.0)
        return np.asarray(ramp**3 - 0.5 * ramp**4 + np.maximum(part - 1.0, 0.0))

    half = np.minimum(share, 1.0 - share)
    progress = start * begun(half / start) / (1.0 - start)
    return np.where(share <= 0.5, progress, 1.0 - progress)


def spline(
    values: Float64[np.ndarray, "n k"], knots: Float64[np.ndarray, " n"], at: Float64[np.ndarray, " m"]
) -> Float64[np.ndarray, "m k"]:
    """Cubic Hermite spline through values, with tangents from the neighbours; at rest between two equal values.

    Args:
        values: At least two rows.
        knots: Increasing.
        at: Parameters to evaluate, within the knots.
    """
    chords = np.diff(values, axis=0)
    gaps = np.diff(knots)[:, None]
    slopes = chords / gaps
    tangents = np.vstack((slopes[:1], (slopes[:-1] * gaps[1:] + slopes[1:] * gaps[:-1]) / (gaps[:-1] + gaps[1:]),
                          slopes[-1:]))  # fmt: skip
    still = ~chords.any(axis=1)
    tangents[:-1][still] = tangents[1:][still] = 0.0
    index = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    gap = gaps[index]
    t = ((at - knots[index]) / gap[:, 0])[:, None]
    return np.asarray(
        values[index]
        + t**2 * (3.0 - 2.0 * t) * chords[index]
        + gap * (t * (1.0 - t) ** 2 * tangents[index] - t**2 * (1.0 - t) * tangents[index + 1])
    )


def centripetal_knots(route: Route, distance: float) -> Doubles:
    """Knots for a spline through a route: cumulative square roots of its lengths, increasing.

    Args:
        route: At least two positions.
        distance: As for ``smoothed``.

    Raises:
        UsageError: if nothing moves.
    """
    gaps = route.steps(distance)
    if not gaps.sum() > MIN_PATH_LENGTH:
        raise UsageError("All keyframes are at one position, so there is no path between them.")
    return np.append(0.0, np.cumsum(np.sqrt(np.maximum(gaps, MIN_PATH_LENGTH**2))))


def towards(places: Float64[np.ndarray, "n 3"], targets: Float64[np.ndarray, "n 3"]) -> Route:
    """The route of a camera that looks at targets."""
    ahead = targets - places
    headings = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return Route(places, headings, np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1])), np.zeros(len(places)))
