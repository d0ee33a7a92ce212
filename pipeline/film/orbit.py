"""An orbit around a capture: one turn of a camera that looks at its centre."""

from __future__ import annotations

import math

import numpy as np

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.film.camera_path import STEEP_PITCH_RAD, Route, upright_route
from splatpipe.pipeline.film.clearance import Clearance
from splatpipe.pipeline.film.photo_route import PhotoTrack, followed_photos
from splatpipe.pipeline.geometry.upright import rotation_to_up

CHECKED_POSITIONS = 72  # positions on a circle at which clearance is checked
MIN_CLEARANCE = 0.25  # minimum clearance from solid parts, as a share of the distance from the centre
STEP_DEG = 5.0  # elevation step by which a circle without clearance is raised
MAX_ELEVATION_DEG = 70.0
RADIUS_FACTORS = (1.0, 1.25, 1.5, 2.0)  # radii over the photos' distance that are tried if no elevation is clear
OVER_A_MAP_DEG = 50.0  # elevation if all photos are nadir: keeps walls that no photo covers out of view
MIN_ELEVATION_DEG = 5.0


def orbit(capture: PhotoTrack, frames: int) -> Route:
    """One turn around the centre of what the photos show, at their distance and height; its end joins its beginning.

    If something is in the way, the circle is raised, then widened.

    Args:
        capture: At least one photo.
        frames: At least one.

    Returns:
        One route position per frame, in the upright frame of ``capture.up``.

    Raises:
        UsageError: if the photos do not determine a centre.
    """
    kept, _ = followed_photos(capture)
    if len(kept) == 0:
        raise UsageError("No photo sees enough sparse points to determine the centre of an orbit.")
    upright = rotation_to_up(capture.up)
    targets = np.array([np.median(capture.points[capture.seen[index]], axis=0) for index in kept])
    middle = np.median(targets @ upright.T, axis=0)
    route = upright_route([capture.cameras[int(index)] for index in kept], capture.up)
    oblique = route.pitches > STEEP_PITCH_RAD
    places = (route.places[oblique] if oblique.any() else route.places) - middle
    distance = float(np.median(np.linalg.norm(places, axis=1)))
    elevation = float(np.median(np.arctan2(places[:, 2], np.hypot(places[:, 0], places[:, 1]))))
    lowest = max(elevation, math.radians(MIN_ELEVATION_DEG)) if oblique.any() else math.radians(OVER_A_MAP_DEG)
    distance, elevation = _clear(capture.clearance, (middle, distance, lowest), upright)
    first = math.atan2(places[0, 1], places[0, 0])
    return _circle(middle, distance, elevation, first + 2.0 * math.pi * np.arange(frames) / frames)


def _clear(clearance: Clearance, wanted: tuple[np.ndarray, float, float], upright: np.ndarray) -> tuple[float, float]:
    """Distance and elevation (radians) of the first circle with clearance; of the clearest if none has it."""
    middle, distance, lowest = wanted
    angles = 2.0 * math.pi * np.arange(CHECKED_POSITIONS) / CHECKED_POSITIONS
    tried: list[tuple[float, float, float]] = []
    highest = max(lowest, math.radians(MAX_ELEVATION_DEG))
    for factor in RADIUS_FACTORS:
        for elevation in np.arange(lowest, highest + 1e-9, math.radians(STEP_DEG)).tolist():
            circle = _circle(middle, factor * distance, elevation, angles)
            share = float(clearance.at(circle.places @ upright).min()) / (factor * distance)
            if share >= MIN_CLEARANCE:
                return factor * distance, elevation
            tried.append((share, factor * distance, elevation))
    return max(tried)[1:]


def _circle(middle: np.ndarray, distance: float, elevation: float, angles: np.ndarray) -> Route:
    flat, height = distance * math.cos(elevation), distance * math.sin(elevation)
    around = np.column_stack((flat * np.cos(angles), flat * np.sin(angles), np.full(len(angles), height)))
    return Route(middle + around, angles + math.pi, np.full(len(angles), -elevation), np.zeros(len(angles)))
