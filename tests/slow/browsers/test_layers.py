"""The viewer's switch between splat, mesh and points, in a real browser: the same place, by keys, on a phone."""

import io
import json
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch
from hills import IDENTITY
from made_mesh import made_site, site_height
from PIL import Image
from playwright.sync_api import Page
from web_sites import UP_FROM_DOWN

from splatpipe.pipeline.surface.rasters.grid import make_grid
from splatpipe.pipeline.surface.shapes.point_cloud import CloudChunk, CloudFrame, write_cloud
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.web.measured_page import with_surfaces
from splatpipe.pipeline.web.publication import RunProducts, write_viewer_surfaces
from splatpipe.pipeline.web.viewer_scene import ViewerRendering, viewer_scene, write_viewer

SITE_M = 4.0
WIDTH, HEIGHT = 640, 480
FROM = {"position": [0.5, -4.0, 5.0], "target": [0.0, 0.0, 0.0]}
PLACES_M = np.array([[-1.2, -1.3], [1.3, -1.1], [-1.4, 0.9], [1.1, 1.2]])  # in the middle of charts, beside the block
LOCAL = Frame("arbitrary", IDENTITY, metres=True)
Opened = Callable[..., Page]


@pytest.fixture(scope="module")
def surfaces(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Mesh and points of a made site of four metres, as the stage writes them."""
    folder = tmp_path_factory.mktemp("surfaces")
    random = np.random.default_rng(0)
    plan = random.uniform(-SITE_M / 2.0, SITE_M / 2.0, (40_000, 2))
    positions = np.column_stack([plan, site_height(plan, SITE_M)])
    colours = np.where(plan[:, :1] < 0.0, [[200, 30, 30]], [[30, 30, 200]]).astype(np.uint8)
    chunk = CloudChunk(positions, colours, np.zeros(positions.shape, np.float32), np.ones(len(plan), np.uint8))
    grid = make_grid(LOCAL, np.array([[-3.0, -3.0, -1.0], [3.0, 3.0, 2.0]]), 0.01)
    write_cloud(folder / "cloud.laz", [chunk], CloudFrame.of_grid(grid))
    mesh = made_site(folder / "made", 100, 512, SITE_M)
    products = RunProducts(LOCAL, folder / "cloud.laz", folder / "none", folder / "none", mesh)
    write_viewer_surfaces(products, folder / "surfaces.json", folder / "work", tiny_scene.Recorder())
    return json.loads((folder / "surfaces.json").read_text())


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The page of the tiny scene without mesh and points."""
    folder = tmp_path_factory.mktemp("plain")
    dataset = tiny_scene.write_dataset(folder / "dataset")
    frame = Frame("arbitrary", type(IDENTITY)(1.0, UP_FROM_DOWN, np.zeros(3)))
    model = tiny_scene.true_model()
    scene = viewer_scene(dataset, frame, ViewerRendering(False, (0.0, 0.0, 0.0), 0.01), (), len(model), "Layers")
    turned = model.transformed(1.0, torch.from_numpy(UP_FROM_DOWN), torch.zeros(3, dtype=torch.float64))
    write_viewer(folder, scene, turned, 1e9)
    return (folder / "viewer.html").read_bytes()


@pytest.fixture
def view(open_page: Callable, plain: bytes, surfaces: dict, tmp_path: Path) -> Iterator[Opened]:
    """Open the page with some of the layers; afterwards check that it made no requests and no errors."""
    pages = []

    def opened(*layers: str, width: int = WIDTH, height: int = HEIGHT) -> Page:
        found = json.dumps({"layers": layers, **{layer: surfaces[layer] for layer in layers}}).encode()
        (tmp_path / "viewer.html").write_bytes(with_surfaces(plain, found if layers else None))
        watched = open_page((tmp_path / "viewer.html").as_uri(), width, height, False)
        pages.append(watched)
        watched.page.evaluate("() => splatpipe.ready")
        return watched.page

    yield opened
    for watched in pages:
        assert watched.requests == [] and watched.errors == []


def picture(page: Page) -> np.ndarray:
    page.evaluate("() => { splatpipe.showInterface(false); return splatpipe.complete(); }")
    shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    page.evaluate("() => splatpipe.showInterface(true)")
    return shown


def pressed(page: Page) -> list[str]:
    return page.locator("#layers button[aria-pressed=true]").all_inner_texts()


def expected_pixels(page: Page) -> tuple[np.ndarray, list[tuple[int, int]]]:
    places = np.column_stack([PLACES_M, site_height(PLACES_M, SITE_M)])
    found = page.evaluate("places => places.map((place) => splatpipe.project(place))", places.tolist())
    return places, [(round(place["x"]), round(place["y"])) for place in found]


def test_all_layers_show_the_same_place(view: Opened) -> None:
    page = view("mesh", "points")
    page.evaluate("from => splatpipe.setCamera(from)", FROM)
    before, splats = page.evaluate("() => splatpipe.cameraState()"), picture(page)
    places, pixels = expected_pixels(page)
    for layer, tolerance_m in (("mesh", 0.03), ("points", 0.15)):
        assert page.evaluate("layer => splatpipe.show(layer)", layer) is True
        shown = picture(page)
        assert np.abs(shown.astype(float) - splats).mean() > 10.0
        assert page.evaluate("() => splatpipe.cameraState()") == before and pressed(page) == [layer.capitalize()]
        for place, (x, y) in zip(places, pixels, strict=True):
            met = page.evaluate("([x, y]) => splatpipe.pick(x, y)", [x, y])
            assert np.linalg.norm(np.array(met) - place) < tolerance_m
    colours = np.array([shown[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).mean(axis=0) for x, y in pixels])
    assert np.array_equal(colours[:, 0] > colours[:, 2], PLACES_M[:, 0] < 0.0), colours  # they tell west from east
    assert page.evaluate("() => splatpipe.show('splat')") is True
    assert np.abs(picture(page).astype(float) - splats).mean() < 1.0


def test_the_meshs_texture_is_where_it_was_made(view: Opened) -> None:
    page = view("mesh")
    page.evaluate("() => splatpipe.setCamera({position: [0, 0, 6], yaw: Math.PI / 2, pitch: -Math.PI / 2 + 0.001})")
    page.evaluate("() => splatpipe.show('mesh')")
    shown = picture(page).astype(float)
    means = []
    for chart in range(4):  # two by two, from the south-west; colours as in made_mesh
        middle = (np.array([chart % 2, chart // 2]) - 0.5) * SITE_M / 2.0 * 1.5
        at = page.evaluate("([x, y]) => splatpipe.project([x, y, 0])", middle.tolist())
        x, y = round(at["x"]), round(at["y"])
        means.append(shown[y - 6 : y + 7, x - 6 : x + 7].reshape(-1, 3).mean(axis=0))
    made = [(0.75 * (np.array([k * 53, k * 97, k * 151]) % 160 + 60) + 10.0)[::-1] for k in range(4)]
    assert np.abs(np.array(means) - made).max() < 35.0
    for k, mean in enumerate(means):
        assert np.argmin([np.abs(mean - other).sum() for other in made]) == k


def test_keys_choose_and_buttons_are_reached_by_tab(view: Opened) -> None:
    page = view("mesh", "points")
    assert pressed(page) == ["Splat"]
    for key, name in (("2", "Mesh"), ("3", "Points"), ("1", "Splat")):
        page.keyboard.press(key)
        page.wait_for_function(
            "name => document.querySelector('#layers [aria-pressed=true]')?.innerText === name", arg=name
        )
    page.locator("#splat_layer").focus()
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_function("() => document.querySelector('#mesh_layer').getAttribute('aria-pressed') === 'true'")
    page.keyboard.press("p")  # the sparse points hide it, and give it back
    assert pressed(page) == []
    page.keyboard.press("p")
    assert pressed(page) == ["Mesh"]


def test_only_what_the_run_made_can_be_chosen(view: Opened) -> None:
    page = view()
    assert not page.locator("#layers").is_visible()
    assert page.evaluate("() => splatpipe.show('mesh')") is False
    page.keyboard.press("2")
    assert page.evaluate("() => splatpipe.complete().then(() => splatpipe.shown().gaussians)") > 0
    page = view("points")
    assert page.locator("#layers button:visible").all_inner_texts() == ["Splat", "Points"]


def test_on_a_phone_the_switch_leaves_the_tools_free(view: Opened) -> None:
    page = view("mesh", "points", width=390, height=844)
    switch, about, tools = (page.locator(name).bounding_box() for name in ("#layers", "#about", "#tools"))
    assert switch and about and tools
    assert switch["x"] + switch["width"] < tools["x"] and about["y"] + about["height"] < switch["y"]
    buttons = [box.bounding_box() for box in page.locator("#layers button").all()]
    assert all(box and box["height"] >= 40 for box in buttons)


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


def test_a_file_beside_the_page_is_loaded_when_it_is_first_shown(
    open_page: Callable, plain: bytes, surfaces: dict, tmp_path: Path
) -> None:
    found = json.dumps({"layers": ["mesh", "points"], "address": "surfaces.json?v=1"}).encode()
    (tmp_path / "viewer.html").write_bytes(with_surfaces(plain, found))
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        watched = open_page(f"http://127.0.0.1:{server.server_port}/viewer.html")
        page = watched.page
        page.evaluate("() => splatpipe.ready")
        assert watched.requests == []
        page.keyboard.press("2")
        page.locator("#notice", has_text="surfaces.json is missing (404)").wait_for()
        assert pressed(page) == ["Splat"]
        (tmp_path / "surfaces.json").write_text(json.dumps(surfaces))
        assert page.evaluate("() => splatpipe.show('points').then(() => splatpipe.show('mesh'))") is True
        assert pressed(page) == ["Mesh"] and len(watched.requests) == 2
    finally:
        server.shutdown()
        server.server_close()
