"""initialize: sizes from neighbours, colours, opacity, and models it cannot start from."""

import math
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import Points
from splatpipe.pipeline.splat.containers.ply import read_splat, read_splat_header
from splatpipe.pipeline.splat.model.sh import C0
from splatpipe.pipeline.splat.model.sparse_count import sparse_comment
from splatpipe.stages.initialize import choose_points, point_sizes, run

RNG = np.random.default_rng(7)
FAR = np.array([[0.0, 0.0, -100.0]])  # a camera so far away that no size is capped


class Quiet:
    def progress(self, done: float, total: float, what: str, unit: str = "") -> None: ...

    def metric(self, name: str, value: float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None: ...
    def warning(self, message: str, hint: str = "") -> None: ...


def write_dataset(folder: Path, points: np.ndarray, colours: np.ndarray) -> Path:
    """Return a model with two cameras at z = −5 and the given points."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 64, 48)
    model.add_camera_with_trivial_rig(camera)
    for number, x in enumerate((-1.0, 1.0), start=1):
        image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-x, 0.0, 5.0]))
        model.add_image_with_trivial_frame(image, pose)
    for xyz, colour in zip(points, colours, strict=True):
        model.add_point3D(xyz, pycolmap.Track(), colour)
    (folder / "sparse/0").mkdir(parents=True)
    model.write(folder / "sparse/0")
    return folder


def test_size_is_the_mean_distance_to_the_three_nearest_neighbours() -> None:
    xyz = RNG.normal(size=(500, 3))
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    expected = np.sort(distance, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(point_sizes(xyz, FAR, 1.0), expected, rtol=1e-5)


def test_outliers_are_capped_by_their_distance_to_the_nearest_camera() -> None:
    xyz = np.concatenate((RNG.normal(size=(100, 3)), [[0.0, 0.0, 1000.0]]))
    sizes = point_sizes(xyz, np.array([[0.0, 0.0, -10.0], [0.0, 0.0, -20.0]]), 0.05)
    assert sizes[-1] == pytest.approx(0.05 * 1010.0)
    assert (sizes[:-1] < 2.0).all()


def test_points_on_top_of_each_other_and_few_points_have_a_positive_finite_size() -> None:
    for xyz in (np.zeros((6, 3)), np.zeros((1, 3)), np.array([[0.0, 0, 0], [1.0, 0, 0]])):
        sizes = point_sizes(xyz, FAR, 0.1)
        assert np.isfinite(sizes).all() and (sizes > 0).all()


def test_sizes_are_as_precise_far_from_the_origin() -> None:
    xyz = RNG.normal(size=(200, 3))
    shift = np.array([500_000.0, 5_000_000.0, 100.0])
    np.testing.assert_allclose(point_sizes(xyz + shift, FAR + shift, 1.0), point_sizes(xyz, FAR, 1.0), rtol=1e-4)


def test_limit_keeps_the_longest_tracks_in_order() -> None:
    points = Points(
        np.zeros((4, 3)), np.zeros((4, 3), np.uint8), np.array([2, 5, 3, 5]), np.array([0.1, 0.9, 0.2, 0.3])
    )
    np.testing.assert_array_equal(choose_points(points, np.arange(4), 3), [1, 2, 3])
    np.testing.assert_array_equal(choose_points(points, np.arange(4), 1), [3])


def test_every_point_becomes_an_isotropic_gaussian_of_its_colour(tmp_path: Path) -> None:
    xyz = RNG.normal(size=(50, 3))
    colours = RNG.integers(0, 256, size=(50, 3)).astype(np.uint8)
    dataset = write_dataset(tmp_path / "dataset", xyz, colours)
    inputs = Inputs({"undistort.dataset": dataset}, tmp_path)
    summary = run(InitializeConfig(opacity=0.2, dense=False), inputs, tmp_path, Quiet())
    gaussians = read_splat(tmp_path / "init.ply")
    assert summary["gaussians"] == len(gaussians) == 50
    assert gaussians.sh_degree == 3
    np.testing.assert_allclose(gaussians.means.numpy(), xyz, rtol=1e-6)
    np.testing.assert_allclose((C0 * gaussians.sh[:, 0] + 0.5).numpy() * 255.0, colours, atol=1e-3)
    assert not gaussians.sh[:, 1:].any()
    assert (gaussians.log_scales == gaussians.log_scales[:, :1]).all()
    torch.testing.assert_close(torch.sigmoid(gaussians.opacity_logits), torch.full((50,), 0.2))
    assert math.isclose(float(gaussians.quats.norm(dim=1).mean()), 1.0)


def test_the_file_states_how_many_are_of_sparse_points_whatever_was_left_out(tmp_path: Path) -> None:
    xyz = RNG.normal(size=(50, 3))
    xyz[7] = np.nan
    dataset = write_dataset(tmp_path / "dataset", xyz, np.zeros((50, 3), np.uint8))
    for limit, left in ((1000, 49), (20, 20)):
        run(
            InitializeConfig(max_gaussians=limit, dense=False),
            Inputs({"undistort.dataset": dataset}, tmp_path),
            tmp_path,
            Quiet(),
        )
        assert read_splat_header(tmp_path / "init.ply").comments == (sparse_comment(left),)


def test_model_without_points_says_what_to_do(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path / "dataset", np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    with pytest.raises(SplatpipeError, match="no points") as raised:
        run(InitializeConfig(), Inputs({"undistort.dataset": dataset}, tmp_path), tmp_path, Quiet())
    assert raised.value.hint
