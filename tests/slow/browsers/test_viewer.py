"""viewer.html in a real browser: rendering, measured positions and lengths, controls, and error messages."""

import io
import itertools
import json
import shutil
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pyproj
import pytest
import tiny_scene
import torch
from PIL import Image
from playwright.sync_api import Browser, Page
from timeouts import wait_until

from splatpipe.demo import CAPTURE
from splatpipe.pipeline.engine.runs.store import open_store
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.render.rendering import as_trained, render_pixels
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS, panorama_of, read_panorama
from splatpipe.pipeline.survey.crs.frames import Frame, Origin, Similarity, load_frame
from splatpipe.pipeline.web.measured_page import with_measurements
from splatpipe.pipeline.web.viewer_scene import ViewerRendering, upright, viewer_scene, write_viewer

LIKE_OURS_DB = 25.0
UP_FROM_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # the tiny scene's −y is up
# Ends of the demo's ridge, in its plot, 10 cm from the roof's edges.
RIDGE_M = np.array([[-6.35, 0.0, 9.12], [6.35, 0.0, 9.12]])
FROM_ABOVE = "DJI_0023.JPG"
BREAKOUT = "</script><script>document.title = 'broken'</script>"
Opened = Callable[..., "Page"]


@pytest.fixture
def view(open_page: Callable) -> Iterator[Opened]:
    """Open a page and wait for its first complete frame; afterwards check that it made no requests and no errors."""
    pages = []

    def opened(path: Path, width: int = 640, height: int = 400, touch: bool = False) -> Page:
        watched = open_page(path.as_uri(), width, height, touch)
        pages.append(watched)
        watched.page.evaluate("() => splatpipe.ready")
        return watched.page

    yield opened
    for watched in pages:
        assert watched.requests == []
        assert watched.errors == []


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page of the tiny scene, of arbitrary scale, named to break out of its script."""
    folder = tmp_path_factory.mktemp("tiny")
    write_tiny(folder, BREAKOUT)
    return folder


def write_tiny(folder: Path, title: str = "Tiny", largest_bytes: float = 1e9, model: Gaussians | None = None) -> None:
    dataset = tiny_scene.write_dataset(folder / "dataset")
    frame = Frame("arbitrary", Similarity(1.0, UP_FROM_DOWN, np.zeros(3)))
    rendering = ViewerRendering(antialias=False, background=(0.0, 0.0, 0.0), near=0.01, sky=tiny_sky())
    model = tiny_scene.true_model() if model is None else model
    scene = viewer_scene(dataset, frame, rendering, ["flight 1/photo_0.png"], len(model), title)
    turned = model.transformed(1.0, torch.from_numpy(UP_FROM_DOWN), torch.zeros(3, dtype=torch.float64))
    write_viewer(folder, scene, turned, largest_bytes)


def tiny_sky():
    """Bands of colour in the model's frame, whose −y is up."""
    colours = np.zeros((ROWS, COLUMNS, 3), np.float32)
    colours[..., 0] = np.linspace(0.0, 1.0, ROWS)[:, None]
    colours[..., 1] = 0.5 + 0.5 * np.sin(2.0 * np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS)
    return panorama_of(np.array([0.0, -1.0, 0.0]), colours.reshape(-1, 3))


def picture(page: Page) -> np.ndarray:
    page.evaluate("() => { splatpipe.showInterface(false); return splatpipe.complete(); }")
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def state(page: Page) -> dict:
    return page.evaluate("() => splatpipe.cameraState()")


def away(page: Page) -> float:
    """Return the distance from the camera to the scene's centre."""
    centre = np.array(page.evaluate("() => splatpipe.facts.centre"))
    return float(np.linalg.norm(np.array(state(page)["position"]) - centre))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10.0 * np.log10(255.0**2 / np.mean((a.astype(float) - b.astype(float)) ** 2)))


def part(out: Path, stage: str, name: str) -> Path:
    (artifact,) = open_store(out, create=False).artifacts(stage)
    return artifact.parts[f"{stage}.{name}"].path


def in_run(out: Path, plot_m: np.ndarray) -> np.ndarray:
    """Places on the demo's plot in the world of a run: by the earth, not by the model."""
    truth = json.loads((CAPTURE / "truth.json").read_text())
    angle = np.radians(truth["house_yaw_deg"])
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    origin = load_frame(part(out, "georef", "frame")).origin
    assert origin is not None
    return origin.enu_from_geodetic(Origin(**truth["frame"]["origin"]).geodetic_from_enu(plot_m @ turn.T))


def test_the_demos_page_shows_what_our_rasterizer_renders(demo_run: Path, view: Opened) -> None:
    model = read_splat(part(demo_run, "train", "model"))
    options, _ = as_trained(part(demo_run, "train", "rendering"), model)
    sky = read_panorama(part(demo_run, "train", "sky"))
    cameras = [photo_view.camera for photo_view in load_views(part(demo_run, "undistort", "dataset"))][::13]
    page = view(demo_run / "viewer.html", cameras[0].width, cameras[0].height)
    for camera in cameras:
        size = {"width": camera.width, "height": camera.height}
        page.set_viewport_size(size)
        wait_until(lambda size=size: all(state(page)[name] == side for name, side in size.items()))
        assert page.evaluate("name => splatpipe.goToCamera(name)", camera.name)
        ours = render_pixels((model, sky), camera, options)
        assert psnr(picture(page), ours) >= LIKE_OURS_DB


def test_the_demos_ridge_is_as_long_as_it_was_built(demo_run: Path, view: Opened) -> None:
    page = view(demo_run / "viewer.html", 1200, 900)
    page.evaluate("name => splatpipe.goToCamera(name)", FROM_ABOVE)
    page.keyboard.press("m")
    for end in in_run(demo_run, RIDGE_M).tolist():
        place = page.evaluate("end => splatpipe.project(end)", end)
        page.mouse.click(round(place["x"]), round(place["y"]))
    hint = page.locator("#hint").inner_text()
    length = float(hint.split("Length ")[1].split(" m")[0])
    assert length == pytest.approx(np.linalg.norm(RIDGE_M[1] - RIDGE_M[0]), rel=0.01)
    assert page.locator(".measured").inner_text() == f"{length:.2f} m"


def test_coordinates_agree_with_proj(demo_run: Path, view: Opened) -> None:
    page = view(demo_run / "viewer.html")
    origin = load_frame(part(demo_run, "georef", "frame")).origin
    assert origin is not None
    local = np.array([[0.0, 0.0, 0.0], [35.0, -22.0, 7.0], [-480.0, 470.0, -60.0]])
    found = np.array(page.evaluate("points => points.map((point) => splatpipe.crsOf(point))", local.tolist()))
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    ecef = local @ origin.ecef_from_enu()[:3, :3].T + origin.ecef_from_enu()[:3, 3]
    longitude, latitude, height = geodetic.transform(*ecef.T)
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True)
    easting, northing = utm.transform(longitude, latitude)
    np.testing.assert_allclose(found, np.stack([easting, northing, height], axis=1), rtol=0.0, atol=1e-4)


def test_the_place_under_the_cursor_is_shown_in_the_runs_crs(demo_run: Path, view: Opened) -> None:
    page = view(demo_run / "viewer.html")
    page.mouse.move(300, 200)
    point = page.evaluate("() => splatpipe.pick(300, 200)")
    easting, northing, height = page.evaluate("point => splatpipe.crsOf(point)", point)
    assert page.locator("#coordinates").inner_text() == f"E {easting:.2f}   N {northing:.2f}   H {height:.2f}"
    assert "EPSG:32633" in page.locator("#crs").inner_text()


def test_a_click_on_a_frustum_moves_the_camera_into_it(demo_run: Path, view: Opened) -> None:
    page = view(demo_run / "viewer.html", 1000, 700)
    page.evaluate("() => splatpipe.setCamera({position: [-45, -40, 38], target: [0, 0, 3]})")
    page.keyboard.press("c")
    page.evaluate("() => splatpipe.complete()")
    places = page.evaluate("() => splatpipe.facts.cameras.map((c) => splatpipe.project(c.centre))")
    found = None
    for place in places:  # a frustum's image is beside its centre: search around each
        for right, down in ((0, 12), (12, 0), (-12, 0), (0, -12)):
            page.mouse.move(place["x"] + right, place["y"] + down)
            if page.locator("#tip").is_visible():
                found = page.locator("#tip").inner_text().split(" ·")[0]
                page.mouse.click(place["x"] + right, place["y"] + down)
                break
        if found:
            break
    assert found
    wait_until(lambda: state(page)["photo"] == found)
    camera = next(c for c in page.evaluate("() => splatpipe.facts.cameras") if c["name"] == found)
    np.testing.assert_allclose(state(page)["position"], camera["centre"], atol=1e-9)


def test_a_large_splat_is_a_separate_file_that_the_page_requests_or_loads_from_a_server(
    tmp_path: Path, open_page: Callable
) -> None:
    write_tiny(tmp_path, largest_bytes=1e5)
    page = open_page((tmp_path / "viewer.html").as_uri()).page
    assert "stored beside the page, in splat.spz" in page.locator("#message").inner_text()
    assert "splatpipe view" in page.locator("#advice").inner_text()
    page.set_input_files("#file", tmp_path / "splat.spz")
    page.locator("body.ready").wait_for(state="attached")
    assert picture(page).std() > 10.0

    handler = partial(QuietHandler, directory=str(tmp_path))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        served = open_page(f"http://127.0.0.1:{server.server_port}/viewer.html")
        served.page.evaluate("() => splatpipe.ready")
        assert served.requests == [f"http://127.0.0.1:{server.server_port}/splat.spz"]
        assert served.errors == []
        (tmp_path / "splat.spz").unlink()
        page = open_page(f"http://127.0.0.1:{server.server_port}/viewer.html").page
        page.locator("#message", has_text="splat.spz is missing (404)").wait_for()
    finally:
        server.shutdown()
        server.server_close()


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


def test_a_damaged_splat_is_reported(tiny: Path, tmp_path: Path, open_page: Callable) -> None:
    text = (tiny / "viewer.html").read_text(encoding="utf-8")
    begin = text.index('id="splat">') + len('id="splat">')
    (tmp_path / "cut.html").write_text(text[: begin + 4000] + text[text.index("</script>", begin) :], encoding="utf-8")
    page = open_page((tmp_path / "cut.html").as_uri()).page
    page.locator("#loading.failed").wait_for()
    assert "cannot be read" in page.locator("#message").inner_text()


def test_without_webgl_2_the_page_says_what_is_missing(tiny: Path, browser: Browser) -> None:
    path = shutil.which("chromium") or shutil.which("google-chrome")
    other = browser.browser_type.launch(executable_path=path, args=["--no-sandbox", "--disable-3d-apis"])
    try:
        page = other.new_page()
        page.goto((tiny / "viewer.html").as_uri())
        page.locator("#loading.failed").wait_for()
        assert "has no WebGL 2" in page.locator("#message").inner_text()
        assert "hardware acceleration" in page.locator("#advice").inner_text()
    finally:
        other.close()


def test_names_cannot_break_out_of_the_page(tiny: Path, view: Opened) -> None:
    page = view(tiny / "viewer.html")
    assert page.title() == BREAKOUT
    assert page.locator("h1").inner_text() == page.title()


def test_without_a_scale_lengths_have_no_metres(tiny: Path, view: Opened) -> None:
    page = view(tiny / "viewer.html")
    for name in ("#results", "#results_button", "dt.for-results"):  # nothing was measured on a surface model
        assert page.locator(name).is_hidden()
    measured = page.evaluate("() => splatpipe.measure([0, 0, 0], [3, 4, 12])")
    assert measured == {"distance": 13.0, "horizontal": 5.0, "height": 12.0}
    assert page.locator(".measured").inner_text() == "13.00 units"
    assert "arbitrary units" in page.locator("#crs").inner_text()
    assert page.evaluate("() => splatpipe.crsOf([1, 2, 3])") is None


def test_blur_without_antialiasing_the_sky_and_an_off_centre_lens_match_our_renderer(tiny: Path, view: Opened) -> None:
    camera = tiny_scene.cameras()[2]
    page = view(tiny / "viewer.html", camera.width, camera.height)
    page.evaluate("name => splatpipe.goToCamera(name)", camera.name)
    options = rasterizer.RenderOptions(sh_degree=3)
    ours = render_pixels((tiny_scene.true_model(), tiny_sky()), camera, options)
    bare = render_pixels((tiny_scene.true_model(), None), camera, options)
    assert psnr(ours, bare) < LIKE_OURS_DB  # the sky is seen
    assert psnr(picture(page), ours) >= LIKE_OURS_DB


def test_the_last_splat_of_a_batch_is_drawn_completely(tmp_path: Path, view: Opened) -> None:
    """Many are drawn at a time, 16,384 at most: of twice as many, the large one is in the middle from either side."""
    camera = tiny_scene.cameras()[4]
    count = 2 * 16384 - 1
    generator = torch.Generator().manual_seed(3)
    model = Gaussians.empty(count, 0)
    middle = count // 2
    places = 2.0 * torch.rand(count, 3, generator=generator).double() - 1.0
    places[:, 2] = torch.linspace(2.0, 6.0, count) + 0.5 * (torch.arange(count) - middle).sign()  # the camera's depths
    places[middle] = torch.tensor([0.0, 0.0, 4.0])
    pose = torch.from_numpy(camera.cam_from_world)
    model.means = ((places - pose[:3, 3]) @ pose[:3, :3]).float()
    model.log_scales = torch.full((count, 3), -6.0)
    model.quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    model.opacity_logits = torch.full((count,), 3.0 / 255.0).logit()
    model.sh = rgb_to_dc(torch.full((count, 1, 3), 0.3))
    model.log_scales[middle], model.opacity_logits[middle] = -1.0, 3.0
    model.sh[middle] = rgb_to_dc(torch.ones(1, 3))
    write_tiny(tmp_path, model=model)
    page = view(tmp_path / "viewer.html", camera.width, camera.height)
    page.evaluate("name => splatpipe.goToCamera(name)", camera.name)
    ours = render_pixels((model, tiny_sky()), camera, rasterizer.RenderOptions(sh_degree=0))
    assert psnr(picture(page), ours) >= LIKE_OURS_DB


def test_drag_wheel_and_keys_move_the_view(tiny: Path, view: Opened) -> None:
    page = view(tiny / "viewer.html")
    first = state(page)
    page.mouse.move(320, 200)
    page.mouse.down()
    page.mouse.move(420, 200, steps=4)
    page.mouse.up()
    assert state(page)["yaw"] < first["yaw"] - 0.3
    assert state(page)["photo"] is None
    before = away(page)
    page.mouse.wheel(0, -300)
    wait_until(lambda: away(page) < before)
    before = away(page)
    page.keyboard.down("s")
    wait_until(lambda: away(page) > before)
    page.keyboard.up("s")
    page.keyboard.press("h")
    wait_until(lambda: state(page)["photo"] == first["photo"])


def test_fingers_turn_and_pinch_on_a_phone(tiny: Path, view: Opened) -> None:
    page = view(tiny / "viewer.html", 390, 844, touch=True)
    fingers = page.context.new_cdp_session(page)

    def touch(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    first = state(page)
    touch("touchStart", (200, 400))
    for x in range(210, 320, 20):
        touch("touchMove", (x, 400))
    touch("touchEnd")
    assert state(page)["yaw"] < first["yaw"] - 0.2
    before = away(page)
    touch("touchStart", (180, 400), (220, 400))
    for spread in range(30, 120, 15):
        touch("touchMove", (200 - spread, 400), (200 + spread, 400))
    touch("touchEnd")
    assert away(page) < before
    page.locator("#strip button").nth(1).tap()
    wait_until(lambda: state(page)["photo"] == "flight 1/photo_1.png")
    for name in ("home", "distance", "help_button"):  # all that one needs is within the screen
        box = page.locator(f"#{name}").bounding_box()
        assert box is not None
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390 and box["y"] + box["height"] <= 844


def test_points_replace_the_splat_and_measurements_can_be_undone(tiny: Path, view: Opened) -> None:
    page = view(tiny / "viewer.html")
    splats = picture(page)
    page.evaluate("() => splatpipe.showInterface(true)")
    page.keyboard.press("p")
    points = picture(page)
    assert psnr(splats, points) < 20.0
    places = [(x, y) for x in range(220, 420, 10) for y in range(120, 280, 10)]
    found = [page.evaluate("([x, y]) => splatpipe.pick(x, y)", place) for place in places]
    assert any(found)
    for (x, y), point in zip(places, found, strict=True):
        if point:
            at = page.evaluate("point => splatpipe.project(point)", point)
            assert np.hypot(at["x"] - x, at["y"] - y) <= 10.0
    page.evaluate("() => splatpipe.showInterface(true)")
    page.keyboard.press("p")
    page.keyboard.press("t")
    page.mouse.click(300, 190)
    page.mouse.click(340, 210)
    assert page.locator(".measured").inner_text().startswith("Δh ")
    assert page.locator("#hint").inner_text().startswith("Length ")
    page.keyboard.press("Backspace")
    assert page.locator(".measured").count() == 0
    assert page.locator("#hint").inner_text().startswith("Click the first point")


def test_next_and_previous_start_from_the_last_chosen_photo(tiny: Path, view: Opened) -> None:
    page = view(tiny / "viewer.html")
    page.evaluate("() => splatpipe.goToCamera(splatpipe.facts.cameras[0].name)")
    page.keyboard.type("nNb")  # faster than the view travels
    wait_until(lambda: state(page)["photo"] == "flight 1/photo_1.png")


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844), (844, 390)])
def test_no_two_panels_over_the_model_overlap(tiny: Path, view: Opened, width: int, height: int) -> None:
    page = view(tiny / "viewer.html", width, height)
    page.keyboard.press("m")
    page.locator("#compass").evaluate("element => element.removeAttribute('hidden')")
    page.locator("#crs").evaluate("element => element.replaceChildren('a long sentence '.repeat(8))")
    boxes = [page.locator(name).bounding_box() for name in ("#compass", "#where", "#strip", "#hint")]
    for a, b in itertools.combinations(filter(None, boxes), 2):
        (left, right), (top, bottom) = [sorted((a, b), key=lambda box: box[axis]) for axis in "xy"]
        assert left["x"] + left["width"] <= right["x"] or top["y"] + top["height"] <= bottom["y"]


def measured() -> dict:
    """A section with a hole, three metres long, and the volume of a triangle, named to break out."""
    profile = {"distance": [0.0, 1.0, 2.0, 2.5, 3.0], "height": [500.0, 502.0, None, 501.0, 501.5]}
    profile |= {"sigma": [0.02, 0.02, None, None, 0.02], "point_distance": [1.1], "point_height": [499.5]}
    profile |= {"x": [-1.5, -0.5, None, 1.0, 1.5], "y": [0.0, 0.0, None, 0.0, 0.0], "z": [0.0, 2.0, None, 1.0, 1.5]}
    section = {"name": "Section 1", "length_m": 3.0, "share_with_height": 0.8, "height_sigma_m": 0.021}
    amounts = {"cut_m3": 12.345, "cut_sigma_m3": 0.678, "fill_m3": 1.0, "fill_sigma_m3": 0.1, "net_m3": 1234.56}
    volume = {"name": BREAKOUT, **amounts, "net_sigma_m3": 12.3, "area_m2": 2.0, "base": "rim"}
    ring = {"x": [0.0, 2.0, 0.0, 0.0], "y": [0.0, 0.0, 2.0, 0.0], "z": [0.1, 0.1, 0.1, 0.1]}
    return {"sections": [{**section, "trace": profile}], "volumes": [{**volume, "trace": [ring]}]}


@pytest.fixture(scope="module")
def tiny_measured(tiny: Path) -> Path:
    path = tiny / "measured.html"
    path.write_bytes(with_measurements((tiny / "viewer.html").read_bytes(), measured()))
    return path


def test_sections_and_volumes_are_lines_a_list_and_a_chart(tiny_measured: Path, view: Opened) -> None:
    page = view(tiny_measured, 1000, 700)
    assert page.title() == BREAKOUT
    assert page.locator("#fold").inner_text() == "1 section, 1 volume"
    section, volume = page.locator("#results_list button").all()
    assert section.inner_text().splitlines() == ["Section 1", "3.00 m long · 80 % with heights", "heights ± 2.1 cm"]
    assert volume.inner_text().splitlines()[:3] == [
        BREAKOUT,
        "net 1235 ± 12 m³",
        "cut 12.35 ± 0.68 m³, fill 1.00 ± 0.10 m³",
    ]
    assert page.locator("#profile").is_hidden()
    section.click()
    wait_until(lambda: np.allclose([state(page)["yaw"], state(page)["pitch"]], [np.pi / 2.0, -0.45], atol=1e-9))
    left, right = (page.evaluate("end => splatpipe.project(end).x", end) for end in ([-1.5, 0, 0], [1.5, 0, 1.5]))
    assert page.locator("#results").bounding_box()["width"] < left < right < 1000.0  # its start is on the left
    box = page.locator("#chart").bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.99, box["y"] + 20)
    assert page.locator("#reading").inner_text() == "3.00 m: height 501.50 m ± 2.0 cm"
    dot = page.evaluate("() => splatpipe.project([1.5, 0, 1.5])")
    dot_box = page.locator("#labels > .dot:not([hidden])").bounding_box()
    assert (
        np.hypot(dot_box["x"] + dot_box["width"] / 2 - dot["x"], dot_box["y"] + dot_box["height"] / 2 - dot["y"]) < 2.0
    )
    page.mouse.move(box["x"] + box["width"] * 0.66, box["y"] + 20)
    assert page.locator("#reading").inner_text() == "2.00 m: no height here"
    volume.click()
    assert page.locator("#profile").is_hidden()
    with_lines = picture(page)
    page.evaluate("() => splatpipe.showInterface(true)")
    page.keyboard.press("v")
    assert page.locator("#results").is_hidden()
    assert np.abs(picture(page).astype(int) - with_lines).max() > 100


def test_on_a_phone_the_list_is_folded_and_leaves_room(tiny_measured: Path, view: Opened) -> None:
    page = view(tiny_measured, 390, 844, touch=True)
    assert page.locator("#results_list").is_hidden()
    page.locator("#fold").tap()
    page.locator("#results_list button").first.tap()
    box, where, tools = (page.locator(name).bounding_box() for name in ("#results", "#where", "#tools"))
    assert page.locator("#chart").is_visible()
    assert box["x"] + box["width"] <= tools["x"]
    assert box["y"] + box["height"] <= where["y"]
    wait_until(lambda: box["y"] + box["height"] < page.evaluate("() => splatpipe.project([0, 0, 1]).y") < where["y"])


def test_the_screenshot_is_the_rendered_image(tiny: Path, view: Opened, tmp_path: Path) -> None:
    page = view(tiny / "viewer.html")
    page.evaluate("() => splatpipe.complete()")
    with page.expect_download() as download:
        page.locator("#screenshot").click()
    download.value.save_as(tmp_path / "shot.png")
    screenshot = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB"))
    np.testing.assert_array_equal(screenshot, picture(page))


def test_a_photo_on_its_side_is_shown_upright() -> None:
    camera = tiny_scene.cameras()[3]
    world_up = camera.cam_from_world.copy()
    world_up[:3, :3] = world_up[:3, :3] @ UP_FROM_DOWN.T
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # as if taken with the right side up
    pose = world_up.copy()
    pose[:3] = quarter @ world_up[:3]
    held = camera.__class__(camera.name, 54, 72, 71.0, 70.0, 28.0, 37.5, pose)
    turned, turns = upright(held)
    assert turns in (1, 3)
    assert (turned.width, turned.height) == (72, 54)
    assert turned.cam_from_world[1, 2] < -0.9  # up is the picture's top
    points = np.array([[0.1, 0.2, 0.3], [-0.4, 0.1, 0.0]])
    grid = np.zeros((72, 54), bool)
    for x, y in held.project(points):
        grid[int(y), int(x)] = True
    rotated = np.rot90(grid, turns)
    assert all(rotated[int(y), int(x)] for x, y in turned.project(points))
