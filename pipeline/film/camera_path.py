"""Ways of a camera through a scene: upright, smooth in speed and turn, timed into the frames of a film.

A camera on its way is a place, a heading and a pitch, so that it cannot roll; looking down, where there is no horizon,
it may lean aside as its photo did. A way along photos is the broken line
through them, smoothed by a Gaussian; a way through keyframes is a spline that meets each of them: Catmull-Rom's with
centripetal knots, which does not overshoot where places are unevenly far apart (Yuksel, Schaefer, Keyser:
"Parameterization and Applications of Catmull-Rom Curves", 2011).

Lengths of ways count moving and turning alike: moving by the distance of what is looked at is as much as turning by a
radian. Along that length films go at an even speed, with a soft start and stop.
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

STEEP = math.radians(-60.0)  # looking down more steeply, a camera has no heading of its own: the horizon is far away
TILTED = 0.1  # part of the mean view of cameras that look down, from which on it is ahead
FEW = 0.2  # of the cameras: fewer that do not are no reason to turn the others
FINE_STEPS, FINE_STEPS_A_PLACE = 4000, 10  # of a way, between which it is a line
START_SHARE, START_S = 0.2, 1.0  # of a film's time, and at most, to come up to speed, and as long to stop
SLOW = 0.5  # of the median speed: where a route's own is below, the film's follows it down
REACH_SIGMAS = 4.0  # of the Gaussian that smooths
LEAST_LENGTH = 1e-6  # of a way: below, nothing moves

Doubles = Float64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Route:
    """Places and directions on a way, in an upright frame: z is up.

    Attributes:
        places: World units.
        headings: Of the view, radians from x to y, without jumps by whole turns.
        pitches: 0 level, -π/2 straight down, radians; beyond that it looks back between its feet.
        leans: To the right out of the upright plane of heading and pitch, radians; 0 but for photos looking down.
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
        """Places, headings, pitches and leans side by side."""
        return np.column_stack((self.places, self.headings, self.pitches, self.leans))

    def directions(self) -> Float64[np.ndarray, "n 3"]:
        """Unit vectors of the views."""
        flat = np.cos(self.pitches)
        level = np.column_stack((flat * np.cos(self.headings), flat * np.sin(self.headings), np.sin(self.pitches)))
        return np.asarray(np.cos(self.leans)[:, None] * level + np.sin(self.leans)[:, None] * self.rights())

    def rights(self) -> Float64[np.ndarray, "n 3"]:
        """Level unit vectors to the right of the headings."""
        return np.column_stack((np.sin(self.headings), -np.cos(self.headings), np.zeros(len(self))))

    def steps(self, distance: float) -> Float64[np.ndarray, " m"]:
        """Length from each to the next: moved distance over ``distance``, and turned radians, as one vector."""
        moved = np.linalg.norm(np.diff(self.places, axis=0), axis=1) / distance
        turned = angles_between(self.directions()[:-1], self.directions()[1:])
        return np.asarray(np.hypot(moved, turned))


def route_of(values: Float64[np.ndarray, "n 6"]) -> Route:
    """The opposite of ``Route.values``."""
    return Route(values[:, :3], values[:, 3], values[:, 4], values[:, 5])


def angles_between(first: Float64[np.ndarray, "n 3"], second: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Angles between unit vectors, radians, exact for small ones."""
    return np.asarray(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(second - first, axis=1), 0.0, 1.0)))


@dataclass(frozen=True)
class FilmCamera:
    """The pinhole camera of a film: principal point in the middle, square pixels.

    Attributes:
        width: Pixels.
        height: Pixels.
        focal_px: Focal length.
    """

    width: int
    height: int
    focal_px: float

    @staticmethod
    def of_angle(width: int, height: int, angle_deg: float) -> FilmCamera:
        """The lens that sees so many degrees along the picture's longer side."""
        return FilmCamera(width, height, 0.5 * max(width, height) / math.tan(math.radians(0.5 * angle_deg)))


def angle_of(cameras: Sequence[Camera]) -> float:
    """What the median camera sees along its longer side, degrees."""
    sizes = [(camera.width, camera.fx) if camera.width >= camera.height else (camera.height, camera.fy)
             for camera in cameras]  # fmt: skip
    return math.degrees(2.0 * math.atan(float(np.median([0.5 * size / focal for size, focal in sizes]))))


def upright_route(cameras: Sequence[Camera], up: Float64[np.ndarray, " 3"]) -> Route:
    """Where cameras stood and looked, without their roll.

    One that looks down steeply takes its heading from those around it in the sequence; where hardly any does not, all
    get the same heading, along the pictures' shorter sides, and the film is a map that slides by.

    Args:
        cameras: In the order of the way.
        up: Against gravity, a unit vector in the cameras' world.
    """
    upright = rotation_to_up(up)
    places = np.array([camera.centre() for camera in cameras]) @ upright.T
    views = np.array([camera.cam_from_world[2, :3] for camera in cameras]) @ upright.T
    own = np.flatnonzero(views[:, 2] > math.sin(STEEP))
    if len(own) > FEW * len(cameras):
        known = np.unwrap(np.arctan2(views[own, 1], views[own, 0]))
        headings = np.interp(np.arange(len(cameras)), own, known)
    else:
        short = [-camera.cam_from_world[0 if camera.height > camera.width else 1, :3] for camera in cameras]
        headings = np.full(len(cameras), _common_axis(np.array(short) @ upright.T, views.mean(axis=0)))
    right = views[:, 0] * np.sin(headings) - views[:, 1] * np.cos(headings)
    along = views[:, 0] * np.cos(headings) + views[:, 1] * np.sin(headings)
    return Route(places, headings, np.arctan2(views[:, 2], along), np.arcsin(np.clip(right, -1.0, 1.0)))


def _common_axis(axes: Float64[np.ndarray, "n 3"], ahead: Float64[np.ndarray, " 3"]) -> float:
    """Azimuth of the mean of axes, radians, whatever their sense: it is rather ahead, or that of most axes."""
    doubled = 2.0 * np.arctan2(axes[:, 1], axes[:, 0])
    azimuth = 0.5 * math.atan2(float(np.sin(doubled).sum()), float(np.cos(doubled).sum()))
    mean = np.array([math.cos(azimuth), math.sin(azimuth)])
    sense = float(mean @ ahead[:2])
    if abs(sense) < TILTED:
        sense = float(mean @ axes[:, :2].mean(axis=0))
    return azimuth if sense >= 0.0 else azimuth + math.pi


def cameras_along(
    route: Route, lenses: FilmCamera | Sequence[FilmCamera], up: Float64[np.ndarray, " 3"]
) -> list[Camera]:
    """The cameras of a way, level.

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
    """The broken line through a route, in many small steps, its corners rounded.

    By a Gaussian, applied once more to what it took away and added (Tukey's twicing): it rounds corners as well, and a
    circle keeps its radius. The ends stay where they are.

    Args:
        route: At least two.
        distance: Of what is looked at, world units: see ``Route.steps``.
        width: The Gaussian's standard deviation, in lengths of the way.

    Returns:
        The way, and which of its steps each place of the route has become, counted with fractions.

    Raises:
        UsageError: if nothing moves.
    """
    along = np.append(0.0, np.cumsum(route.steps(distance)))
    if not along[-1] > LEAST_LENGTH:
        raise UsageError("All photos were taken from one position, so there is no path between them.")
    count = max(FINE_STEPS, FINE_STEPS_A_PLACE * len(route))
    values = np.column_stack([np.interp(np.linspace(0.0, along[-1], count + 1), along, v) for v in route.values().T])
    own = along / along[-1] * count
    half = min(count // 2, math.ceil(REACH_SIGMAS * width / along[-1] * count))
    if half == 0:
        return route_of(values), own
    once = np.exp(-0.5 * (np.arange(-half, half + 1) / (half / REACH_SIGMAS)) ** 2)
    once /= once.sum()
    kernel = 2.0 * np.pad(once, half) - np.convolve(once, once)
    reach = 2 * half
    before, after = 2.0 * values[0] - values[reach:0:-1], 2.0 * values[-1] - values[-2 : -reach - 2 : -1]
    padded = np.vstack((before, values, after))
    return route_of(np.column_stack([np.convolve(column, kernel, mode="valid") for column in padded.T])), own


def evenly_timed(route: Route, distance: float, frames: int, seconds: float) -> Doubles:
    """Where on a fine route each frame of a film is: at a nearly even speed, with a soft start and a soft stop.

    Where the route slows down by itself, as a smoothed one does in sharp turns, the film slows down, too.

    Args:
        route: So fine that lines between its places do.
        distance: As for ``smoothed``.
        frames: At least one.
        seconds: That they last.

    Returns:
        In places of the route from the first, for ``sampled``.
    """
    steps = route.steps(distance)
    along = np.append(0.0, np.cumsum(np.hypot(steps, SLOW * np.median(steps))))
    start = min(START_S, START_SHARE * seconds) / seconds
    at = along[-1] * soft_progress(np.linspace(0.0, 1.0, frames), start)
    return np.asarray(np.interp(at, along, np.arange(len(route))))


def sampled(route: Route, at: Doubles) -> Route:
    """A route between its places, along lines.

    Args:
        route: Fine.
        at: Which, in places from the first.
    """
    return route_of(np.column_stack([np.interp(at, np.arange(len(route)), column) for column in route.values().T]))


def soft_progress(share: Doubles, start: float) -> Doubles:
    """How far a motion is at a share of its time: it comes up to speed along a smoothstep, and stops the same way.

    Args:
        share: 0..1.
        start: Of the time, to come up to speed: > 0, at most a half.
    """

    def begun(part: Doubles) -> Doubles:  # the integral of 3t² - 2t³, and from 1 on evenly
        ramp = np.clip(part, 0.0, 1.0)
        return np.asarray(ramp**3 - 0.5 * ramp**4 + np.maximum(part - 1.0, 0.0))

    half = np.minimum(share, 1.0 - share)
    progress = start * begun(half / start) / (1.0 - start)
    return np.where(share <= 0.5, progress, 1.0 - progress)


def spline(
    values: Float64[np.ndarray, "n k"], knots: Float64[np.ndarray, " n"], at: Float64[np.ndarray, " m"]
) -> Float64[np.ndarray, "m k"]:
    """Hermite's cubics through values, tangents from the neighbours; where two are the same it rests.

    Args:
        values: At least two rows.
        knots: Rising.
        at: Where it is asked for, within the knots.
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
    """Knots for a spline through a route: roots of its lengths, rising.

    Args:
        route: At least two.
        distance: As for ``smoothed``.

    Raises:
        UsageError: if nothing moves.
    """
    gaps = route.steps(distance)
    if not gaps.sum() > LEAST_LENGTH:
        raise UsageError("All keyframes are at one position, so there is no path between them.")
    return np.append(0.0, np.cumsum(np.sqrt(np.maximum(gaps, LEAST_LENGTH**2))))


def towards(places: Float64[np.ndarray, "n 3"], targets: Float64[np.ndarray, "n 3"]) -> Route:
    """The route of a camera that looks at targets."""
    ahead = targets - places
    headings = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return Route(places, headings, np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1])), np.zeros(len(places)))
