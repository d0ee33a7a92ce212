"""Projection for pinholes and for lenses: inverse to unprojection, and equal to pycolmap's."""

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.geometry.camera import Camera, Window
from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.geometry.similarity import rotation_from_vector


@pytest.fixture
def camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_vector(np.array([0.3, -0.2, 0.9])), [0.4, -0.3, 2.0]
    return Camera("a.jpg", 90, 60, 80.0, 85.0, 44.0, 31.0, pose)


def pixels_everywhere() -> np.ndarray:
    return np.random.default_rng(0).uniform([0.0, 0.0], [90.0, 60.0], (40, 2))


def test_unprojected_pixels_project_back_and_lie_at_their_depths(camera: Camera) -> None:
    pixels, depths = pixels_everywhere(), np.linspace(0.5, 30.0, 40)
    places = camera.unproject(pixels, depths)
    np.testing.assert_allclose(camera.project(places), pixels, atol=1e-10)
    np.testing.assert_allclose(camera.depths(places), depths, atol=1e-12)


def test_only_points_in_front_and_inside_the_image_are_in_view(camera: Camera) -> None:
    corners = np.array([[0.001, 0.001], [89.999, 59.999], [-0.001, 5.0], [90.001, 5.0], [5.0, 60.001], [45.0, 30.0]])
    places = camera.unproject(corners, np.full(6, 3.0))
    behind = camera.unproject(corners[5:], np.array([-3.0]))
    rows, pixels, depths = camera.in_view(np.vstack([behind, places, [[np.nan, 0.0, 0.0]], [[np.inf, 0.0, 0.0]]]))
    assert rows.tolist() == [1, 2, 6]
    np.testing.assert_allclose(pixels, corners[[0, 1, 5]], atol=1e-6)
    np.testing.assert_allclose(depths, 3.0)


def test_a_window_sees_what_the_whole_sees_there_and_refers_to_the_whole(camera: Camera) -> None:
    part = camera.crop(31, 7, 40, 29)
    assert (part.width, part.height, part.window) == (40, 29, Window(31, 7, 90, 60))
    places = camera.unproject(pixels_everywhere(), np.linspace(0.5, 30.0, 40))
    np.testing.assert_allclose(np.add(part.project(places), [31.0, 7.0]), camera.project(places), atol=1e-10)
    whole, inner = part.uncropped(), part.crop(5, 6, 10, 12)
    assert (whole.width, whole.height, whole.fx, whole.fy) == (camera.width, camera.height, camera.fx, camera.fy)
    np.testing.assert_allclose([whole.cx, whole.cy], [camera.cx, camera.cy], atol=1e-10)
    assert whole.window is None and whole.uncropped() is whole
    assert inner.window == Window(36, 13, 90, 60)  # a part of a part is a part of the whole
    np.testing.assert_allclose(np.add(inner.project(places), [36.0, 13.0]), camera.project(places), atol=1e-10)


def test_a_window_of_the_whole_image_is_none_and_one_outside_is_refused(camera: Camera) -> None:
    assert camera.crop(0, 0, 90, 60) is camera
    for part in [(-1, 0, 5, 5), (0, -1, 5, 5), (0, 0, 0, 5), (0, 0, 5, 0), (86, 0, 5, 5), (0, 56, 5, 5)]:
        with pytest.raises(ValueError, match="not inside"):
            camera.crop(*part)
    with pytest.raises(ValueError, match="scale the full image"):
        camera.crop(1, 1, 20, 20).scaled(10, 10)


def test_a_lens_without_distortion_is_the_pinhole(camera: Camera) -> None:
    lens = pycolmap.Camera(model="PINHOLE", width=90, height=60, params=[80.0, 85.0, 44.0, 31.0])
    places = camera.unproject(pixels_everywhere(), np.linspace(-5.0, 30.0, 40))
    pixels, depths = project_through_lens(lens, camera.cam_from_world[:3], places)
    behind = depths <= 0.0
    assert 0 < behind.sum() < 20 and np.isnan(pixels[behind]).all()
    np.testing.assert_allclose(pixels[~behind], camera.project(places[~behind]), atol=1e-10)
    assert np.isnan(project_through_lens(lens, camera.cam_from_world[:3], places[behind])[0]).all()


def test_a_distorted_lens_is_colmaps(camera: Camera) -> None:
    lens = pycolmap.Camera(model="OPENCV", width=90, height=60, params=[80.0, 85.0, 44.0, 31.0, -0.1, 0.02, 1e-3, 2e-3])
    places = camera.unproject(pixels_everywhere(), np.full(40, 4.0))
    pose = camera.cam_from_world[:3]
    seen = np.array([lens.img_from_cam(pose[:, :3] @ place + pose[:, 3]) for place in places])
    np.testing.assert_allclose(project_through_lens(lens, pose, places)[0], seen, atol=1e-10)
