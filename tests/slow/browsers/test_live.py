"""The live page in a real browser while a real training runs."""

import io
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finished_run import linked_copy
from PIL import Image
from playwright.sync_api import Page
from served import Served, serving
from timeouts import TIMEOUT_S, wait_until

from splatpipe.demo import capture_path


@pytest.fixture
def training(demo_run: Path, tmp_path: Path) -> Iterator[tuple[Path, subprocess.Popen[bytes]]]:
    """The demo, trained again and for longer; the stages before training are reused."""
    out = linked_copy(demo_run, tmp_path / "out")
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "run", str(capture_path()), str(out)]
    command += ["--threads", "1", "--config", str(demo_run / "config.toml"), "--set", "train.iterations=20000"]
    nothing = subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=nothing, stderr=nothing, start_new_session=True)
    yield out, process
    hold(process, signal.SIGCONT)
    process.send_signal(signal.SIGTERM)
    process.wait(timeout=TIMEOUT_S)


def hold(process: subprocess.Popen[bytes], how: signal.Signals = signal.SIGSTOP) -> None:
    """Suspend a run with all its processes, or resume it: what is seen meanwhile is of exactly that moment."""
    if process.poll() is None:
        os.killpg(process.pid, how)


def wait(page: Page, until: Callable[[Any], bool]) -> Any:
    """The page's state, as soon as it is as expected."""

    def state() -> Any:
        page_state = page.evaluate("splatpipe.live.state()")
        return page_state if page_state is not None and until(page_state) else None

    return wait_until(state, "what the page is to say")


def wait_for_losses(out: Path) -> None:
    """Until the training has begun; its first checkpoint comes 20 seconds later."""
    log = out / "events.jsonl"
    before = len(log.read_bytes())  # written by the run that it was copied from
    wait_until(lambda: b'"loss"' in log.read_bytes()[before:], "the training")


def displayed_image(page: Page, name: str) -> np.ndarray:
    """Return the image that the page shows, as received."""
    page.locator(f"#{name}:not([hidden])").wait_for()
    address = page.evaluate(f"document.getElementById('{name}').src")
    answer = page.request.get(address)
    with Image.open(io.BytesIO(answer.body())) as picture:
        return np.asarray(picture.convert("RGB"), np.float64)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return 10.0 * math.log10(255.0**2 / float(((a - b) ** 2).mean()))


def test_the_page_follows_a_training_from_its_start_to_its_stop(
    training: tuple[Path, subprocess.Popen[bytes]], open_page: Callable
) -> None:
    out, process = training
    wait_for_losses(out)
    hold(process)
    with serving(out) as server:
        assert server.start == "live"
        watched = open_page(server.page(server.start))
        page = watched.page
        state = wait(page, lambda state: state["model"] and len(state["curves"].get("loss", [])) > 0)
        assert state["at_work"] and state["model"]["kind"] == "initial"
        assert [stage["state"] for stage in state["stages"] if stage["name"] in ("ingest", "undistort")] == [
            "reused"
        ] * 2
        first, photo = displayed_image(page, "render"), displayed_image(page, "photo")
        assert first.shape == photo.shape
        hold(process, signal.SIGCONT)
        follow_the_curves(page, len(state["curves"]["loss"]))
        before = page.evaluate("document.getElementById('render').src")
        state = wait(page, lambda state: state["model"]["kind"] == "checkpoint" and state["model"]["iteration"] > 200)
        wait_for_picture(page, "(before) => document.getElementById('render').src !== before", before)
        assert page.locator("#iteration").inner_text().startswith("iteration ")
        assert psnr(displayed_image(page, "render"), photo) > psnr(first, photo) + 3.0
        choose(page, 12)
        far = displayed_image(page, "photo")
        assert far.shape == photo.shape
        choose(page, 1)  # its number is a prefix of the other's
        page.keyboard.press("ArrowRight")
        wait_for_picture(page, SHOWS, 2)
        assert not np.array_equal(displayed_image(page, "photo"), far)
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=TIMEOUT_S)
        wait(page, lambda state: not state["at_work"])
        page.locator("#state.failed").wait_for()
        assert "train" in page.locator("#state").inner_text()
        assert watched.errors == []
        assert all(url.startswith(server.address) for url in watched.requests)


SHOWS = "(number) => document.getElementById('photo').src.endsWith(`/${number}/photo.jpg`)"


def choose(page: Page, number: int) -> None:
    """Choose a photo by its number, and wait until it is shown."""
    page.locator("#view").select_option(index=number)
    wait_for_picture(page, SHOWS, number)
    page.locator("#view").blur()  # keys are the page's again


def wait_for_picture(page: Page, shows: str, what: object) -> None:
    """Wait until the page shows it: rendering is slow on a busy machine."""
    page.wait_for_function(shows, arg=what, timeout=1000.0 * TIMEOUT_S)


def follow_the_curves(page: Page, points: int) -> None:
    """The curves grow, on the page and in its data, and the remaining time is shown."""
    for _ in range(2):
        state = wait(page, lambda state, points=points: len(state["curves"]["loss"]) > points)
        points = len(state["curves"]["loss"])
        assert state["curves"]["gaussians"][-1][1] > 100
    assert page.locator("#loss canvas").count() == 1 and page.locator("#gaussians canvas").count() == 1
    page.get_by_text("left in train").wait_for()
    done = float(page.locator("#progress").get_attribute("aria-valuenow") or -1)
    assert 0.0 <= done < 100.0 and "iterations" in page.locator("#progress span").inner_text()


def test_the_page_says_that_there_is_nothing_yet(tmp_path: Path, open_page: Callable) -> None:
    (tmp_path / "out" / "stages").mkdir(parents=True)
    with serving(tmp_path / "out") as server:
        served: Served = server
        watched = open_page(served.page("live"), 390, 844, True)
        watched.page.get_by_text("the training has not begun").wait_for()
        assert watched.page.evaluate("document.documentElement.scrollWidth") <= 390
        assert watched.errors == []
