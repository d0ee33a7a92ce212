"""Videos, decoded by a browser."""

from pathlib import Path

import pytest
from decoded import decoded, psnr
from playwright.sync_api import Browser
from videos import HEIGHT, WIDTH, frames, write


@pytest.mark.parametrize("suffix", [".webm", ".mp4"])
def test_a_browser_plays_a_film_of_the_requested_length_size_and_contents(
    suffix: str, tmp_path: Path, browser: Browser
) -> None:
    film = write(tmp_path / f"a film{suffix}", 20, 10)
    video, pictures = decoded(browser, film, [0.05, 0.95, 1.95])
    assert (video["width"], video["height"]) == (WIDTH, HEIGHT)
    assert video["duration"] == pytest.approx(2.0, abs=0.01)
    truth = list(frames(20))
    for picture, number in zip(pictures, (0, 9, 19), strict=True):
        assert psnr(picture, truth[number]) > 30.0
        assert psnr(picture, truth[number - 1]) < psnr(picture, truth[number]) - 3.0
