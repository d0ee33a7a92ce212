"""The sky as a dome of Gaussians: it shows the panorama without holes, and its contents stay visible."""

from dataclasses import replace

import numpy as np
import pytest
import skies
import torch

from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.dome import SPACING_RAD, dome_directions, dome_radius, sky_dome
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS, Panorama
from splatpipe.pipeline.splat.sky.sky_mask import directions, elevations_deg

TILTED = np.array([0.36, -0.48, 0.8])
CAMERAS = np.array([[3.0, 0.0, 2.0], [5.0, 0.0, 2.0], [4.0, 1.0, 2.0]])


def coloured_panorama(up: np.ndarray) -> Panorama:
    """Red rises with the elevation, green goes once around."""
    row, column = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    colours = np.stack([row / ROWS, 0.5 + 0.4 * np.sin(2.0 * np.pi * column / COLUMNS), np.full(len(row), 0.6)], axis=1)
    return Panorama(up, torch.from_numpy(colours.astype(np.float32)))


def scene_around(centre: np.ndarray, reach: float) -> Gaussians:
    scene = Gaussians.empty(1000, sh_degree=0)
    offset = torch.randn(1000, 3, generator=torch.Generator().manual_seed(1))
    offset = reach * offset / torch.linalg.vector_norm(offset, dim=1, keepdim=True)
    scene.means = torch.from_numpy(centre).float() + offset
    scene.means[0] = 1e6  # a distant outlier
    return scene


def test_lattice_is_even_and_ends_with_the_panorama() -> None:
    rays = dome_directions(TILTED)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    assert -2.0 < np.degrees(np.arcsin((rays @ TILTED).min())) < -1.9
    some = rays[:: len(rays) // 200]
    nearest = np.sort(np.linalg.norm(some[:, None] - rays[None], axis=2), axis=1)[:, 1]
    assert nearest.min() > 0.6 * SPACING_RAD and nearest.max() < 1.3 * SPACING_RAD


@pytest.mark.parametrize("up", [skies.UP, TILTED], ids=["level", "tilted"])
@pytest.mark.parametrize("x", [4.0, 5.0], ids=["middle", "last camera"])
def test_dome_shows_the_panorama_without_holes(up: np.ndarray, x: float) -> None:
    panorama = coloured_panorama(up)
    dome = sky_dome(panorama, scene_around(CAMERAS.mean(axis=0), 6.0), CAMERAS)
    for heading, pitch in ((0.0, 10.0), (130.0, 35.0), (250.0, 80.0)):
        camera = skies.camera_towards(heading, pitch, x=x)
        rendered = rasterizer.render(dome, camera, rasterizer.RenderOptions(0))
        above = torch.from_numpy(elevations_deg(camera, up) > (0.0 if x == 4.0 else 6.0))
        assert float(rendered.alpha[above].min()) > 0.98
        error = (rendered.colour - panorama.at(directions(camera))).abs()[above]
        assert float(error.mean()) < (0.01 if x == 4.0 else 0.03)


def test_dome_surrounds_the_scene_despite_distant_outliers() -> None:
    centre = CAMERAS.mean(axis=0)
    assert dome_radius(scene_around(centre, 50.0), CAMERAS, centre) == pytest.approx(100.0, rel=0.02)
    small = scene_around(centre, 0.1)
    spread = float(np.linalg.norm(CAMERAS - centre, axis=1).max())
    assert dome_radius(small, CAMERAS, centre) == pytest.approx(10.0 * spread)
    assert dome_radius(Gaussians.empty(0, sh_degree=0), CAMERAS[:1], CAMERAS[0]) == 1.0


def test_gaussians_of_the_scene_stay_visible() -> None:
    camera = skies.camera_towards(0.0, 30.0, x=4.0)
    ray = directions(camera)[skies.HEIGHT // 2, skies.WIDTH // 2]
    scene = scene_around(CAMERAS.mean(axis=0), 50.0)
    scene.means[7] = torch.from_numpy(camera.centre() + 50.0 * ray / np.linalg.norm(ray)).float()
    dome = sky_dome(coloured_panorama(skies.UP), scene, CAMERAS)
    before = scene.select(torch.tensor([7]))
    before = replace(before, opacity_logits=torch.full((1,), 6.0), sh=torch.full((1, 1, 3), -1.7))
    both = rasterizer.render(Gaussians.concat([dome, before]), camera, rasterizer.RenderOptions(0)).colour
    assert float(both[skies.HEIGHT // 2, skies.WIDTH // 2].max()) < 0.05
