"""Seams: a seamless splat raises no alarm, and planted seams are found and classified."""

from dataclasses import replace

import building_site
import numpy as np
import pytest
import torch
from block_borders import PlanLine
from planted_seams import STRIP, colour_step, doubled, gap
from seam_detector import KINDS, SEAM_LIMITS, Seam, border_cameras, find_seams

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.splat.model.gaussians import Gaussians

PLAN = GroundPlan.across(np.array([0.0, 0.0, 1.0]))


BORDERS = (PlanLine((22.1, 1.0), (22.1, 23.0)), PlanLine((2.0, 11.3), (46.0, 11.3)))  # over grass; across both houses


PIXEL = building_site.HEIGHT / (2.0 * building_site.FOCAL)  # size of a pixel of the cameras below, metres


@pytest.fixture(scope="module")
def splat() -> Gaussians:
    return building_site.model(building_site.surface())


@pytest.fixture(scope="module")
def coarse(splat: Gaussians) -> Gaussians:
    """Return the scene as from another training: positions, sizes and colours differ slightly everywhere."""
    generator = torch.Generator().manual_seed(6)
    noise = torch.randn(len(splat), 7, generator=generator)
    return replace(
        splat,
        means=splat.means + 0.03 * noise[:, :3],
        log_scales=splat.log_scales + 0.15 * noise[:, 3:4],
        sh=splat.sh + 0.1 * noise[:, None, 4:],
    )


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    width, height = building_site.PHOTO
    return [camera.scaled(2 * width, 2 * height) for camera in building_site.flight()]


def found(splat: Gaussians, coarse: Gaussians, line: PlanLine, cameras: list[Camera]) -> dict[str, Seam]:
    seams = find_seams((splat, coarse), PLAN, line, cameras, building_site.OPTIONS)
    assert len({seam.kind for seam in seams}) == len(seams)
    return {seam.kind: seam for seam in seams}


def test_border_is_at_the_middle_of_its_images(splat: Gaussians, cameras: list[Camera]) -> None:
    line = BORDERS[1]
    over, height = border_cameras(splat, PLAN, line, cameras, building_site.OPTIONS)
    assert len(over) >= 6 and 0.6 * building_site.HEIGHT < height <= building_site.HEIGHT + 1.0
    heights = np.linspace(0.0, 6.0, 30)
    on_border = PLAN.points(np.array([line.place(along) for along in np.linspace(0.0, line.length, 30)]), heights)
    seen = 0
    for camera in over:
        _, pixels, _ = camera.in_view(on_border)
        seen += len(pixels)
        assert np.allclose(pixels[:, 0], camera.width / 2, atol=1e-6)  # at any depth
    assert seen > 60


@pytest.mark.parametrize("border", [0, 1])
def test_no_alarm_without_a_seam(splat: Gaussians, coarse: Gaussians, cameras: list[Camera], border: int) -> None:
    assert found(splat, coarse, BORDERS[border], cameras) == {}


def test_gap_is_found(splat: Gaussians, coarse: Gaussians, cameras: list[Camera]) -> None:
    torn = gap(splat, PLAN, BORDERS[0], 10.0 * PIXEL)
    assert "gap" in found(torn, coarse, BORDERS[0], cameras)
    assert found(torn, coarse, BORDERS[1], cameras) == {}  # which crosses it: there it is a single place


def test_doubled_surface_is_found(splat: Gaussians, coarse: Gaussians, cameras: list[Camera]) -> None:
    assert "doubled" in found(doubled(splat, PLAN, BORDERS[1], 6.0 * PIXEL, STRIP * PIXEL), coarse, BORDERS[1], cameras)


def test_step_of_colour_is_found_and_how_large(splat: Gaussians, coarse: Gaussians, cameras: list[Camera]) -> None:
    seams = found(colour_step(splat, PLAN, BORDERS[1], 0.05), coarse, BORDERS[1], cameras)
    assert set(seams) == {"colour"}
    response = seams["colour"].response
    assert response.measure == "step" and abs(response.size / np.sqrt(3.0) - 0.05) < 0.02
    assert response.score > 2.0 * SEAM_LIMITS["step"][0]


def test_a_seam_on_part_of_a_border_is_located(splat: Gaussians, coarse: Gaussians, cameras: list[Camera]) -> None:
    line = BORDERS[1]
    part = PlanLine(tuple(line.place(20.0)), tuple(line.place(30.0)))
    seams = found(colour_step(splat, PLAN, part, 0.15), coarse, line, cameras)
    assert seams["colour"].response.piece >= 0
    assert max(seams["colour"].start, 20.0) < min(seams["colour"].end, 30.0)  # a piece that has some of it


def test_border_through_empty_space_has_no_seam(splat: Gaussians, coarse: Gaussians, cameras: list[Camera]) -> None:
    assert found(splat, coarse, PlanLine((300.0, 0.0), (300.0, 20.0)), cameras) == {}
    assert set(KINDS) == set(SEAM_LIMITS)
