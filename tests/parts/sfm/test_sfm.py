"""From photos to a sparse model: keypoints, matches and mapping of a scene with known cameras."""

import hashlib
from pathlib import Path

import corner_photos
import cv2
import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.photos.pixels.images import reduced
from splatpipe.pipeline.sfm.matching.keypoints import largest
from splatpipe.pipeline.sfm.options import FeaturesConfig, MatchesConfig, SparseConfig
from splatpipe.stages import features, matches, sparse

NAMES = ["a b.png", "ключ 1.png", "東/1.png", "東/2.png", "東/3.png", "東/4.png"]
FAST = FeaturesConfig(extractor="opencv-sift", max_features=3000)


def run_line(inputs: Inputs, out: Path, threads: int = 1) -> tuple[dict[str, object], corner_photos.Recorder]:
    recorder = corner_photos.Recorder()
    for stage in ("features", "matches", "sparse"):
        (out / stage).mkdir(parents=True)
    inputs = corner_photos.with_parts(inputs, threads)
    features.run(FAST, inputs, out / "features", recorder)
    inputs = corner_photos.with_parts(
        inputs,
        threads,
        features__database=out / "features" / "database.db",
        features__colours=out / "features" / "colours.npy",
        matches__database=out / "matches" / "database.db",
        matches__pairs=out / "matches" / "pairs.json",
    )
    matches.run(MatchesConfig(), inputs, out / "matches", recorder)
    return dict(sparse.run(SparseConfig(), inputs, out / "sparse", recorder)), recorder


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return corner_photos.write_capture(tmp_path_factory.mktemp("capture"), corner_photos.room(sorted(NAMES)))


@pytest.fixture(scope="module")
def reconstructed(capture: Inputs, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    out = tmp_path_factory.mktemp("out")
    summary, recorder = run_line(capture, out)
    assert recorder.steps[-1][0] == recorder.steps[-1][1]
    return out, summary


def test_cameras_are_recovered(reconstructed: tuple[Path, dict[str, object]]) -> None:
    out, summary = reconstructed
    assert summary["registered"] == len(NAMES)
    model = pycolmap.Reconstruction(out / "sparse" / "sparse" / "0")
    poses = corner_photos.poses(len(NAMES))
    true = {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in zip(sorted(NAMES), poses, strict=True)}
    names = [image.name for image in model.images.values()]
    found = pycolmap.align_reconstruction_to_locations(
        model, names, [true[n] for n in names], 3, pycolmap.RANSACOptions()
    )
    errors = [np.linalg.norm(found * image.projection_center() - true[image.name]) for image in model.images.values()]
    diagonal = np.linalg.norm(np.ptp(np.array(list(true.values())), axis=0))
    assert np.sqrt(np.mean(np.square(errors))) < 0.005 * diagonal  # six small photos, focal length not known
    assert model.cameras[1].mean_focal_length() == pytest.approx(corner_photos.FOCAL, rel=0.02)


def test_points_have_the_colours_of_the_photos(reconstructed: tuple[Path, dict[str, object]]) -> None:
    model = pycolmap.Reconstruction(reconstructed[0] / "sparse" / "sparse" / "0")
    pictures = corner_photos.room(sorted(NAMES))
    differences = []
    for point in model.points3D.values():
        seen = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            x, y = np.floor(image.points2D[element.point2D_idx].xy).astype(int)
            seen.append(pictures[image.name][y, x])
        differences.append(np.abs(np.mean(seen, axis=0) - point.color).max())
    assert max(differences) <= 0.5 + 1e-9


def test_the_number_of_threads_changes_no_bit(
    capture: Inputs, reconstructed: tuple[Path, dict[str, object]], tmp_path: Path
) -> None:
    run_line(capture, tmp_path, threads=3)
    assert digests(tmp_path) == digests(reconstructed[0])


def test_only_the_parts_are_left_behind(reconstructed: tuple[Path, dict[str, object]]) -> None:
    assert set(digests(reconstructed[0])) == {
        "features/database.db",
        "features/colours.npy",
        "matches/database.db",
        "matches/pairs.json",
        "sparse/models.json",
        *(f"sparse/sparse/0/{name}.bin" for name in ("cameras", "frames", "images", "points3D", "rigs")),
    }


def test_two_places_and_a_blank_photo_give_the_larger_model_and_say_so(tmp_path: Path) -> None:
    first = corner_photos.room([f"castle/{number}.png" for number in range(6)])
    second = corner_photos.room([f"mill/{number}.png" for number in range(5)], seed=7)
    blank = {"lens cap.png": np.zeros_like(first["castle/0.png"])}
    inputs = corner_photos.write_capture(tmp_path / "in", {**first, **blank, **second})
    summary, recorder = run_line(inputs, tmp_path / "out")
    assert (summary["registered"], summary["unregistered"]) == (6, 6)
    assert any("1 of 12 photos could not be placed: lens cap.png" in warning for warning in recorder.warnings)
    assert any("5 photos form another model" in warning and "mill/0.png" in warning for warning in recorder.warnings)


def test_photos_without_overlap_are_refused_with_a_hint(tmp_path: Path) -> None:
    pictures = {f"{seed}.png": corner_photos.render(corner_photos.poses(1)[0], seed) for seed in range(3)}
    with pytest.raises(SplatpipeError, match="No two of the 3 photos") as error:
        run_line(corner_photos.write_capture(tmp_path / "in", pictures), tmp_path / "out")
    assert "overlap" in error.value.hint


def test_photos_without_texture_are_refused(tmp_path: Path) -> None:
    pictures = {f"{shade}.png": np.full((240, 320, 3), shade, np.uint8) for shade in (50, 90, 200)}
    with pytest.raises(SplatpipeError, match="too little texture"):
        run_line(corner_photos.write_capture(tmp_path / "in", pictures), tmp_path / "out")


@pytest.mark.parametrize("extractor", ["sift", "opencv-sift"])
def test_masked_pixels_have_no_keypoints_and_the_cap_is_filled_by_others(extractor: str, tmp_path: Path) -> None:
    picture = corner_photos.room(["a.png"])["a.png"]
    mask = np.full(picture.shape[:2], 255, np.uint8)
    mask[:, :200] = 0
    masks = {"a.png": mask, "c.png": np.zeros_like(mask)}
    inputs = corner_photos.write_capture(tmp_path, {"a.png": picture, "b.png": picture, "c.png": picture}, masks)
    config = FeaturesConfig(extractor=extractor, max_features=300)  # type: ignore[arg-type]
    recorder = corner_photos.Recorder()
    features.run(config, inputs, tmp_path, recorder)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        keypoints = database.read_keypoints(1)
        assert keypoints[:, 0].min() >= 200
        assert len(keypoints) >= 300
        assert database.num_keypoints_for_image(3) == 0
    assert "c.png" in recorder.warnings[0]


@pytest.mark.parametrize("extractor", ["sift", "opencv-sift"])
@pytest.mark.parametrize("reduced", [False, True])
def test_keypoints_are_where_the_blobs_are(extractor: str, reduced: bool, tmp_path: Path) -> None:
    """In pixels of the stored grid, the first pixel's centre at 0.5: COLMAP's convention, also for OpenCV's."""
    places = np.array([[x + 0.37 * x / 100, y + 0.21 * x / 90] for x in range(80, 600, 90) for y in (70, 190, 310)])
    x, y = np.meshgrid(np.arange(640) + 0.5, np.arange(400) + 0.5)
    picture = sum(200 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 6.0**2)) for px, py in places)
    picture = np.repeat(np.rint(picture)[:, :, None], 3, axis=2).astype(np.uint8)
    inputs = corner_photos.write_capture(tmp_path, {"a.png": picture, "b.png": picture})
    config = FeaturesConfig(extractor=extractor, max_image_size=320 if reduced else 640)  # type: ignore[arg-type]
    (tmp_path / "out").mkdir()
    features.run(config, inputs, tmp_path / "out", corner_photos.Recorder())
    with pycolmap.Database.open(tmp_path / "out" / "database.db") as database:
        found = database.read_keypoints(1)[:, :2]
    for place in places:
        # A symmetric blob is found to a small part of its width.
        assert np.linalg.norm(found - place, axis=1).min() < (0.2 if reduced else 0.1)


def test_the_cap_keeps_the_largest_and_counts_places() -> None:
    sizes = [1.0, 5.0, 5.0, 3.0]
    places = [[0, 0], [1, 1], [1, 1], [2, 2]]
    keypoints = np.array([[*place, size, 0, 0, size] for place, size in zip(places, sizes, strict=True)], np.float32)
    assert largest(keypoints, 2).tolist() == [1, 2, 3]
    assert largest(keypoints, 9).tolist() == [1, 2, 3, 0]
    assert largest(keypoints[:0], 9).tolist() == []


def test_a_photo_of_another_size_is_reduced_by_averaging() -> None:
    checker = ((np.indices((400, 800)).sum(axis=0) % 2) * 255).astype(np.uint8)
    small = reduced(checker, 400)
    assert small.shape == (200, 400)
    assert np.abs(small.astype(int) - 127).max() <= 1
    assert reduced(checker, 800) is checker


def test_opencv_threads_are_as_before(capture: Inputs, tmp_path: Path) -> None:
    before = cv2.getNumThreads()
    features.run(FAST, capture, tmp_path, corner_photos.Recorder())
    assert cv2.getNumThreads() == before
