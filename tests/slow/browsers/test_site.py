"""The viewer as a folder for web hosts, in a real browser: complete but coarse at first, in full detail in the end."""

import io
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch
from PIL import Image
from playwright.sync_api import Page
from timeouts import wait_until
from web_sites import COUNT, MAX_PER_NODE, UP_FROM_DOWN, nodes_of

from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.render.rendering import render_pixels
from splatpipe.pipeline.splat.levels.levels import LevelNode, build_levels
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts
from splatpipe.pipeline.survey.crs.frames import Frame, Similarity
from splatpipe.pipeline.web.measured_page import with_measurements
from splatpipe.pipeline.web.site import write_site
from splatpipe.pipeline.web.viewer import ViewerScene
from splatpipe.pipeline.web.viewer_scene import ViewerRendering, viewer_scene, write_viewer

LIKE_OURS_DB = 25.0


LIKE_THE_PAGE_DB = 40.0


COARSE_DB = 14.0


WIDTH, HEIGHT = 640, 400


class Host(ThreadingHTTPServer):
    """A static host of a folder, which may hold files back, or lose them."""

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        self.address = f"http://127.0.0.1:{self.server_port}"
        self.asked: Counter[str] = Counter()
        self.held: set[str] = set()
        self.missing: set[str] = set()
        self.given = threading.Event()
        self.given.set()


class Handler(SimpleHTTPRequestHandler):
    server: Host

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        name = self.path.split("?")[0].lstrip("/")
        self.server.asked[name] += 1
        if name in self.server.held:
            self.server.given.wait(60.0)
        if name in self.server.missing:
            self.send_error(404)
        else:
            super().do_GET()


@contextmanager
def hosted(folder: Path) -> Iterator[Host]:
    host = Host(folder)
    threading.Thread(target=host.serve_forever, daemon=True).start()
    try:
        yield host
    finally:
        host.given.set()
        host.shutdown()
        host.server_close()


@pytest.fixture(scope="module")
def model() -> Gaussians:
    """Return the model in the world frame."""
    many = tiny_scene.true_model(COUNT)
    many.log_scales -= 0.9
    return many.transformed(1.0, torch.from_numpy(UP_FROM_DOWN), torch.zeros(3, dtype=torch.float64))


@pytest.fixture(scope="module")
def root(model: Gaussians) -> LevelNode:
    return build_levels(model, MAX_PER_NODE)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> ViewerScene:
    dataset = tiny_scene.write_dataset(tmp_path_factory.mktemp("tiny") / "dataset")
    frame = Frame("arbitrary", Similarity(1.0, UP_FROM_DOWN, np.zeros(3)))
    rendering = ViewerRendering(antialias=False, background=(0.0, 0.0, 0.0), near=0.01)
    return viewer_scene(dataset, frame, rendering, (), COUNT, "Tiny </title> site")


@pytest.fixture(scope="module")
def site(scene: ViewerScene, model: Gaussians, root: LevelNode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, and the page next to it."""
    folder = tmp_path_factory.mktemp("site")
    write_site(folder / "web", scene, Scene(model, SceneFacts("z up")), root)
    write_viewer(folder, scene, model, largest_bytes=1e9)
    return folder


def replaced(site: Path, folder: Path, name: str, content: bytes) -> None:
    """Copy the site elsewhere, with one file's content replaced."""
    for file in (site / "web").iterdir():
        if file.name != name:
            (folder / file.name).symlink_to(file)
    (folder / name).write_bytes(content)


def picture(page: Page) -> np.ndarray:
    """Return a screenshot of the page."""
    page.evaluate("() => splatpipe.showInterface(false)")
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10.0 * np.log10(255.0**2 / max(np.mean((a.astype(float) - b.astype(float)) ** 2), 1e-9)))


def test_it_is_complete_at_once_and_becomes_the_full_model(site: Path, scene: ViewerScene, open_page: Callable) -> None:
    nodes = nodes_of(site)
    page = open_page((site / "viewer.html").as_uri(), WIDTH, HEIGHT).page
    page.evaluate("() => splatpipe.complete()")
    full, middle = picture(page), (WIDTH / 2, HEIGHT / 2)
    point = page.evaluate("([x, y]) => splatpipe.pick(x, y)", middle)
    with hosted(site / "web") as host:
        host.held = {node["file"] for node in nodes[1:]}
        host.given.clear()
        watched = open_page(f"{host.address}/index.html", WIDTH, HEIGHT)
        page = watched.page
        page.evaluate("() => splatpipe.ready")
        assert page.evaluate("() => splatpipe.shown()") == {"gaussians": MAX_PER_NODE, "files": [nodes[0]["file"]]}
        first = psnr(picture(page), full)
        assert first >= COARSE_DB
        assert page.evaluate("([x, y]) => splatpipe.pick(x, y)", middle)
        host.given.set()
        page.evaluate("() => void splatpipe.complete().then(() => (window.itIsDone = true))")
        while not page.evaluate("() => window.itIsDone"):
            assert psnr(picture(page), full) >= first - 1.0
        assert page.evaluate("() => splatpipe.shown().gaussians") == COUNT
        assert psnr(picture(page), full) >= LIKE_THE_PAGE_DB
        np.testing.assert_allclose(page.evaluate("([x, y]) => splatpipe.pick(x, y)", middle), point, atol=0.01)
        assert page.evaluate("() => splatpipe.measure([0, 0, 0], [3, 4, 12]).distance") == 13.0
        asked = {address for address in watched.requests if not address.startswith(host.address)}
        assert (asked, watched.errors) == (set(), [])
        leaves = {node["file"] for node in nodes if not node["children"]}
        assert all(host.asked[name] == 1 for name in leaves)


def test_the_full_model_is_what_our_rasterizer_renders(site: Path, model: Gaussians, open_page: Callable) -> None:
    camera = tiny_scene.cameras()[4]
    with hosted(site / "web") as host:
        page = open_page(f"{host.address}/index.html", camera.width, camera.height).page
        page.evaluate("() => splatpipe.ready")
        page.evaluate("name => splatpipe.goToCamera(name)", camera.name)
        page.evaluate("() => splatpipe.complete()")
        down = model.transformed(1.0, torch.from_numpy(UP_FROM_DOWN.T.copy()), torch.zeros(3, dtype=torch.float64))
        ours = render_pixels((down, None), camera, rasterizer.RenderOptions(sh_degree=3))
        assert psnr(picture(page), ours) >= LIKE_OURS_DB


def test_nothing_finer_is_requested_from_afar_or_out_of_sight(site: Path, open_page: Callable) -> None:
    with hosted(site / "web") as host:
        host.held = {node["file"] for node in nodes_of(site)[1:]}
        host.given.clear()
        page = open_page(f"{host.address}/index.html", WIDTH, HEIGHT).page
        page.evaluate("() => splatpipe.ready")
        page.evaluate("() => splatpipe.setCamera({position: [0, -4000, 0], target: [0, 0, 0]})")
        page.evaluate("() => splatpipe.complete()")
        assert len(page.evaluate("() => splatpipe.shown().files")) == 1
        page.evaluate("() => splatpipe.setCamera({position: [0, -40, 0], target: [0, -80, 0]})")
        page.evaluate("() => splatpipe.complete()")
        assert len(page.evaluate("() => splatpipe.shown().files")) == 1


def test_no_more_gaussians_are_shown_than_allowed_whatever_was_viewed(site: Path, open_page: Callable) -> None:
    with hosted(site / "web") as host:
        page = open_page(f"{host.address}/index.html", WIDTH, HEIGHT).page
        page.evaluate("() => splatpipe.ready.then(() => splatpipe.complete())")
        assert page.evaluate("() => splatpipe.shown().gaussians") == COUNT
        page.evaluate("() => splatpipe.limit(400)")
        for name in page.evaluate("() => splatpipe.facts.cameras.map(({ name }) => name)"):
            page.evaluate("name => splatpipe.goToCamera(name)", name)
            page.evaluate("() => splatpipe.complete()")
            assert MAX_PER_NODE < page.evaluate("() => splatpipe.shown().gaussians") <= 600


def test_a_missing_file_is_reported_once_and_leaves_no_hole(site: Path, open_page: Callable) -> None:
    leaf = next(node for node in nodes_of(site) if not node["children"])
    with hosted(site / "web") as host:
        host.missing = {leaf["file"]}
        watched = open_page(f"{host.address}/index.html", WIDTH, HEIGHT)
        page = watched.page
        page.evaluate("() => splatpipe.ready.then(() => splatpipe.complete())")
        page_state = page.evaluate("() => splatpipe.shown()")
        assert leaf["file"] not in page_state["files"]
        assert len(page_state["files"]) > 3  # the others came
        assert "is missing (404)" in page.locator("#notice").inner_text()
        assert host.asked[leaf["file"]] == 3
        host.missing = set()
        page.evaluate("() => dispatchEvent(new Event('online'))")
        wait_until(lambda: page.evaluate("() => splatpipe.shown().gaussians") == COUNT)


def test_photos_points_and_measurements_are_as_in_the_page(
    site: Path, scene: ViewerScene, open_page: Callable, tmp_path: Path
) -> None:
    ring = {"x": [0.0, 2.0, 0.0, 0.0], "y": [0.0, 0.0, 2.0, 0.0], "z": [0.1, 0.1, 0.1, 0.1]}
    amounts = {f"{kind}_{figure}": 2.5 for kind in ("cut", "fill", "net") for figure in ("m3", "sigma_m3")}
    volume = {"name": "Heap", "area_m2": 2.0, "base": "rim", "trace": [ring], **amounts}
    measured = with_measurements((site / "web/index.html").read_bytes(), {"sections": [], "volumes": [volume]})
    replaced(site, tmp_path, "index.html", measured)
    with hosted(tmp_path) as host:
        page = open_page(f"{host.address}/index.html", WIDTH, HEIGHT).page
        page.evaluate("() => splatpipe.ready")
        assert page.title() == scene.title
        assert page.locator("#fold").inner_text() == "1 volume"
        wait_until(lambda: bool(page.evaluate("() => document.querySelector('#strip img').naturalWidth")))
        splats = picture(page)
        page.evaluate("() => splatpipe.complete()")
        page.evaluate("() => splatpipe.showPoints(true)")
        page.evaluate("() => splatpipe.complete()")
        assert psnr(picture(page), splats) < 20.0


@pytest.mark.parametrize("text", ['{"format": 1, "nodes": [{', "<html>not found</html>"])
def test_a_damaged_tree_is_reported(site: Path, tmp_path: Path, open_page: Callable, text: str) -> None:
    replaced(site, tmp_path, "levels.json", text.encode())
    with hosted(tmp_path) as host:
        page = open_page(f"{host.address}/index.html", WIDTH, HEIGHT).page
        page.locator("#loading.failed").wait_for()
        assert page.locator("#message").inner_text() == "levels.json is damaged."


def test_opened_from_disk_it_says_what_to_do(site: Path, open_page: Callable) -> None:
    page = open_page((site / "web/index.html").as_uri(), WIDTH, HEIGHT).page
    page.locator("#loading.failed").wait_for()
    assert "do not allow for a page opened from disk" in page.locator("#message").inner_text()
    assert "web host" in page.locator("#advice").inner_text()
