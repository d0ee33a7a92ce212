"""Matching in processes: the same matches on every instruction set and number of processes, and pairs without any."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.sfm.matching import matching
from splatpipe.pipeline.sfm.matching.matching import match_pairs
from splatpipe.pipeline.sfm.matching.matching_process import match_listed

PHOTOS = 4  # the last shows something else
POINTS = 400
CAMERA = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1000, height=800, params=[900.0, 500.0, 400.0], camera_id=1)
PAIRS = [(i, j) for j in range(PHOTOS) for i in range(j)]
OLDER = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4"}  # a processor of 2009


class Progress(Reporter):
    def __init__(self) -> None:
        self.done: list[tuple[int, int]] = []

    def progress(self, done: int, total: int, message: str = "", unit: str = "") -> None:
        self.done.append((done, total))

    def metric(self, name: str, value: object) -> None:
        assert name == "children_peak_memory_bytes"


def write_features(path: Path) -> None:
    """Write a database of photos of the same points from a row of places, but for the last photo."""
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-3, 3, POINTS), rng.uniform(-2, 2, POINTS), rng.uniform(6, 12, POINTS)], axis=1)
    descriptors = rng.gamma(0.7, size=(POINTS, 128))
    with pycolmap.Database.open(path) as database:
        database.write_camera(CAMERA, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(CAMERA.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for number in range(1, PHOTOS + 1):
            image = pycolmap.Image(name=f"photo {number}", camera_id=1, image_id=number)
            frame = pycolmap.Frame(frame_id=number, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            image.frame_id = number
            database.write_image(image, use_image_id=True)
            seen = points - [0.4 * number, 0.0, 0.1 * number]
            places = 900.0 * seen[:, :2] / seen[:, 2:] + [500.0, 400.0] + rng.normal(scale=0.3, size=(POINTS, 2))
            shapes = np.tile([2.0, 0.0, 0.0, 2.0], (POINTS, 1))
            of = (
                rng.gamma(0.7, size=(POINTS, 128))
                if number == PHOTOS
                else descriptors + 0.15 * rng.gamma(0.7, size=(POINTS, 128))
            )
            order = rng.permutation(POINTS)
            values = np.rint(512.0 * of / np.linalg.norm(of, axis=1, keepdims=True))[order].astype(np.uint8)
            database.write_keypoints(number, np.concatenate([places, shapes], axis=1)[order].astype(np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, values))


@pytest.fixture
def features(tmp_path: Path) -> Path:
    path = tmp_path / "features.db"
    write_features(path)
    return path


def verified(path: Path) -> dict[int, list[list[int]]]:
    with pycolmap.Database.open(path) as database:
        numbers, geometries = database.read_two_view_geometries()
    return {number: each.inlier_matches.tolist() for number, each in zip(numbers, geometries, strict=True)}


def test_photos_of_one_place_are_verified_and_others_are_not(features: Path, tmp_path: Path) -> None:
    progress = Progress()
    match_pairs(features, tmp_path / "work.db", PAIRS, 0, 1, progress)
    found = verified(tmp_path / "work.db")
    assert set(found) == {pycolmap.image_pair_to_pair_id(i + 1, j + 1) for i, j in PAIRS if j < PHOTOS - 1}
    assert min(map(len, found.values())) > 0.9 * POINTS
    assert progress.done[-1] == (len(PAIRS), len(PAIRS))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["features.db", "work.db"]


def test_the_number_of_processes_changes_no_match(
    features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matching, "PAIRS_A_PROCESS", 1)
    for count in (1, 3):
        match_pairs(features, tmp_path / f"{count}.db", PAIRS, 0, count, Progress())
    assert verified(tmp_path / "1.db") == verified(tmp_path / "3.db")


def test_an_older_processor_finds_the_same_matches(
    features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    match_pairs(features, tmp_path / "here.db", PAIRS, 0, 1, Progress())
    for name, value in OLDER.items():
        monkeypatch.setenv(name, value)
    match_pairs(features, tmp_path / "older.db", PAIRS, 0, 1, Progress())
    assert verified(tmp_path / "older.db") == verified(tmp_path / "here.db")


def test_photos_without_descriptors_count_as_matched(features: Path, tmp_path: Path) -> None:
    with pycolmap.Database.open(features) as database:
        database.clear_descriptors()
        for number in range(1, PHOTOS + 1):
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, np.zeros((0, 128), np.uint8)))
    listing = tmp_path / "pairs.txt"
    listing.write_text("".join(f"{i + 1} {j + 1}\n" for i, j in PAIRS), encoding="ascii")
    match_listed(features, listing, 0)
    with pycolmap.Database.open(features) as database:
        assert database.num_matched_image_pairs() == len(PAIRS)
        assert len(database.read_two_view_geometries()[0]) == 0
