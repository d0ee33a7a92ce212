"""Pinhole views, and how a dataset's views are read and split."""

import contextlib
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import (
    Split,
    image_path,
    load_points,
    load_points_and_tracks,
    load_split,
    load_views,
    mask_path,
    split_views,
)


def a_camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = pycolmap.Rotation3d(np.array([0.1, -0.2, 0.3])).matrix()
    pose[:3, 3] = [0.5, -1.0, 4.0]
    return Camera("a.jpg", 40, 30, 50.0, 51.0, 19.0, 16.0, pose)


def test_the_centre_is_where_the_camera_frame_begins() -> None:
    camera = a_camera()
    assert camera.cam_from_world[:3, :3] @ camera.centre() + camera.cam_from_world[:3, 3] == pytest.approx(0, abs=1e-12)


def test_projection_agrees_with_the_matrices_and_scales_with_the_image() -> None:
    camera = a_camera()
    points = np.random.default_rng(0).normal(size=(20, 3))
    in_camera = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    homogeneous = in_camera @ camera.k().T
    assert camera.project(points) == pytest.approx(homogeneous[:, :2] / homogeneous[:, 2:])
    half = camera.scaled(20, 15)
    assert half.project(points) == pytest.approx(camera.project(points) / 2)
    assert (half.width, half.height) == (20, 15)


def write_model(folder: Path, kind: str = "PINHOLE") -> None:
    model = pycolmap.Reconstruction()
    parameters = [50.0, 51.0, 19.0, 16.0] if kind == "PINHOLE" else [50.0, 19.0, 16.0, 0.1]
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, model=kind, width=40, height=30, params=parameters))
    for number, name in enumerate(("b.jpg", "a/ü 1.jpg"), start=1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.0, 0.2])), np.array([0.0, float(number), 4.0]))
        model.add_image_with_trivial_frame(pycolmap.Image(name, np.array([[3.0, 4.0]]), 1, number), pose)
    track = pycolmap.Track([pycolmap.TrackElement(1, 0), pycolmap.TrackElement(2, 0)])
    model.add_point3D(np.array([0.1, 0.2, 0.3]), track, np.array([1, 2, 3], np.uint8))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")


def test_views_come_in_name_order_with_the_models_cameras(tmp_path: Path) -> None:
    write_model(tmp_path)
    mask_path(tmp_path, "b.jpg").parent.mkdir()
    mask_path(tmp_path, "b.jpg").touch()
    views = load_views(tmp_path)
    assert [view.camera.name for view in views] == ["a/ü 1.jpg", "b.jpg"]
    assert views[0].image_path == image_path(tmp_path, "a/ü 1.jpg") == tmp_path / "images" / "a" / "ü 1.jpg"
    assert [view.mask_path for view in views] == [None, tmp_path / "masks" / "b.jpg.png"]
    image = next(
        image for image in pycolmap.Reconstruction(tmp_path / "sparse/0").images.values() if image.image_id == 2
    )
    assert views[0].camera.centre() == pytest.approx(image.projection_center())
    point = np.array([[0.3, 0.2, 0.1]])
    assert views[0].camera.project(point)[0] == pytest.approx(image.project_point(point[0]))


def test_points_have_colours_and_track_lengths(tmp_path: Path) -> None:
    write_model(tmp_path)
    points = load_points(tmp_path)
    assert len(points) == 1
    assert points.xyz.tolist() == [[0.1, 0.2, 0.3]]
    assert points.rgb.tolist() == [[1, 2, 3]]
    assert points.track_lengths.tolist() == [2]


def test_tracks_are_rows_of_the_points_each_once(tmp_path: Path) -> None:
    """Ids with a gap, a photo that sees a point twice, and one that sees none."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=40, height=30, params=[50.0, 51.0, 19.0, 16.0])
    model.add_camera_with_trivial_rig(camera)
    for number, name in enumerate(("b.jpg", "a.jpg", "c.jpg"), start=1):
        image = pycolmap.Image(name, np.full((3, 2), 5.0), 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    tracks = [[(1, 0), (2, 0)], [(1, 1), (2, 1)], [(2, 2), (1, 2), (1, 0)]]
    for index, elements in enumerate(tracks):
        if index == 2:
            model.delete_point3D(1)
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in elements])
        model.add_point3D(np.array([float(index), 0.0, 1.0]), track, np.zeros(3, np.uint8))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse" / "0")
    points, tracks = load_points_and_tracks(tmp_path)
    assert points.xyz[:, 0].tolist() == load_points(tmp_path).xyz[:, 0].tolist() == [1.0, 2.0]
    found = {name: rows.tolist() for name, rows in tracks.items()}
    assert found == {"a.jpg": [0, 1], "b.jpg": [0, 1], "c.jpg": []}


def test_a_missing_broken_or_distorted_model_fails_the_stage(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="sparse/0"):
        load_views(tmp_path)
    write_model(tmp_path / "radial", "SIMPLE_RADIAL")
    with pytest.raises(StageError, match="not PINHOLE"):
        load_views(tmp_path / "radial")
    write_model(tmp_path / "cut")
    cut = tmp_path / "cut" / "sparse" / "0" / "images.bin"
    cut.write_bytes(cut.read_bytes()[:20])
    with pytest.raises(StageError):
        load_views(tmp_path / "cut")


def test_a_model_is_read_as_pycolmap_reads_it_to_the_bit(tmp_path: Path) -> None:
    generator = np.random.default_rng(7)
    model = pycolmap.Reconstruction()
    for number in range(1, 31):
        kind, count = ("PINHOLE", 4) if number % 2 else ("SIMPLE_PINHOLE", 3)
        lens = pycolmap.Camera(
            camera_id=number, model=kind, width=40, height=30, params=generator.uniform(20, 60, count)
        )
        model.add_camera_with_trivial_rig(lens)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(generator.normal(size=3)), generator.normal(size=3) * 1e3)
        model.add_image_with_trivial_frame(pycolmap.Image(f"{number}.jpg", np.zeros((5, 2)), number, number), pose)
    for keypoint in range(5):
        track = pycolmap.Track(
            [pycolmap.TrackElement(int(n), keypoint) for n in generator.choice(30, 3, replace=False) + 1]
        )
        model.add_point3D(generator.normal(size=3), track, generator.integers(0, 255, 3).astype(np.uint8))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse" / "0")
    again = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    for view in load_views(tmp_path):
        image = again.find_image_with_name(view.camera.name)
        assert np.array_equal(view.camera.cam_from_world[:3], image.cam_from_world().matrix())
        assert np.array_equal(view.camera.k(), image.camera.calibration_matrix())
    points = [again.points3D[number] for number in sorted(again.points3D)]
    ours = load_points(tmp_path)
    assert np.array_equal(ours.xyz, [point.xyz for point in points])
    assert np.array_equal(ours.rgb, [point.color for point in points])
    assert ours.errors_px.tolist() == [point.error for point in points]


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_hostile_model_is_refused_and_never_more_than_its_bytes_are_read(tmp_path: Path, name: str) -> None:
    """Every file cut short anywhere, too long, or with a claim of 2^60 entries at any of its 64-bit words."""
    write_model(tmp_path)
    path = tmp_path / "sparse" / "0" / name
    sound = path.read_bytes()
    huge = (1 << 60).to_bytes(8, "little")
    broken = [sound[:length] for length in range(len(sound))] + [sound + b"\0", huge + sound[8:]]
    for data in broken:
        path.write_bytes(data)
        with pytest.raises(StageError, match="sparse/0"):
            load_points_and_tracks(tmp_path)
    for start in range(8, len(sound) - 7):
        path.write_bytes(sound[:start] + huge + sound[start + 8 :])
        with contextlib.suppress(StageError):  # an impossible count; elsewhere it is an ordinary number
            load_points_and_tracks(tmp_path)


def test_every_eighth_view_is_held_out_starting_with_the_first() -> None:
    names = [f"{number:02d}" for number in range(20)]
    found = split_views(names[::-1], 8, "")
    assert found.held_out == ("00", "08", "16")
    assert found.train == tuple(sorted(set(names) - set(found.held_out)))
    assert split_views(names, 0, "") == Split(tuple(names))


def test_named_views_are_held_out_instead() -> None:
    assert split_views(["a b", "c", "d"], 8, " c, a b,") == Split(("d",), ("a b", "c"))
    with pytest.raises(SplatpipeError, match="names x, which") as error:
        split_views(["a", "b"], 8, "x")
    assert "a, b" in error.value.hint


def test_views_may_be_named_without_suffix_case_and_folder() -> None:
    names = ["100_7105.JPG", "100_7106.JPG", "a/1.jpg", "b/1.jpg", "b/2.png"]
    assert split_views(names, 8, "100_7105, A/1,2").held_out == ("100_7105.JPG", "a/1.jpg", "b/2.png")
    for unclear in ("1", "1.jpg", "100_710", "c/1"):
        with pytest.raises(SplatpipeError, match=f"names {unclear}, which"):
            split_views(names, 8, unclear)
    assert split_views(["x", "x.jpg", "X.jpg"], 8, "x,x.jpg").held_out == ("x", "x.jpg")


def test_at_least_one_photo_must_remain_for_training() -> None:
    with pytest.raises(SplatpipeError, match="none is left"):
        split_views(["a", "b"], 1, "")


def test_a_split_survives_its_file_and_a_broken_one_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "split.json"
    for found in (Split(("a", "б c")), Split(("a",), ("d/e.jpg",))):
        path.write_text(found.to_json(), encoding="utf-8")
        assert load_split(path) == found
    for text in ("", "[]", '{"train": ["a"]}', '{"train": 5, "held_out": []}'):
        path.write_text(text)
        with pytest.raises(StageError, match=r"split\.json") as raised:
            load_split(path)
        assert "--rerun-from split" in raised.value.hint
