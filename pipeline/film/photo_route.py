"""Which of a capture's photos a film follows, and in what order.

Photo names mostly follow the flight, so they give the order unless another one is much shorter. The path breaks where
the next photo is far away or something solid is in between; stray photos are dropped. From the rest a film takes the
stretch that fits its duration at a comfortable speed and whose photos see the most points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.film.camera_path import Route, evenly_timed, sampled, smoothed, upright_route
from splatpipe.pipeline.film.clearance import Clearance
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.upright import rotation_to_up

SPEED = 0.7  # comfortable speed, path lengths (see ``camera_path``) per second: around a building, 28° per second
CORNER_S = 1.0  # standard deviation of the Gaussian that rounds corners, seconds at that speed
CORNER_LEGS = 0.6  # standard deviation of that Gaussian in median distances between photos, if this is longer
ALONE_LEGS, ALONE_LENGTH = 4.0, 0.5  # a stray's distance to the nearest photo: in median distances, and in lengths
MIN_VISIBLE_POINTS = 10  # sparse points; a photo that sees fewer is unreliable
ODD_DEPTH_RATIO = 5.0  # nearer or farther than the others: the ground at take-off, a test shot of the sky
LONG_LEG = 5.0  # median legs: the flight is interrupted there
LONGEST_LEG = 2.0  # path lengths; about 80° around a building
DETOUR_TIMES, DETOUR_LEGS = 3.0, 1.5  # a detour: there and back over the direct leg; each over the median leg
MIN_LEGS = 4  # to detect detours
MAX_LONGER_RATIO = 1.6  # names give the order unless they make the path longer by this factor
MIN_CLEARANCE = 0.5  # minimum clearance, as a share of the photos' own distance from solid parts
CLEAR_STEPS = 4.0  # samples per that distance
MAX_COMPARED = 3000  # photos compared pairwise: tables of 72 MB
MAX_HALVINGS = 5  # halvings of the smoothing width, if a rounded corner comes too near


@dataclass(frozen=True, eq=False)
class PhotoTrack:
    """The data of a capture that a film needs.

    Attributes:
        cameras: Cameras of all photos, sorted by name.
        seen: For each, rows of the sparse points that it observes.
        points: The sparse points, world units.
        up: Unit vector against gravity.
        clearance: Distances to solid parts.
    """

    cameras: Sequence[Camera]
    seen: Sequence[Int64[np.ndarray, " _"]]
    points: Float64[np.ndarray, "n 3"]
    up: Float64[np.ndarray, " 3"]
    clearance: Clearance

    def depths(self) -> Float64[np.ndarray, " m"]:
        """Median depth of each photo's points, world units; NaN if it sees none."""
        medians = np.full(len(self.cameras), np.nan)
        for number, (camera, rows) in enumerate(zip(self.cameras, self.seen, strict=True)):
            z = camera.depths(self.points[rows])
            z = z[np.isfinite(z) & (z > 0.0)]
            medians[number] = np.median(z) if len(z) else np.nan
        return medians


def photo_film(capture: PhotoTrack, frames: int, seconds: float) -> Route:
    """A film along a capture's photos.

    Args:
        capture: At least two photos.
        frames: At least one.
        seconds: Duration.

    Returns:
        One route position per frame, in the upright frame of ``capture.up``.

    Raises:
        UsageError: if there is no path between any two photos.
    """
    kept, distance = followed_photos(capture)
    if len(kept) < 2:
        raise UsageError("Fewer than two photos overlap, so there is no path between them.")
    route = upright_route([capture.cameras[int(index)] for index in kept], capture.up)
    kept = kept[_order(route, distance)]
    kept = kept[_no_detours(upright_route([capture.cameras[int(index)] for index in kept], capture.up), distance)]
    whole = upright_route([capture.cameras[int(index)] for index in kept], capture.up)
    legs = whole.steps(distance)
    way, own = smoothed(whole, distance, CORNER_S * SPEED)  # back-and-forth photos add no length
    length = np.append(0.0, np.cumsum(way.steps(distance)))
    lengths = np.diff(np.interp(own, np.arange(len(way)), length))
    stretch = _stretch(capture, kept, legs, lengths, SPEED * seconds)
    cameras = [capture.cameras[int(index)] for index in kept[stretch]]
    chosen = slice(stretch.start, stretch.stop - 1)
    detour = float(legs[chosen].sum()) / max(float(lengths[chosen].sum()), 1e-9)
    speed = min(SPEED, float(lengths[chosen].sum()) / seconds)
    width = max(detour * CORNER_S * speed, CORNER_LEGS * float(np.median(legs[chosen])))
    way = _clear_way(capture, upright_route(cameras, capture.up), distance, width)
    return sampled(way, evenly_timed(way, distance, frames, seconds))


def _clear_way(capture: PhotoTrack, route: Route, distance: float, width: float) -> Route:
    """A route smoothed as far as it keeps clear of solid parts."""
    upright = rotation_to_up(capture.up)
    wanted = MIN_CLEARANCE * float(capture.clearance.at(route.places @ upright).min())
    way, _ = smoothed(route, distance, width)
    for _ in range(MAX_HALVINGS):
        if bool((capture.clearance.at(way.places @ upright) >= wanted).all()):
            break
        width *= 0.5
        way, _ = smoothed(route, distance, width)
    return way


def _no_detours(route: Route, distance: float) -> Int64[np.ndarray, " k"]:
    """Indices of all photos except single detours, e.g. a close-up or a shot of something else."""
    legs = route.steps(distance)
    if len(legs) < MIN_LEGS:
        return np.arange(len(route))
    past = np.array([route[index : index + 3 : 2].steps(distance)[0] for index in range(len(legs) - 1)])
    there, back = legs[:-1], legs[1:]
    odd = (there + back > DETOUR_TIMES * past) & (np.minimum(there, back) > DETOUR_LEGS * float(np.median(legs)))
    return np.flatnonzero(~np.concatenate(([False], odd, [False])))


def followed_photos(capture: PhotoTrack) -> tuple[Int64[np.ndarray, " k"], float]:
    """Indices of the photos that are not strays, in name order, and the median distance of what they see."""
    depths = capture.depths()
    enough = np.array([len(rows) >= MIN_VISIBLE_POINTS for rows in capture.seen]) & np.isfinite(depths)
    if enough.sum() < 2:
        enough = np.isfinite(depths)
    if not enough.any():
        return np.zeros(0, np.int64), 1.0
    distance = float(np.median(depths[enough]))
    alike = enough & (depths <= ODD_DEPTH_RATIO * distance) & (depths >= distance / ODD_DEPTH_RATIO)
    kept = np.flatnonzero(alike)
    if 2 < len(kept) <= MAX_COMPARED:
        route = upright_route([capture.cameras[int(index)] for index in kept], capture.up)
        table = _table(route, distance)
        np.fill_diagonal(table, np.inf)
        nearest = table.min(axis=1)
        kept = kept[nearest <= max(ALONE_LEGS * float(np.median(nearest)), ALONE_LENGTH)]
    return kept, distance


def _table(route: Route, distance: float) -> Float64[np.ndarray, "n n"]:
    """Path lengths between all pairs."""
    places, views = route.places / distance, route.directions()
    squares = (places**2).sum(axis=1)
    moved2 = np.maximum(squares[:, None] + squares[None] - 2.0 * places @ places.T, 0.0)
    return np.asarray(np.sqrt(moved2 + np.arccos(np.clip(views @ views.T, -1.0, 1.0)) ** 2))


def _order(route: Route, distance: float) -> Int64[np.ndarray, " n"]:
    """Name order, or greedy nearest-neighbour order if that is much shorter."""
    named = np.arange(len(route))
    if len(route) > MAX_COMPARED:
        return named
    table = _table(route, distance)
    nearest, left = [0], np.ones(len(route), bool)
    left[0] = False
    while left.any():
        nearest.append(int(np.argmin(np.where(left, table[nearest[-1]], np.inf))))
        left[nearest[-1]] = False
    other = np.array(nearest)

    def typical(order: Int64[np.ndarray, " n"]) -> float:  # the mean without single jumps from flight to flight
        legs = np.sort(table[order[:-1], order[1:]])
        return float(legs[: max(1, -(-9 * len(legs) // 10))].sum())

    return other if typical(named) > MAX_LONGER_RATIO * typical(other) else named


def _open(
    capture: PhotoTrack, photos: Int64[np.ndarray, " n"], legs: Float64[np.ndarray, " m"]
) -> Bool[np.ndarray, " m"]:
    """Whether a film may continue from each photo to the next."""
    near = (legs <= LONG_LEG * max(float(np.median(legs)), 1e-9)) & (legs <= LONGEST_LEG)
    places = np.array([capture.cameras[int(index)].centre() for index in photos])
    own = capture.clearance.at(places)
    for leg in np.flatnonzero(near):
        wanted = MIN_CLEARANCE * min(own[leg], own[leg + 1])
        if np.isfinite(wanted):
            step = max(wanted / CLEAR_STEPS, 1e-9)
            near[leg] = bool((capture.clearance.between(places[leg], places[leg + 1], step) >= wanted).all())
    return near


def _stretch(
    capture: PhotoTrack,
    photos: Int64[np.ndarray, " n"],
    legs: Float64[np.ndarray, " m"],
    lengths: Float64[np.ndarray, " m"],
    longest: float,
) -> slice:
    """The consecutive photos without a break, within a path length, that see the most points.

    Args:
        capture: The photos' capture.
        photos: Photo indices in path order.
        legs: Length from each photo to the next.
        lengths: The same along the smoothed path.
        longest: Maximum sum of these.

    Raises:
        UsageError: if no two are left.
    """
    is_open = _open(capture, photos, legs)
    counts = np.zeros(len(capture.points), np.int64)
    best, most = slice(0, 0), 0
    start, length = 0, 0.0
    counts[capture.seen[photos[0]]] += 1
    seen = len(capture.seen[photos[0]])
    for end in range(1, len(photos)):
        rows = capture.seen[photos[end]]
        seen += int((counts[rows] == 0).sum())
        counts[rows] += 1
        length += lengths[end - 1]
        while start < end and (not is_open[end - 1] or length > longest):
            if start == end - 1 and is_open[end - 1]:
                break  # a single leg may take longer than is comfortable
            rows = capture.seen[photos[start]]
            counts[rows] -= 1
            seen -= int((counts[rows] == 0).sum())
            length -= lengths[start]
            start += 1
        if end > start and seen > most:
            best, most = slice(start, end + 1), seen
    if most == 0:
        raise UsageError(
            "No two neighbouring photos have free space between them, so there is no path along them.",
            hint="Use --path orbit, or a keyframe file.",
        )
    return best
