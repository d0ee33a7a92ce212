"""Films of a real run, played by a browser."""

from pathlib import Path

import numpy as np
import pytest
from decoded import decoded, psnr
from film_commands import SECONDS, rendered
from playwright.sync_api import Browser

from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.film.camera_path import cameras_along
from splatpipe.pipeline.film.filming import open_scene
from splatpipe.pipeline.film.photo_route import photo_film
from splatpipe.pipeline.raster.device import cpu
from splatpipe.pipeline.render.rendering import render_pixels
from splatpipe.stages.line import EXPORT, LINE


@pytest.fixture(scope="module")
def parts(demo_run: Path) -> dict[str, Path]:
    return {name: part.path for name, part in open_run_folder(demo_run, LINE).lineage(EXPORT).items()}


def test_every_run_makes_a_film_that_a_browser_plays(demo_run: Path, parts: dict[str, Path], browser: Browser) -> None:
    film = demo_run / "flythrough.webm"
    summary, pictures = decoded(browser, film, [0.5 / 25, SECONDS / 2 + 0.5 / 25, SECONDS - 0.5 / 25])
    assert summary["duration"] == pytest.approx(SECONDS, abs=0.01)
    scene = open_scene(parts, 1, cpu())
    lens = scene.lens(None)
    assert (summary["width"], summary["height"]) == (lens.width, lens.height)
    assert lens.width / lens.height == pytest.approx(16 / 9, abs=0.02)
    pixels = np.median([camera.width * camera.height for camera in scene.cameras])
    assert lens.width * lens.height == pytest.approx(pixels, rel=0.02)
    route = photo_film(scene.capture, round(25 * SECONDS), SECONDS)
    cameras = cameras_along(route, lens, scene.capture.up)
    for picture, number in zip(pictures, (0, round(12.5 * SECONDS), -1), strict=True):
        assert psnr(picture, render_pixels(scene.model, cameras[number], scene.options)) > 30.0


@pytest.mark.parametrize("what", ["colour", "depth", "normals"])
def test_films_along_keyframes_have_their_length_and_size(
    what: str, demo_run: Path, tmp_path: Path, browser: Browser
) -> None:
    path = tmp_path / "round the house.csv"
    path.write_text("time,x,y,z,target_x,target_y,target_z\n0,30,0,15,0,0,3\n1,0,30,20,0,0,3\n1.5,-30,0,15,0,0,3\n")
    out = tmp_path / "films" / "film.webm"
    summary = rendered(demo_run, "--path", path, "--what", what, "--size", "160x90", "--fps", 8, "-o", out)
    assert summary["pictures"] == 12
    seen, pictures = decoded(browser, out, [0.05, 1.4])
    assert (seen["width"], seen["height"]) == (160, 90) and seen["duration"] == pytest.approx(1.5, abs=0.01)
    assert psnr(*pictures) < 25.0 and all(np.std(picture) > 10.0 for picture in pictures)
