"""The floater features of a model with known truth, with and without something floating before a camera."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.app.report.verdict import MAX_VEIL_SHARE
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.render.blocked_light import blocked_shares
from splatpipe.pipeline.render.floater_metric import measure_floaters
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality.free_space import free_space, near_or_free

WALL = 6.0
HELD_OUT = {"photo_3.png"}
OPTIONS = RenderOptions(sh_degree=0, background=(1.0, 1.0, 1.0), depth=False)


def cameras() -> list[Camera]:
    """Four in a row, looking along z."""
    found = []
    for number in range(4):
        pose = np.eye(4)
        pose[0, 3] = 0.4 * (1.5 - number)
        found.append(Camera(f"photo_{number}.png", 144, 108, 130.0, 130.0, 72.0, 54.0, pose))
    return found


def places() -> np.ndarray:
    x, y = np.meshgrid(np.arange(-4.0, 4.05, 0.1), np.arange(-3.2, 3.25, 0.1))
    return np.stack((x.ravel(), y.ravel(), np.full(x.size, WALL)), axis=1)


def wall(opacity: float = 0.9) -> Gaussians:
    """A Gaussian at each point, so wide that nothing is seen through the wall."""
    return blob(places(), 0.12, opacity)


def blob(where: np.ndarray, size: float, opacity: float) -> Gaussians:
    found = Gaussians.empty(len(where), 0)
    found.means = torch.from_numpy(where.astype(np.float32))
    found.log_scales[:] = float(np.log(size))
    found.log_scales[:, 2] = float(np.log(0.01))
    found.opacity_logits[:] = float(np.log(opacity / (1.0 - opacity)))
    return found


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the points inside all four images, observed in each."""
    folder = tmp_path_factory.mktemp("floaters")
    xyz = places()
    pixels = [view.project(xyz) for view in cameras()]
    inside = np.all([((seen > 0.0) & (seen < [144.0, 108.0])).all(axis=1) for seen in pixels], axis=0)
    xyz = xyz[inside]
    tiny_scene.write_model(folder / "sparse/0", cameras(), xyz, np.full((len(xyz), 3), 128, np.uint8))
    return folder


def test_true_model_has_no_floaters_and_its_views_agree(dataset: Path) -> None:
    figures = measure_floaters(wall(), cameras(), HELD_OUT, dataset, OPTIONS)
    assert (figures["free_space_opacity"], figures["free_space_gaussians"], figures["free_space_rendered"]) == (0, 0, 0)
    apart = figures["depth_disagreement"]
    assert apart["median"] < 1e-4 and apart["share_above_5_percent"] == 0.0
    assert apart["pairs"] >= 2 and apart["pixels"] > 1000
    json.dumps(figures, allow_nan=False)


def test_planted_floater_is_found_with_the_light_that_it_absorbs(dataset: Path) -> None:
    floater = blob(np.array([[0.0, 0.0, 2.0]]), 0.08, 0.98)
    model = Gaussians.concat([wall(), floater])
    figures = measure_floaters(model, cameras(), HELD_OUT, dataset, OPTIONS)
    assert figures["free_space_gaussians"] == 1
    assert figures["free_space_opacity"] == pytest.approx(0.98 / (0.98 + 0.9 * len(places())), abs=1e-6)
    assert figures["depth_disagreement"]["share_above_5_percent"] == 0.0  # all see it in the same place
    # Light that an isotropic Gaussian absorbs: 2 π σ² × opacity, σ² in pixels and with the screen filter's 0.3.
    stopped = 2.0 * np.pi * ((0.08 * 130.0 / 2.0) ** 2 + 0.3) * 0.98
    assert figures["free_space_rendered"] == pytest.approx(stopped / (144 * 108), rel=0.05)


def test_haze_that_is_a_surface_for_one_view_alone_is_a_disagreement(dataset: Path) -> None:
    """Two veils, one behind the other for the first camera: only there they stop more than half of the light."""
    x = float(cameras()[0].centre()[0])
    veils = [blob(np.array([[x, 0.0, z]]), 8.0 * z / 130.0, 0.45) for z in (1.5, 3.0)]
    figures = measure_floaters(Gaussians.concat([wall(), *veils]), cameras(), HELD_OUT, dataset, OPTIONS)
    alone = measure_floaters(Gaussians.concat([wall(), veils[0]]), cameras(), HELD_OUT, dataset, OPTIONS)
    assert (figures["free_space_gaussians"], alone["free_space_gaussians"]) == (2, 1)
    apart = figures["depth_disagreement"]
    # (1 - 0.45 g)² is below a half within 0.93 σ: π (0.93 · 8)² pixels, a sixteenth of them samples, in three pairs.
    assert apart["share_above_5_percent"] * apart["pixels"] == pytest.approx(3 * 11, rel=0.4)
    assert apart["median"] < 1e-4
    assert alone["depth_disagreement"]["share_above_5_percent"] == 0.0


def test_depth_of_an_antialiased_model_is_that_of_the_surface_however_fine_its_gaussians_are() -> None:
    """Gaussians of a quarter of a pixel, one per pixel, before a wall: a sixth of the pixel's area, all of its ray."""
    camera = Camera("photo", 40, 30, 100.0, 100.0, 20.0, 15.0, np.eye(4))
    x, y = np.meshgrid(np.arange(40) + 0.5 - 20.0, np.arange(30) + 0.5 - 15.0)
    fine = blob(np.stack((x.ravel(), y.ravel(), np.full(x.size, 100.0)), axis=1) * 0.03, 0.25 * 0.03, 0.95)
    both = Gaussians.concat([fine, blob(np.array([[0.0, 0.0, 4.0]]), 4.0, 0.99)])
    trained = RenderOptions(sh_degree=0, antialias=True)
    with torch.no_grad():
        through, seen = (render(both, camera, options).median_depth for options in (trained, trained.for_depths()))
    torch.testing.assert_close(through, torch.full((30, 40), 4.0))
    torch.testing.assert_close(seen, torch.full((30, 40), 3.0))


def test_without_sparse_points_the_figures_are_not_known(tmp_path: Path) -> None:
    tiny_scene.write_model(tmp_path / "sparse/0", cameras(), np.empty((0, 3)), np.empty((0, 3), np.uint8))
    figures = measure_floaters(wall(), cameras(), HELD_OUT, tmp_path, OPTIONS)
    assert figures == {
        "veil": {"held_out": True, "mean": None, "worst": None, "worst_photo": None, "photos": 0, "points": 0},
        "free_space_opacity": None,
        "free_space_gaussians": None,
        "free_space_rendered": None,
        "depth_disagreement": {"median": None, "share_above_5_percent": None, "pairs": 0, "pixels": 0},
    }


def test_figures_do_not_depend_on_the_size_beyond_half_a_megapixel(dataset: Path) -> None:
    floater = blob(np.array([[0.0, 0.0, 2.0]]), 0.08, 0.98)
    model = Gaussians.concat([wall(), floater])
    large, limit = ([view.scaled(w, h) for view in cameras()] for w, h in ((1152, 864), (816, 612)))
    figures = (measure_floaters(model, size, HELD_OUT, dataset, OPTIONS) for size in (large, limit))
    assert next(figures) == next(figures)


def test_floater_that_passes_trainings_own_rule_is_still_reported(dataset: Path) -> None:
    """Directly in front of a held-out camera, where no other one looks: training photos do not count there."""
    centre = cameras()[3].centre()
    floater = blob(centre[None] + (0.0, 0.0, 0.5), 0.1, 0.9)
    model = Gaussians.concat([wall(), floater])
    points, tracks = load_points_and_tracks(dataset)
    trained = cameras()[:3]
    space = free_space(trained, points.xyz, [tracks[camera.name] for camera in trained])
    assert space.known and not near_or_free(model, space, views=1).any()
    clean, veiled = (measure_floaters(m, cameras(), HELD_OUT, dataset, OPTIONS)["veil"] for m in (wall(), model))
    assert clean["mean"] == 0.0 and clean["points"] > 500
    assert veiled["mean"] > MAX_VEIL_SHARE and (veiled["worst_photo"], veiled["photos"]) == ("photo_3.png", 1)
    seen = measure_floaters(model, cameras(), {"photo_0.png"}, dataset, OPTIONS)["veil"]
    assert seen["mean"] == 0.0  # it covers nothing that this one sees


def test_light_absorbed_by_a_veil_is_that_of_its_gaussian(dataset: Path) -> None:
    """Haze that more than half of the light passes in every pixel, so no depth map shows it."""
    camera, sigma_px = cameras()[1], 0.6 * 130.0 / 2.0
    veil = blob(camera.centre()[None] + (0.0, 0.0, 2.0), 0.6, 0.3)
    xyz = np.array([[x, y, WALL] for x in (-0.8, 0.1, 1.3) for y in (-0.6, 0.4)])
    stopped = blocked_shares(Gaussians.concat([wall(), veil]), camera, xyz, OPTIONS)
    pixels = np.floor(camera.project(xyz)) + 0.5
    squares = ((pixels - [72.0, 54.0]) ** 2).sum(axis=1) / (sigma_px**2 + 0.3)
    np.testing.assert_allclose(stopped, 0.3 * np.exp(-0.5 * squares), rtol=1e-4)
    beside = blob(camera.centre()[None] + (0.0, 0.0, 0.95 * WALL), 0.6, 0.3)
    assert not blocked_shares(Gaussians.concat([wall(), beside]), camera, xyz, OPTIONS).any()  # is the surface itself


def test_veil_excludes_what_is_nearer_than_the_near_plane(dataset: Path) -> None:
    """Half a unit from a held-out camera: a near plane beyond it hides it from every image, and from training."""
    floater = blob(cameras()[3].centre()[None] + (0.0, 0.0, 0.5), 0.1, 0.98)
    model = Gaussians.concat([wall(), floater])
    near, far = (
        measure_floaters(model, cameras(), HELD_OUT, dataset, replace(OPTIONS, near=plane))["veil"]
        for plane in (0.01, 1.0)
    )
    assert near["worst"] > MAX_VEIL_SHARE
    assert far["worst"] == 0.0 and far["points"] == near["points"]


def test_if_no_photo_is_held_out_training_photos_are_used(dataset: Path) -> None:
    floater = blob(cameras()[3].centre()[None] + (0.0, 0.0, 0.5), 0.1, 0.98)
    model = Gaussians.concat([wall(), floater])
    of_one, of_all = (measure_floaters(model, cameras(), names, dataset, OPTIONS)["veil"] for names in (HELD_OUT, ()))
    assert (of_one["held_out"], of_all["held_out"], of_all["photos"]) == (True, False, 4)
    assert (of_all["worst"], of_all["worst_photo"]) == (of_one["worst"], "photo_3.png")
    assert (
        of_one["mean"] / 4 <= of_all["mean"] < of_one["mean"] / 2
    )  # it is in front of one of four, and at another's edge
