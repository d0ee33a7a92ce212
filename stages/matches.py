"""matches: which photos see the same things: pairs chosen, descriptors matched, geometry verified."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter, Summary
from splatpipe.pipeline.scene.parallel import watched
from splatpipe.pipeline.scene.photos import Photo, load_photo_list
from splatpipe.pipeline.scene.upright import display_from_stored, enu_from_gimbal
from splatpipe.stages.footprints import Views
from splatpipe.stages.options import MatchesConfig
from splatpipe.stages.pairs import LOCATED_SHARE, Costs, Layout, Pair, choose_pairing, components, select_pairs
from splatpipe.stages.retrieval import PER_PHOTO, look_alike_costs

LEVELLING_SIGMA_M = 1.0  # altitudes that are as good tell how high flights took off against each other
TAKEN_BY = ("latitude", "yaw_deg", "pitch_deg", "relative_altitude_m")  # what tells how a photo was taken
WITHIN_FLIGHT = 0.5  # of a position's standard deviation: most of the error is common to a flight
EARTH_RADIUS_M = 6_371_000.0  # of a sphere: these metres only choose neighbours
TILE = 16  # photos; pairs are matched tile by tile, so that a block needs few photos' descriptors
BLOCK_PAIRS = 64  # COLMAP keeps as many photos' search trees in memory


def run(config: MatchesConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write ``database.db`` (cameras, keypoints, verified two-view geometries) and ``pairs.json``.

    Raises:
        SplatpipeError: if no two photos match.
    """
    photos = load_photo_list(inputs["ingest.photos"]).photos
    positions = json.loads(inputs["ingest.positions"].read_text(encoding="utf-8"))["positions"]
    features = inputs["features.database"]
    layout = make_layout(photos, positions)
    layout = replace(
        layout, views=make_views(photos, positions, half_sizes(features, [photo.name for photo in photos]))
    )
    report.progress(0, 1, "choosing pairs")
    pairing = config.pairing
    if pairing == "auto":
        pairing = choose_pairing(layout, config.exhaustive_up_to)  # type: ignore[assignment]
    pairs = select_pairs(layout, pairing, config.neighbours, cache(lambda: _look_alike(features, config.seed)))
    with tempfile.TemporaryDirectory(prefix="scratch-", dir=out, ignore_cleanup_errors=True) as scratch:
        work = Path(scratch) / "database.db"
        _match(features, work, pairs, config.seed, inputs.machine.threads, report)
        inliers = write_verified(work, features, out / "database.db")
    if not any(inliers.values()):
        raise SplatpipeError(
            f"No two of the {len(photos)} photos show the same thing from different places.",
            hint="Photos must overlap, by two thirds at best, and be sharp."
            + ("" if pairing == "exhaustive" else " Or try --set matches.pairing=exhaustive."),
        )
    names = layout.names
    listed = [[names[i], names[j], inliers.get((i, j), 0)] for i, j in pairs]
    text = json.dumps({"pairing": pairing, "pairs": listed}, ensure_ascii=False, indent=0)
    (out / "pairs.json").write_text(text + "\n", encoding="utf-8")
    verified = [count for count in inliers.values() if count > 0]
    pieces = components([pair for pair, count in inliers.items() if count > 0], len(photos))
    return {
        "pairing": pairing,
        "pairs": len(pairs),
        "verified": len(verified),
        "median_inliers": int(np.median(verified)),
        "largest_connected": int(np.bincount(pieces).max()),
    }


def make_layout(photos: Sequence[Photo], positions: Sequence[dict[str, JSON]]) -> Layout:
    """Put what `ingest` found into arrays.

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
    """Tangents of half the field of view of each photo, across and down in the stored grid, by its camera's prior."""
    with pycolmap.Database.open(features) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        of_name = {image.name: cameras[image.camera_id] for image in database.read_all_images()}
    found = [of_name[name] for name in names]
    sizes = np.array([[camera.width, camera.height] for camera in found], dtype=np.float64)
    return sizes / (2.0 * np.array([[camera.mean_focal_length()] for camera in found]))


def make_views(
    photos: Sequence[Photo], positions: Sequence[dict[str, JSON]], half_size: Float64[np.ndarray, "n 2"]
) -> Views | None:
    """How photos were taken; None unless it is known of most, by positions, angles and heights above take-off.

    The height is the barometer's: a receiver's altitude errs by metres between photos, unless it is RTK's.

    Args:
        photos: Sorted by name.
        positions: The entries of ``positions.json``.
        half_size: Tangents of half the fields of view.
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
    noise = float(np.median([entry["sigma_horizontal_m"] for entry in entries])) * WITHIN_FLIGHT
    return Views(centres, rotations, half_size, ground, noise)


def _ground_m(entries: Sequence[dict[str, JSON]], height: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Where each photo's flight took off: 0, unless altitudes are good enough to tell flights' heights apart."""
    ground = np.zeros(len(entries))
    if any(entry["altitude_m"] is None or entry["sigma_vertical_m"] > LEVELLING_SIGMA_M for entry in entries):
        return ground
    flights = np.array([entry.get("flight", 0) for entry in entries])
    takeoff = np.array([entry["altitude_m"] for entry in entries]) - height
    for flight in np.unique(flights):
        ground[flights == flight] = np.median(takeoff[flights == flight])
    return ground


def _metres(entry: dict[str, JSON], origin: dict[str, JSON]) -> tuple[float, float]:
    """East and north of an origin on a sphere; the way round the date line is the short one."""
    degrees_east = (entry["longitude"] - origin["longitude"] + 180.0) % 360.0 - 180.0
    east = np.radians(degrees_east) * np.cos(np.radians(origin["latitude"])) * EARTH_RADIUS_M
    return float(east), float(np.radians(entry["latitude"] - origin["latitude"]) * EARTH_RADIUS_M)


def viewing_direction(yaw_deg: float, pitch_deg: float) -> Float64[np.ndarray, " 3"]:
    """East, north, up of the view of a gimbal: yaw clockwise from north, pitch -90 straight down."""
    yaw, pitch = np.radians(yaw_deg), np.radians(pitch_deg)
    return np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])


def _seconds(time: str | None) -> float:
    try:
        moment = datetime.fromisoformat(time or "")
    except ValueError:
        return float("nan")
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _look_alike(features: Path, seed: int) -> Costs:
    with pycolmap.Database.open(features) as database:
        count = database.num_images()
        descriptors = [
            np.asarray(database.read_descriptors(number).data, np.uint8).reshape(-1, 128)[:PER_PHOTO]
            for number in range(1, count + 1)
        ]
    return look_alike_costs(descriptors, seed)


def _match(features: Path, work: Path, pairs: Sequence[Pair], seed: int, threads: int, report: Reporter) -> None:
    """Match and verify pairs in a copy of the database.

    COLMAP works in a thread of its own, so that this one can tell of the progress and hear of interruptions.
    """
    shutil.copyfile(features, work)
    listing = work.with_name("pairs.txt")
    with pycolmap.Database.open(work) as database:
        for image in database.read_all_images():
            image.name = str(image.image_id)  # the list of pairs has no way to quote a name with blanks
            database.update_image(image)
        tiled = sorted(pairs, key=lambda pair: (pair[0] // TILE, pair[1] // TILE, pair))
        listing.write_text("".join(f"{i + 1} {j + 1}\n" for i, j in tiled), encoding="ascii")
        stop = pycolmap.CancellationToken()
        watched(
            lambda: _match_pairs(work, listing, seed, threads, stop),
            lambda: report.progress(database.num_matched_image_pairs(), len(pairs), "matching", "pairs"),
            stop.cancel,
        )


def _match_pairs(work: Path, listing: Path, seed: int, threads: int, stop: pycolmap.CancellationToken) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    pairing.block_size = BLOCK_PAIRS
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.set_random_seed(seed)
    pycolmap.match_image_pairs(work, matching, pairing, verification, pycolmap.Device.cpu, stop)


def write_verified(work: Path, features: Path, target: Path) -> dict[Pair, int]:
    """Write a new database in one fixed order, since threads leave theirs in the order in which they end.

    Descriptors and raw matches are not carried along: mapping needs the verified ones alone.

    Args:
        work: Where pairs were matched.
        features: Where the cameras, images and keypoints are.
        target: The database to write.

    Returns:
        Verified inliers of each pair (i, j) of photos, counted from 0, i < j.
    """
    inliers: dict[Pair, int] = {}
    with (
        pycolmap.Database.open(features) as source,
        pycolmap.Database.open(work) as matched,
        pycolmap.Database.open(target) as database,
    ):
        for camera in sorted(source.read_all_cameras(), key=lambda camera: camera.camera_id):
            database.write_camera(camera, use_camera_id=True)
        for rig in sorted(source.read_all_rigs(), key=lambda rig: rig.rig_id):
            database.write_rig(rig, use_rig_id=True)
        for frame in sorted(source.read_all_frames(), key=lambda frame: frame.frame_id):
            database.write_frame(frame, use_frame_id=True)
        for image in sorted(source.read_all_images(), key=lambda image: image.image_id):
            database.write_image(image, use_image_id=True)
        for number in range(1, source.num_images() + 1):
            database.write_keypoints(number, source.read_keypoints(number))
        numbers, geometries = matched.read_two_view_geometries()
        for pair_id, geometry in sorted(zip(numbers, geometries, strict=True), key=lambda entry: entry[0]):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            inliers[first - 1, second - 1] = len(geometry.inlier_matches)
            database.write_two_view_geometry(first, second, geometry)
    return inliers
