"""Measure how soon a large model's `viewer.html` shows it and then responds, in a browser with software rendering.

The model is a run's, with each Gaussian replaced by several smaller ones within it, so depth complexity, opacities and
colours are those of a trained model.

    python benchmarks viewer_page OUT
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from opened_run import OpenedRun, open_run
from playwright.sync_api import Page, sync_playwright

from splatpipe.pipeline.delivery.delivery_frame import in_world
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.web.viewer_scene import viewer_rendering, viewer_scene, write_viewer

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SPREAD = 0.9  # times the parent's standard deviations: spread of its parts
SHRINK = 0.5  # times the parent's size
QUESTIONS = 200
BETWEEN_S = 0.05


def main() -> None:
    """Print sizes, the time to the first complete frame, and response times at rest and in motion."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="OUT of a finished run")
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--size", default="640x400")
    options = parser.parse_args()
    width, height = (int(side) for side in options.size.split("x"))
    with tempfile.TemporaryDirectory() as folder:
        write_page(open_run(options.out), options.gaussians, Path(folder))
        for file in sorted(Path(folder).iterdir()):
            print(f"{file.name}: {file.stat().st_size / 1e6:.1f} MB")
        with sync_playwright() as playwright:
            path = shutil.which("chromium") or shutil.which("google-chrome")
            browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
            measure(browser.new_page(viewport={"width": width, "height": height}), Path(folder) / "viewer.html")
            browser.close()


def write_page(run: OpenedRun, count: int, folder: Path) -> None:
    """Write a page that embeds a model with that many Gaussians."""
    gaussians, sky = run.model
    frame = load_frame(run.parts["georef.frame"].path)
    rendering = viewer_rendering(run.options, sky)
    scene = viewer_scene(
        run.parts["undistort.dataset"].path, frame, rendering, run.held_out, count, f"{count:,} Gaussians"
    )
    write_viewer(folder, scene, in_world(multiplied(gaussians, count), frame), largest_bytes=1e9)


def multiplied(gaussians: Gaussians, count: int) -> Gaussians:
    """Return ``count`` Gaussians, each a smaller part of a given one."""
    generator = torch.Generator().manual_seed(0)
    many = gaussians.select(torch.randint(len(gaussians), (count,), generator=generator))
    quats = many.quats / torch.linalg.vector_norm(many.quats, dim=1, keepdim=True)
    w, xyz = quats[:, :1], quats[:, 1:]
    offset = SPREAD * torch.exp(many.log_scales) * torch.randn(count, 3, generator=generator)
    cross = 2.0 * torch.linalg.cross(xyz, offset)  # v + 2 w (q × v) + 2 q × (q × v): v rotated by the quaternion
    many.means = many.means + offset + w * cross + torch.linalg.cross(xyz, cross)
    many.log_scales = many.log_scales + float(np.log(SHRINK))
    return many


def measure(page: Page, path: Path) -> None:
    """Open the page and print its times."""
    page.set_default_timeout(180_000)
    began = time.perf_counter()
    page.goto(path.as_uri())
    page.evaluate("() => splatpipe.ready")
    print(f"first complete frame: {time.perf_counter() - began:.1f} s")
    measure_responses("answers at rest", page, lambda _: page.evaluate("() => splatpipe.cameraState()"))
    page.evaluate("() => splatpipe.pick(1, 1)")
    measure_responses("points under the cursor", page, lambda i: page.evaluate("i => splatpipe.pick(100 + i, 200)", i))
    position = page.evaluate("() => splatpipe.cameraState().position")
    target = page.evaluate("() => splatpipe.facts.centre")

    def move(i: int) -> None:
        moved = {"position": [position[0] + 0.02 * i, *position[1:]], "target": target}
        page.evaluate("to => { splatpipe.setCamera(to); return splatpipe.cameraState(); }", moved)

    measure_responses("answers while moving", page, move)
    began = time.perf_counter()
    page.evaluate("() => splatpipe.complete()")
    print(f"complete frame after the last movement: {time.perf_counter() - began:.1f} s")


def measure_responses(what: str, page: Page, ask: Callable[[int], object]) -> None:
    """Send many requests, with pauses, and print the response times."""
    times = []
    for i in range(QUESTIONS):
        began = time.perf_counter()
        ask(i)
        times.append(1e3 * (time.perf_counter() - began))
        page.wait_for_timeout(1e3 * BETWEEN_S)
    median, late = np.quantile(times, [0.5, 0.95])
    print(f"{what}: median {median:.0f} ms, 95th percentile {late:.0f} ms, longest {max(times):.0f} ms")


if __name__ == "__main__":
    main()
