"""Time one mapping in a process of its own: ``mapped_apart HOW DATABASE FOLDER [COUNT SEED]``.

``before`` is the pipeline's former incremental mapping, ``plain`` COLMAP's with its own options, ``ours`` and
``global`` the pipeline's mappers, and ``oracle`` the adjustment of a synthetic flight from its true cameras and tracks:
the error that noise alone causes. All run on one thread. ``pairs`` chooses the pairs of a synthetic flight as the
pipeline does, by position and by appearance. ``whole`` is all of `reconstruct`, with its judging and further mappings;
descriptors lie beside the database, in ``features.db``. Figures are written to ``FOLDER/HOW.json``, the largest model
to ``FOLDER/HOW``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from commands import benchmark
from flight_scene import SyntheticFlight, choose_pairs, lens, make_flight
from jaxtyping import Float64
from tables import Row

from splatpipe.pipeline.engine.runs.peak_memory import peak_memory_bytes
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.files.photo_list import PhotoList
from splatpipe.pipeline.sfm.capture import MappingInput
from splatpipe.pipeline.sfm.mapping.mapping import MappingOptions, map_global, map_incremental
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.pairing.pairs import connect, nearest
from splatpipe.pipeline.sfm.pairing.retrieval import PER_PHOTO, look_alike_costs
from splatpipe.pipeline.sfm.reconstruct import reconstruct

NEIGHBOURS = 20  # the pipeline's default

COLUMNS = {
    "capture": "capture:",
    "mapper": "how:",
    "photos": "placed:",
    "of": "photos:",
    "points": "points:,",
    "error px": "error_px:.4f",
    "focal px": "focal_px:.1f",
    "CPU s": "cpu_s:.1f",
    "peak MB": "peak_bytes:MB",
}


def run_apart(how: str, database: Path, folder: Path, *made: int) -> Row:
    """Map in a child process that ends with this one; return its figures; its largest model is in ``folder / how``."""
    words = [sys.executable, *benchmark("mapped_apart", how, database, folder, *made)]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    row: Row = json.loads((folder / f"{how}.json").read_text())
    return row


def centre_errors(
    found: Float64[np.ndarray, "n 3"], true: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, " n"], float]:
    """Return distances after the best similarity (Umeyama, PAMI 1991), in the truth's unit, and its scale."""
    from_mean, to_mean = found - found.mean(axis=0), true - true.mean(axis=0)
    u, singular, vt = np.linalg.svd(to_mean.T @ from_mean)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((singular * signs).sum() / (from_mean**2).sum())
    return np.linalg.norm(to_mean - scale * from_mean @ (u @ np.diag(signs) @ vt).T, axis=1), scale


def centres(model: pycolmap.Reconstruction) -> tuple[list[int], Float64[np.ndarray, "n 3"]]:
    """Return the image numbers of the registered photos, and their camera centres."""
    numbers = sorted(model.reg_image_ids())
    return numbers, np.array([model.images[number].projection_center() for number in numbers]).reshape(-1, 3)


def _map(how: str, database: Path, made: list[int]) -> list[pycolmap.Reconstruction]:
    with tempfile.TemporaryDirectory() as scratch:
        if how == "oracle":
            return [oracle(make_flight(*made))]
        if how == "whole":
            return [reconstruct(_capture(database, Path(scratch)), SparseConfig(), Silent()).model]
        if how in ("ours", "global"):
            mapper = map_global if how == "global" else map_incremental
            return mapper(database, Path(scratch), MappingOptions(), lambda *_: None)
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = 1
        options.extract_colors = False  # there are no photos
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
        if how == "before":
            options.min_model_size = 3
        found = pycolmap.incremental_mapping(database, scratch, scratch, options)
        return sorted(found.values(), key=lambda model: -model.num_reg_images())


def _capture(database: Path, scratch: Path) -> MappingInput:
    """Return the input of a capture whose photos state nothing: names, positions and focal lengths are not used."""
    features = database.with_name("features.db")
    guess: JSON = {"has_prior": False, "focal_source": "guess"}
    none = np.zeros((0, 3), np.uint8)
    return MappingInput(database, features, none, PhotoList(()), scratch, scratch, (), (guess,), scratch)


class Silent:
    """A reporter to nobody."""

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None:
        """Ignore progress."""

    def metric(self, name: str, value: int | float, step: int | None = None) -> None:
        """Ignore a metric."""

    def note(self, message: str) -> None:
        """Ignore a note."""

    def warning(self, message: str, hint: str = "") -> None:
        """Ignore a warning."""


def oracle(flight: SyntheticFlight) -> pycolmap.Reconstruction:
    """Adjust everything from the truth, without wrong matches: the error that noise alone causes."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(lens())
    for number in range(len(flight.centres_m)):
        rotation = flight.cam_from_enu[number]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ flight.centres_m[number])
        places = flight.places[flight.rows(number)]
        model.add_image_with_trivial_frame(pycolmap.Image(f"{number:05d}.jpg", places, 1, number + 1), pose)
    starts = np.searchsorted(flight.photo, np.arange(len(flight.centres_m)))
    keypoint = np.arange(len(flight.photo)) - starts[flight.photo]
    order = np.argsort(flight.point, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(flight.point[order])) + 1):
        if len(rows) > 1:
            track = [pycolmap.TrackElement(int(flight.photo[row]) + 1, int(keypoint[row])) for row in rows]
            model.add_point3D(flight.points_m[flight.point[rows[0]]], pycolmap.Track(track))
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)
    return model


def pairs_by_look(count: int) -> int:
    """Count the pairs chosen by the photos' content, with descriptors requested photo by photo.

    Args:
        count: Number of photos; neighbours share a third of their descriptors.
    """
    common = np.random.default_rng(0).integers(0, 256, (PER_PHOTO, 128), np.uint8)

    class Drawn(Sequence[np.ndarray]):
        def __len__(self) -> int:
            return count

        def __getitem__(self, at: int) -> np.ndarray:  # type: ignore[override]
            if at >= count:
                raise IndexError(at)
            own = np.random.default_rng(1 + at).integers(0, 256, (PER_PHOTO, 128), np.uint8)
            own[: PER_PHOTO // 3] = np.roll(common, at, axis=0)[: PER_PHOTO // 3]
            return own

    costs = look_alike_costs(Drawn(), seed=0)
    return len(connect(nearest(range(count), costs, NEIGHBOURS), count, costs))


def _pairs(count: int, seed: int) -> Row:
    """Return CPU seconds and pairs per photo of either way to choose them; generating the flight is not counted."""
    flight = make_flight(count, seed, observations=10)
    began_s = time.process_time()
    by_position = len(choose_pairs(flight, seed, NEIGHBOURS))
    between_s = time.process_time()
    by_look = pairs_by_look(count)
    ended_s = time.process_time()
    return {
        "how": "pairs",
        "cpu_s": ended_s - began_s,
        "by_position_s": between_s - began_s,
        "by_look_s": ended_s - between_s,
        "pairs_a_photo": 2.0 * by_position / count,
        "look_pairs_a_photo": 2.0 * by_look / count,
        "peak_bytes": peak_memory_bytes(),
    }


def main(how: str, database: Path, folder: Path, *made: str) -> None:
    if how == "pairs":
        (folder / f"{how}.json").write_text(json.dumps(_pairs(int(made[0]), int(made[1]))))
        return
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    began_s = time.process_time()
    models = _map(how, database, [int(number) for number in made])
    cpu_s = time.process_time() - began_s
    row: Row = {"how": how, "cpu_s": cpu_s, "placed": 0}
    row["peak_bytes"] = peak_memory_bytes()
    if models:
        row["placed"], row["points"] = models[0].num_reg_images(), models[0].num_points3D()
        row["error_px"] = models[0].compute_mean_reprojection_error()
        row["focal_px"] = next(camera.mean_focal_length() for _, camera in sorted(models[0].cameras.items()))
        (folder / how).mkdir(parents=True, exist_ok=True)
        models[0].write(folder / how)
    (folder / f"{how}.json").write_text(json.dumps(row))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), *sys.argv[4:])
