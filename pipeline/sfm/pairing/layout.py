"""Input of pair selection, from what is known before matching: positions, angles, heights, times."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.geometry.upright import display_from_stored, enu_from_gimbal
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.sfm.pairing.footprints import StatedPoses
from splatpipe.pipeline.sfm.pairing.pairs import LOCATED_SHARE, Layout

LEVELLING_SIGMA_M = 1.0  # altitudes this accurate determine the relative take-off heights of flights
TAKEN_BY = ("latitude", "yaw_deg", "pitch_deg", "relative_altitude_m")  # fields required for a stated pose
RELATIVE_NOISE_SHARE = 0.5  # relative over stated position noise: most of the error is common to a flight
EARTH_RADIUS_M = 6_371_000.0  # spherical Earth: accurate enough for choosing neighbours


def make_layout(photos: Sequence[Photo], positions: Sequence[dict[str, JSON]]) -> Layout:
    """Convert the positions, angles and times from `ingest` to arrays.

    Args:
        photos: Sorted by name.
        positions: The entries of ``positions.json``.
    """
    count = len(photos)
    index = {photo.name: number for number, photo in enumerate(photos)}
    places = np.full((count, 3), np.nan)
    sigmas = np.full(count, np.nan)
    directions = np.full((count, 3), np.nan)
    known = [entry for entry in positions if entry["name"] in index]
    height = next(
        (key for key in ("altitude_m", "relative_altitude_m") if all(entry[key] is not None for entry in known)), None
    )
    for entry in known:
        number = index[entry["name"]]
        up = entry[height] if height else 0.0
        places[number] = *_metres(entry, known[0]), up
        sigmas[number] = entry["sigma_horizontal_m"]
        if entry["yaw_deg"] is not None and entry["pitch_deg"] is not None:
            directions[number] = viewing_direction(entry["yaw_deg"], entry["pitch_deg"])
    times = np.array([_seconds(photo.time) for photo in photos])
    return Layout([photo.name for photo in photos], times, places, sigmas, directions)


def half_sizes(features: Path, names: Sequence[str]) -> Float64[np.ndarray, "n 2"]:
    """Return tangents of each photo's half field of view, across and down in the stored grid, by its prior camera."""
    with pycolmap.Database.open(features) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        of_name = {image.name: cameras[image.camera_id] for image in database.read_all_images()}
    found = [of_name[name] for name in names]
    sizes = np.array([[camera.width, camera.height] for camera in found], dtype=np.float64)
    return sizes / (2.0 * np.array([[camera.mean_focal_length()] for camera in found]))


def make_views(
    photos: Sequence[Photo], positions: Sequence[dict[str, JSON]], half_size: Float64[np.ndarray, "n 2"]
) -> StatedPoses | None:
    """Assemble the stated poses from positions, angles and heights above take-off; None unless most photos have them.

    The height is barometric: a GNSS altitude varies by metres between photos, except with RTK.

    Args:
        photos: Sorted by name.
        positions: The entries of ``positions.json``.
        half_size: Tangents of the half fields of view.
    """
    by_name = {entry["name"]: entry for entry in positions}
    found = [(index, by_name[photo.name]) for index, photo in enumerate(photos) if photo.name in by_name]
    found = [(index, entry) for index, entry in found if all(entry[key] is not None for key in TAKEN_BY)]
    if len(found) < max(2, LOCATED_SHARE * len(photos)):
        return None
    index, entries = [index for index, _ in found], [entry for _, entry in found]
    angles = [np.array([entry[key] or 0.0 for entry in entries]) for key in ("yaw_deg", "pitch_deg", "roll_deg")]
    turns = np.stack([display_from_stored(photos[at].orientation) for at in index])
    height = np.array([entry["relative_altitude_m"] for entry in entries], dtype=np.float64)
    ground = np.full(len(photos), np.nan)
    ground[index] = _ground_m(entries, height)
    centres = np.full((len(photos), 3), np.nan)
    centres[index, :2] = [_metres(entry, entries[0]) for entry in entries]
    centres[index, 2] = ground[index] + height
    rotations = np.full((len(photos), 3, 3), np.nan)
    rotations[index] = enu_from_gimbal(angles[0], angles[1], angles[2]) @ turns
    noise = float(np.median([entry["sigma_horizontal_m"] for entry in entries])) * RELATIVE_NOISE_SHARE
    return StatedPoses(centres, rotations, half_size, ground, noise)


def _ground_m(entries: Sequence[dict[str, JSON]], height: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return the take-off height of each photo's flight: 0 unless altitudes are accurate enough to compare flights."""
    ground = np.zeros(len(entries))
    if any(entry["altitude_m"] is None or entry["sigma_vertical_m"] > LEVELLING_SIGMA_M for entry in entries):
        return ground
    flights = np.array([entry.get("flight", 0) for entry in entries])
    takeoff = np.array([entry["altitude_m"] for entry in entries]) - height
    for flight in np.unique(flights):
        ground[flights == flight] = np.median(takeoff[flights == flight])
    return ground


def _metres(entry: dict[str, JSON], origin: dict[str, JSON]) -> tuple[float, float]:
    """Return east and north offsets from an origin on a sphere, the short way round across the date line."""
    degrees_east = (entry["longitude"] - origin["longitude"] + 180.0) % 360.0 - 180.0
    east = np.radians(degrees_east) * np.cos(np.radians(origin["latitude"])) * EARTH_RADIUS_M
    return float(east), float(np.radians(entry["latitude"] - origin["latitude"]) * EARTH_RADIUS_M)


def viewing_direction(yaw_deg: float, pitch_deg: float) -> Float64[np.ndarray, " 3"]:
    """Return a gimbal's viewing direction as east, north, up: yaw clockwise from north, pitch -90 straight down."""
    yaw, pitch = np.radians(yaw_deg), np.radians(pitch_deg)
    return np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])


def _seconds(time: str | None) -> float:
    try:
        moment = datetime.fromisoformat(time or "")
    except ValueError:
        return float("nan")
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
