"""The undistorted dataset: its pixels, its model, and other programs that can read it."""

import hashlib
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import corner_photos
import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.photos.files.photo_list import PhotoList, load_photo_list, save_photo_list
from splatpipe.pipeline.photos.options import UndistortConfig
from splatpipe.pipeline.photos.pixels import resampling, undistortion
from splatpipe.pipeline.photos.pixels.dataset import load_points, load_views
from splatpipe.pipeline.photos.pixels.undistortion import pinhole_camera, with_places
from splatpipe.stages import undistort

WIDTH, HEIGHT = 960, 720
# Directions that every camera below sees, x/z and y/z.
RAYS = np.array([[x, y] for x in (-0.35, -0.12, 0.05, 0.33) for y in (-0.22, 0.01, 0.24)])
CAMERAS = {
    "SIMPLE_RADIAL": [900.0, 480.0, 360.0, -0.12],
    "OPENCV": [900.0, 905.0, 500.0, 340.0, -0.1, 0.03, 0.002, -0.003],
    "FULL_OPENCV": [900.0, 905.0, 470.0, 365.0, 0.1, -0.03, 0.001, 0.001, 0.01, 0.02, 0.0, 0.0],
    "OPENCV_FISHEYE": [620.0, 620.0, 480.0, 360.0, 0.02, -0.005, 0.0, 0.0],
    "PINHOLE": [900.0, 890.0, 510.0, 330.0],
    "SIMPLE_PINHOLE": [900.0, 480.0, 360.0],
}


def make_camera(model: str, scale: float = 1.0) -> pycolmap.Camera:
    camera = pycolmap.Camera(camera_id=1, model=model, width=WIDTH, height=HEIGHT, params=CAMERAS[model])
    if scale != 1.0:
        camera.rescale(scale)
    return camera


def rays(places: np.ndarray = RAYS) -> np.ndarray:
    return np.column_stack([places, np.ones(len(places))])


def blobs(camera: pycolmap.Camera, sigma_px: float = 5.0) -> np.ndarray:
    """A dark photo in which each of RAYS is a bright spot."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    photo = np.zeros((camera.height, camera.width))
    for place in camera.img_from_cam(rays()):
        photo += 230 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * sigma_px**2))
    return np.repeat(np.rint(photo)[:, :, None], 3, axis=2).astype(np.uint8)


def centroid(photo: np.ndarray, near: np.ndarray, radius: int) -> np.ndarray:
    column, row = np.floor(near).astype(int)
    window = photo[row - radius : row + radius + 1, column - radius : column + radius + 1].astype(float)
    y, x = np.indices(window.shape)
    found = np.array([(window * x).sum(), (window * y).sum()]) / window.sum()
    return np.asarray(found + np.array([column - radius + 0.5, row - radius + 0.5]))


def write_model(
    folder: Path, camera: pycolmap.Camera, names: list[str], *, text: bool = False, tracks: bool = True
) -> None:
    """A model of photos from one place whose points lie on RAYS."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    places = camera.img_from_cam(rays())
    for number, name in enumerate(names, start=1):
        image = pycolmap.Image(name, places if tracks else np.zeros((0, 2)), 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for index, ray in enumerate(rays()):
        elements = [pycolmap.TrackElement(number, index) for number in range(1, len(names) + 1)] if tracks else []
        model.add_point3D(ray * 5, pycolmap.Track(elements), np.array([index, 100, 200], np.uint8))
    folder.mkdir(parents=True)
    if text:
        model.write_text(folder)
        for newer in ("rigs.txt", "frames.txt"):  # other programs do not write these
            (folder / newer).unlink(missing_ok=True)
    else:
        model.write_binary(folder)


def run(
    inputs: Inputs, model: Path, out: Path, megapixels: float = 0.2, threads: int = 1
) -> tuple[dict[str, object], corner_photos.Recorder]:
    out.mkdir(exist_ok=True)
    recorder = corner_photos.Recorder()
    inputs = corner_photos.with_parts(inputs, threads, georef__model=model)
    return dict(undistort.run(UndistortConfig(max_megapixels=megapixels), inputs, out, recorder)), recorder


@pytest.mark.parametrize("model_scale", [1.0, 0.5])
@pytest.mark.parametrize("model", CAMERAS)
def test_pixels_are_where_the_pinhole_camera_projects_them(model: str, model_scale: float, tmp_path: Path) -> None:
    """Also where the model was made from photos of half the size."""
    photo = blobs(make_camera(model))
    names = ["a.png", "sub/b b.png"]
    inputs = corner_photos.write_capture(tmp_path / "in", dict.fromkeys(names, photo))
    write_model(tmp_path / "model", make_camera(model, model_scale), names)
    run(inputs, tmp_path / "model", tmp_path / "out")
    views = load_views(tmp_path / "out" / "dataset")
    assert [view.camera.name for view in views] == names
    for view in views:
        camera = view.camera
        assert 0.19e6 < camera.width * camera.height <= 0.2e6
        pixels = cv2.imread(str(view.image_path))
        assert pixels.shape == (camera.height, camera.width, 3)
        for place in camera.project(rays()):
            # A spot of 2 pixels' width, in whole grey values: its centroid is good to a few hundredths.
            assert np.abs(centroid(pixels[:, :, 0], place, 8) - place).max() < 0.05


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize("megapixels", [0.1, 2.0])
def test_no_pixel_samples_beyond_the_photo(model: str, megapixels: float) -> None:
    source = make_camera(model)
    target = pinhole_camera(source, megapixels, 1)
    x, y = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    places = resampling._project(source, target, np.column_stack([x.ravel(), y.ravel()]))
    assert places.min() > -0.5
    assert (places < [WIDTH + 0.5, HEIGHT + 0.5]).all()


def test_fine_texture_is_averaged_and_not_aliased() -> None:
    source = make_camera("SIMPLE_RADIAL")
    target = pinhole_camera(source, 0.05, 1)
    checker = ((np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2) * 255).astype(np.uint8)
    small = resampling.resample(checker, source, target).astype(float)
    assert abs(small.mean() - 127.5) < 1
    assert small.std() < 6
    ramp = np.repeat(np.linspace(0, 255, WIDTH)[None], HEIGHT, axis=0).astype(np.uint8)
    wide = resampling.resample(ramp, source, target)
    x, y = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    true = resampling._project(source, target, np.column_stack([x.ravel(), y.ravel()]))[:, 0] * 255 / WIDTH
    assert np.abs(wide.ravel() - true).max() < 2  # rounding of the ramp and of the result


def test_strips_join_without_a_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    source = make_camera("OPENCV")
    target = pinhole_camera(source, 0.1, 1)
    photo = blobs(source)
    whole = resampling.resample(photo, source, target)
    monkeypatch.setattr(resampling, "STRIP_PIXELS", 40_000)
    assert (resampling.resample(photo, source, target) == whole).all()


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize("megapixels", [0.05, 2.0])
def test_places_kept_for_a_camera_do_not_change_a_bit(
    model: str, megapixels: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = make_camera(model)
    target = pinhole_camera(source, megapixels, 1)
    photo = blobs(source)
    monkeypatch.setattr(resampling, "PROJECTED", 64 * target.width)
    monkeypatch.setattr(resampling, "STRIP_PIXELS", 200_000)
    places = resampling.kept_places(source, target)
    if places is None:
        assert model.endswith("PINHOLE")  # only reduced
        return
    before = places.copy()
    whole = resampling.resample(photo, source, target)
    np.testing.assert_array_equal(resampling.resample(photo, source, target, places), whole)
    np.testing.assert_array_equal(places, before)
    monkeypatch.setattr(resampling, "KEPT_PIXELS", target.width * target.height - 1)
    assert resampling.kept_places(source, target) is None


def test_places_are_computed_once_for_all_photos_of_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[int] = []
    monkeypatch.setattr(undistortion, "kept_places", lambda _, target: computed.append(target.camera_id))
    targets = {}
    for number in (1, 2, 3):
        targets[number] = pinhole_camera(make_camera("OPENCV"), 0.1, number)
    placed = [Mock(target=targets[number]) for number in (2, 1, 2, 3, 1, 2)]
    given = [view for view, _ in with_places(placed)]
    assert [placed.index(view) for view in given] == [1, 4, 0, 2, 5, 3]  # by camera, then as they were
    assert computed == [1, 2]  # a single photo's are computed strip by strip


def test_a_pinhole_photo_of_the_right_size_is_unchanged() -> None:
    source = make_camera("PINHOLE")
    photo = blobs(source)
    assert resampling.resample(photo, source, pinhole_camera(source, 2.0, 1)) is photo


def test_masks_are_undistorted_and_count_only_whole_pixels(tmp_path: Path) -> None:
    source = make_camera("SIMPLE_RADIAL")
    photo = blobs(source)
    mask = np.full(photo.shape[:2], 255, np.uint8)
    mask[:, :300] = 0
    inputs = corner_photos.write_capture(tmp_path / "in", {"a.png": photo, "b.png": photo}, {"a.png": mask})
    write_model(tmp_path / "model", source, ["a.png", "b.png"])
    assert run(inputs, tmp_path / "model", tmp_path / "out")[0]["masks"] == 1
    views = load_views(tmp_path / "out" / "dataset")
    assert views[1].mask_path is None
    assert views[0].mask_path is not None
    small = cv2.imread(str(views[0].mask_path), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(small)) == {0, 255}
    x, y = np.meshgrid(np.arange(small.shape[1]) + 0.5, np.arange(small.shape[0]) + 0.5)
    target = pinhole_camera(source, 0.2, 1)
    true = resampling._project(source, target, np.column_stack([x.ravel(), y.ravel()]))[:, 0].reshape(small.shape)
    assert not small[true < 300].any()
    assert small[true > 304].all()


def test_sky_masks_are_undistorted_too(tmp_path: Path) -> None:
    source = make_camera("SIMPLE_RADIAL")
    photo = blobs(source)
    mask = np.full(photo.shape[:2], 255, np.uint8)
    mask[200:] = 0
    inputs = corner_photos.write_capture(tmp_path / "in", {"a.png": photo, "b.png": photo}, {"a.png": mask})
    write_model(tmp_path / "model", source, ["a.png", "b.png"])
    run(inputs, tmp_path / "model", tmp_path / "masked")
    part = inputs["ingest.photos"]
    skies = tuple(replace(entry, mask=None, sky_mask=entry.mask) for entry in load_photo_list(part).photos)
    save_photo_list(PhotoList(skies), part)
    run(inputs, tmp_path / "model", tmp_path / "out")
    views = load_views(tmp_path / "out" / "dataset")
    assert [view.mask_path for view in views] == [None, None] and views[1].sky_path is None
    assert views[0].sky_path == tmp_path / "out/dataset/sky_masks/a.png.png"
    assert views[0].sky_path.read_bytes() == (tmp_path / "masked/dataset/masks/a.png.png").read_bytes()


def test_written_photos_have_no_exif_and_keep_their_names(tmp_path: Path) -> None:
    source = make_camera("SIMPLE_RADIAL")
    names = ["a.JPG", "b.tif", "c.png", "ohne Endung"]
    inputs = corner_photos.write_capture(tmp_path / "in", dict.fromkeys(names, blobs(source)))
    turned = Image.fromarray(blobs(source))
    exif = turned.getexif()
    exif[274] = 6
    turned.save(inputs.photos_dir / "a.JPG", format="JPEG", exif=exif)
    corner_photos.list_anew(inputs)
    write_model(tmp_path / "model", source, names)
    run(inputs, tmp_path / "model", tmp_path / "out")
    formats = {}
    for view in load_views(tmp_path / "out" / "dataset"):
        with Image.open(view.image_path) as picture:
            formats[view.camera.name] = picture.format
            assert picture.getexif().get(274, 1) == 1
        assert cv2.imread(str(view.image_path)).shape[:2] == (view.camera.height, view.camera.width)
    assert formats == {"a.JPG": "JPEG", "b.tif": "TIFF", "c.png": "PNG", "ohne Endung": "JPEG"}


def test_the_model_keeps_visible_points_and_fits(tmp_path: Path) -> None:
    source = make_camera("OPENCV")
    names = ["a.png", "b.png"]
    inputs = corner_photos.write_capture(tmp_path / "in", dict.fromkeys(names, blobs(source)))
    write_model(tmp_path / "model", source, names)
    summary, _ = run(inputs, tmp_path / "model", tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out" / "dataset" / "sparse" / "0")
    assert model.num_reg_images() == 2
    assert summary["points3d"] == model.num_points3D() == len(RAYS)
    assert model.compute_mean_reprojection_error() < 1e-6
    assert [camera.model_name for camera in model.cameras.values()] == ["PINHOLE"]
    assert load_points(tmp_path / "out" / "dataset").rgb[:, 0].tolist() == list(range(len(RAYS)))


def test_points_that_leave_the_frame_are_dropped(tmp_path: Path) -> None:
    source = make_camera("SIMPLE_RADIAL")
    inputs = corner_photos.write_capture(tmp_path / "in", dict.fromkeys(["a.png", "b.png"], blobs(source)))
    write_model(tmp_path / "model", source, ["a.png", "b.png"])
    model = pycolmap.Reconstruction(tmp_path / "model")
    for number in (1, 2):
        model.images[number].points2D[0].xy = np.array([-40.0, -40.0])
    model.write_binary(tmp_path / "model")
    assert run(inputs, tmp_path / "model", tmp_path / "out")[0]["points3d"] == len(RAYS) - 1


def test_a_text_model_without_observations_keeps_its_points(tmp_path: Path) -> None:
    """As exported by Metashape and RealityScan."""
    source = make_camera("OPENCV")
    inputs = corner_photos.write_capture(tmp_path / "in", dict.fromkeys(["x/A.png", "x/B.png"], blobs(source)))
    write_model(tmp_path / "model", source, ["a.jpg", "sub\\b.png"], text=True, tracks=False)
    run(inputs, tmp_path / "model", tmp_path / "out")
    assert [view.camera.name for view in load_views(tmp_path / "out" / "dataset")] == ["x/A.png", "x/B.png"]
    points = load_points(tmp_path / "out" / "dataset")
    assert points.xyz == pytest.approx(rays() * 5)
    assert set(points.track_lengths) == {0}
    assert set(points.errors_px) == {-1.0}


def test_missing_or_mismatched_photos_are_named(tmp_path: Path) -> None:
    source = make_camera("SIMPLE_RADIAL")
    pictures = dict.fromkeys(["a.png", "b.png", "c.png"], blobs(source))
    pictures["c.png"] = pictures["c.png"][:600]
    inputs = corner_photos.write_capture(tmp_path / "in", pictures)
    write_model(tmp_path / "model", source, ["a.png", "b.png", "c.png", "gone.png"])
    summary, recorder = run(inputs, tmp_path / "model", tmp_path / "out")
    assert summary["photos"] == 2
    assert "c.png" in recorder.warnings[0]  # georef has already warned about gone.png
    write_model(tmp_path / "elsewhere", source, ["x.png", "y.png"])
    with pytest.raises(SplatpipeError, match="0 can be used"):
        run(inputs, tmp_path / "elsewhere", tmp_path / "none")


def test_a_broken_model_is_a_user_error(tmp_path: Path) -> None:
    inputs = corner_photos.write_capture(tmp_path / "in", {"a.png": blobs(make_camera("PINHOLE"))})
    write_model(tmp_path / "model", make_camera("PINHOLE"), ["a.png", "b.png"])
    images = tmp_path / "model" / "images.bin"
    images.write_bytes(images.read_bytes()[:30])
    with pytest.raises(SplatpipeError, match="cannot be read"):
        run(inputs, tmp_path / "model", tmp_path / "out")


def test_the_number_of_threads_changes_no_bit(tmp_path: Path) -> None:
    source = make_camera("OPENCV")
    names = [f"{number}.jpg" for number in range(5)]
    inputs = corner_photos.write_capture(tmp_path / "in", dict.fromkeys(names, blobs(source)))
    write_model(tmp_path / "model", source, names)
    sums = []
    for threads in (1, 3):
        out = tmp_path / str(threads)
        run(inputs, tmp_path / "model", out, threads=threads)
        files = sorted(path for path in out.rglob("*") if path.is_file())
        sums.append([(path.relative_to(out), hashlib.sha256(path.read_bytes()).hexdigest()) for path in files])
    assert sums[0] == sums[1]
