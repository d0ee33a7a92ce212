"""Check that CesiumJS draws our 3D Tiles in the right place, on a synthetic site and on a real splat.

The site is three kilometres across and consists of small bright Gaussians at known points. CesiumJS itself, in its own
local frame, says at which pixels they should appear. The real splat is compared with our own renderer. The page
requests nothing but itself, CesiumJS and the tiles, all from this machine.

    npm install cesium@1.145
    python benchmarks cesium_tiles --modules node_modules [--splat OUT/splat.ply] [--pictures FOLDER]
"""

from __future__ import annotations

import argparse
import io
import math
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from splatpipe.pipeline.delivery.ecef_tiles import write_tiles_on_globe
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.levels.levels import build_levels
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.survey.crs.geodesy import geodetic_from_ecef

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PLACE = SplatOrigin(52.2, 21.0, 150.0, "ellipsoidal", "EPSG:32634")
WIDTH, HEIGHT = 640, 420
NEAR_PX = 12  # a bright spot within this distance of a point's expected pixel is the point
MAX_ERROR_PX = 2.0
SIGMA_M = 0.15
CORNERS_M = 1500.0
SPACING_M = 12.0
PER_NODE = 40  # for the site: low enough for its corners to become separate tiles
TIMEOUT_MS = 300_000.0


@dataclass
class PageProblems:
    """Console messages and requests that a page should not have made."""

    errors: list[str] = field(default_factory=list)
    strangers: list[str] = field(default_factory=list)


class Files(SimpleHTTPRequestHandler):
    """Serve the page, the tiles and CesiumJS from their three folders."""

    def __init__(self, *arguments: Any, roots: dict[str, Path], **options: Any) -> None:
        self.roots = roots
        super().__init__(*arguments, **options)

    def translate_path(self, path: str) -> str:
        first, _, rest = path.partition("?")[0].lstrip("/").partition("/")
        return str(self.roots[first] / rest) if first in self.roots and ".." not in rest else "/nothing"

    def log_message(self, *arguments: Any) -> None:
        """Log nothing."""


def main() -> None:
    """Print how far points are from their expected pixels, and how similar the images are to our own renderer's."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--modules", type=Path, required=True, help="node_modules with cesium")
    parser.add_argument("--splat", type=Path, help="a splat that lies on the earth, of any format")
    parser.add_argument("--pictures", type=Path, help="folder for what was seen")
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        far = check_site(Path(folder) / "site", options.modules, options.pictures)
        if options.splat:
            check_splat(Path(folder) / "splat", options.splat, options.modules, options.pictures)
    if far > MAX_ERROR_PX:
        raise SystemExit(f"A point is {far:.2f} pixels from where it should be.")


def known_places() -> np.ndarray:
    """Return squares of nine points around the centre and the corners of the site, at different heights."""
    offsets = SPACING_M * np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)], float)
    centres = CORNERS_M * np.array([[0, 0], [1, 1], [-1, 1], [1, -1], [-1, -1]], float)
    flat = (centres[:, None] + offsets[None]).reshape(-1, 2)
    return np.concatenate([flat, 5.0 + 3.0 * (np.arange(len(flat)) % 4)[:, None]], axis=1)


def bright_points(places: np.ndarray) -> Gaussians:
    """Create small, round, opaque Gaussians; colours distinguish the first points of each square from the others."""
    made = Gaussians.empty(len(places), 1)
    made.means = torch.from_numpy(places).float()
    made.log_scales[:] = math.log(SIGMA_M)
    made.opacity_logits[:] = 8.0
    colours = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.3, 0.2], [0.2, 1.0, 0.3]])
    made.sh[:, 0] = rgb_to_dc(colours[torch.arange(len(places)) % 3])
    return made


def check_site(folder: Path, modules: Path, pictures: Path | None) -> float:
    """Return the largest distance of a known point from its expected pixel."""
    places = known_places()
    scene = Scene(bright_points(places), SceneFacts("z up", False, True, PLACE))
    write_tiles_on_globe(folder, scene, build_levels(scene.gaussians, PER_NODE // 4))
    worst = 0.0
    with opened(folder, modules) as (page, heard):
        place(page, PLACE)
        for number in range(0, len(places), 9):
            square = places[number : number + 9]
            middle = square.mean(axis=0)
            eye = middle + np.array([-25.0, -45.0, 40.0])
            drawn, picture = seen(page, eye, middle)
            off = distances(page, square, picture)
            worst = max(worst, float(off.max()))
            where = f"{middle[0]:6.0f} {middle[1]:6.0f} m"
            print(f"site at {where}: {off.max():.2f} px at most, {off.mean():.2f} in the mean; {drawn}")
            save(pictures, f"site_{number // 9}.png", picture)
        report(heard)
        print("no error on the console, no request to another host")
    return worst


def check_splat(folder: Path, path: Path, modules: Path, pictures: Path | None) -> None:
    """Print how similar CesiumJS's images of a splat are to ours."""
    scene = read_scene(path).turned("z up")
    root = build_levels(scene.gaussians)
    placement = write_tiles_on_globe(folder, scene, root)
    lies = scene.facts.place
    assert lies is not None
    print(f"{path.name}: {len(scene.gaussians):,} Gaussians, {sum(1 for _ in root.nodes())} tiles. {placement.note}")
    raised = raise_of(placement.matrix, lies)
    means = scene.gaussians.means.numpy().astype(float)
    middle = np.median(means, axis=0)
    size = float(np.percentile(np.linalg.norm(means - middle, axis=1), 60.0))
    with opened(folder, modules) as (page, heard):
        place(page, SplatOrigin(lies.latitude, lies.longitude, lies.height_m + raised))
        for turn in (20.0, 110.0, 200.0, 290.0):
            away = np.array([math.sin(math.radians(turn)), math.cos(math.radians(turn)), 0.8])
            drawn, picture = seen(page, middle + 1.6 * size * away, middle)
            ours = rendered(scene, page)
            error = np.mean((picture.astype(float) - ours.astype(float)) ** 2)
            like = 10.0 * math.log10(255.0**2 / max(error, 1e-9))
            print(f"from {turn:.0f}°: {like:.1f} dB from ours; {drawn}")
            save(pictures, f"splat_{turn:.0f}.png", np.concatenate([picture, ours], axis=1))
        report(heard)


def raise_of(ecef_from_local: np.ndarray, lies: SplatOrigin) -> float:
    """Return how far a placement lies above its origin's height: the geoid undulation, if known."""
    height = float(geodetic_from_ecef(ecef_from_local[:3, 3][None])[0, 2])
    return height - lies.height_m


@contextmanager
def opened(folder: Path, modules: Path) -> Iterator[tuple[Page, PageProblems]]:
    """Open the page in a browser that renders in software, from a server on this machine."""
    roots = {"cesium": modules / "cesium/Build/Cesium", "tiles": folder, "page": Path(__file__).parent}
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Files, roots=roots))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    home, heard = f"http://127.0.0.1:{server.server_address[1]}/", PageProblems()
    with sync_playwright() as playwright:
        path = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(TIMEOUT_MS)
        page.on("console", lambda said: heard.errors.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: heard.errors.append(str(error)))
        page.on("request", lambda asked: heard.strangers.append(asked.url) if foreign(asked.url, home) else None)
        page.goto(f"{home}page/cesium_tiles.html")
        report(heard)
        yield page, heard
        browser.close()
    server.shutdown()
    server.server_close()


def foreign(url: str, home: str) -> bool:
    """Whether a URL belongs to another host."""
    return not url.startswith((home, "data:", f"blob:{home}"))


def report(heard: PageProblems) -> None:
    """Exit if the page logged or requested anything that it should not.

    Raises:
        SystemExit: if there was anything.
    """
    if heard.errors or heard.strangers:
        raise SystemExit("\n".join([*heard.errors, *heard.strangers]))


def place(page: Page, lies: SplatOrigin) -> None:
    """Load the tiles at their placement."""
    where = [lies.longitude, lies.latitude, lies.height_m]
    page.evaluate("([x, y, h]) => openTiles('/tiles/tileset.json', x, y, h)", where)


def seen(page: Page, eye: np.ndarray, target: np.ndarray) -> tuple[str, np.ndarray]:
    """Return what is drawn from a viewpoint once it no longer changes: a line of text, and the image."""
    page.evaluate("([eye, target]) => lookFrom(eye, target)", [eye.tolist(), target.tolist()])
    drawn = page.evaluate("() => complete()")
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    return f"{drawn['splats']:,} Gaussians in {drawn['tiles']} tiles", picture


def distances(page: Page, places: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Return the distances, in pixels, of the bright spots' centres from where CesiumJS projects the points."""
    light = picture.astype(float).max(axis=2)
    found = []
    for x, y in page.evaluate("places => pixels(places)", places.tolist()):
        left, top = round(x) - NEAR_PX, round(y) - NEAR_PX
        part = light[max(top, 0) : top + 2 * NEAR_PX, max(left, 0) : left + 2 * NEAR_PX]
        if part.size == 0 or part.max() < 64.0:
            found.append(math.inf)  # no spot there
            continue
        rows, columns = np.mgrid[: part.shape[0], : part.shape[1]]
        spot = np.array([(part * columns).sum(), (part * rows).sum()]) / part.sum() + 0.5
        found.append(math.hypot(max(left, 0) + spot[0] - x, max(top, 0) + spot[1] - y))
    return np.array(found)


def rendered(scene: Scene, page: Page) -> np.ndarray:
    """Render the scene from CesiumJS's camera with our own renderer."""
    view = page.evaluate("() => view()")
    forward, up = np.array(view["forward"]), np.array(view["up"])
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = np.stack([np.cross(forward, up), -up, forward])
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ np.array(view["centre"])
    focal = 0.5 * HEIGHT / math.tan(0.5 * view["fovy"])
    camera = Camera("cesium", WIDTH, HEIGHT, focal, focal, WIDTH / 2.0, HEIGHT / 2.0, cam_from_world)
    options = RenderOptions(scene.gaussians.sh_degree, near=0.1)
    with torch.no_grad():
        colour = rasterizer.render(scene.gaussians, camera, options).colour
    return np.asarray((255.0 * colour.clamp(0.0, 1.0)).round().to(torch.uint8).numpy())


def save(pictures: Path | None, name: str, picture: np.ndarray) -> None:
    """Save an image, if a folder is given."""
    if pictures is not None:
        Image.fromarray(picture).save(pictures / name)


if __name__ == "__main__":
    main()
