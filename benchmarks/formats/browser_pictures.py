"""Render splat files with spark in a headless browser."""

from __future__ import annotations

import base64
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from captures import Picture
from others import READERS, OtherPrograms
from playwright.sync_api import Page, sync_playwright

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.model.scene import Axes, turn_of

TIMEOUT_MS = 600_000.0  # for a busy machine
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PAGE = '<!doctype html><meta charset="utf-8"><script src="draw.js"></script>'
SPARK_TYPES = {"ply": "ply", "compressed-ply": "ply", "spz": "spz", "spz2": "spz", "sog": "pcsogszip", "glb": "glb"}


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        """Log nothing."""


@contextmanager
def drawing_page(others: OtherPrograms, folder: Path) -> Iterator[Page]:
    """Serve a page that renders the files of a folder, with its script injected.

    Raises:
        MachineError: if there is no browser, or the script cannot be bundled.
    """
    ended = others.run(READERS / "bundle.mjs", (folder / "draw.js").resolve())
    if ended.code:
        raise MachineError(f"esbuild: {ended.said[-300:]}")
    (folder / "draw.html").write_text(PAGE, encoding="utf-8")
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        raise MachineError("There is no browser.", hint="apt install chromium")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        page = browser.new_page()
        page.set_default_timeout(TIMEOUT_MS)
        page.goto(f"http://127.0.0.1:{server.server_port}/draw.html")
        yield page
        browser.close()
    server.shutdown()


def draw(page: Page, address: str, kind: str, axes: Axes, camera: Camera, antialias: bool) -> tuple[int, Picture]:
    """Return the number of splats that spark read from a file, and its render on black, 0..1.

    Args:
        page: Page from ``drawing_page``.
        address: The file, relative to the page's folder.
        kind: The format's name.
        axes: The file's axes.
        camera: Camera in a z-up world, with its principal point at the image centre.
        antialias: Whether opacities compensate for the screen-space blur.
    """
    cam_from_file = camera.cam_from_world.copy()
    cam_from_file[:3, :3] = cam_from_file[:3, :3] @ turn_of("z up", axes).numpy()
    asked = {"url": address, "type": SPARK_TYPES[kind], "width": camera.width, "height": camera.height}
    asked |= {"focal": [camera.fx, camera.fy], "camFromFile": cam_from_file.ravel().tolist(), "antialias": antialias}
    found = page.evaluate("asked => window.draw(asked)", asked)
    data = np.frombuffer(base64.b64decode(found["png"].partition(",")[2]), np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert pixels is not None
    return int(found["splats"]), pixels[:, :, ::-1].astype(np.float64) / 255.0
