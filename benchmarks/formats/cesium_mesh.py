"""Check that CesiumJS draws a mesh's 3D Tiles in the right place, without gaps where tiles of different levels meet.

The site is made: hills and a block on 120 m, without holes, its page a pattern. From low viewpoints near tiles are
fine and far ones coarse; every pixel of the background that drawn ones enclose is a gap. With OUT, its
`export/mesh-tiles` are drawn, too; a real mesh has holes of its own, so that enclosed pixels of the background are
counted beside those of the same view in the finest tiles alone.

    npm install cesium@1.145
    python benchmarks cesium_mesh --modules node_modules [--out OUT] [--pictures FOLDER]
"""

from __future__ import annotations

import argparse
import collections
import io
import tempfile
from pathlib import Path

import cv2
import numpy as np
from cesium_tiles import opened, place, report, save
from made_mesh import SIDE_M, made_site, site_height
from PIL import Image
from playwright.sync_api import Page

from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.splat.model.scene import SplatOrigin
from splatpipe.pipeline.surface.levels.mesh_tiles import write_mesh_tiles
from splatpipe.pipeline.survey.crs.frames import Frame, Origin, Similarity

BACKGROUND = "#ff00ff"
PLACE = Origin(52.2, 21.0, 150.0)
MIXED, FINEST = 16.0, 0.0  # largest errors of tiles on the screen, pixels
VIEWS = [
    ((-0.48, -0.48, 0.06), (0.3, 0.3, 0.0)),
    ((0.0, -0.55, 0.1), (0.0, 0.2, 0.0)),
    ((0.4, 0.4, 0.05), (-0.4, -0.2, 0.0)),
]
"""Viewpoints and targets, in sides of the site from its middle."""
MAX_GAPS = 0


def main() -> None:
    """Print tiles and gaps of each view; exit with an error if the made site has a gap or lies wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--modules", type=Path, required=True, help="node_modules with cesium")
    parser.add_argument("--out", type=Path, help="a finished run with export/mesh-tiles")
    parser.add_argument("--pictures", type=Path, help="folder for what was seen")
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        gaps = check_made(Path(folder), options.modules, options.pictures)
    if options.out:
        check_run(options.out, options.modules, options.pictures)
    if gaps > MAX_GAPS:
        raise SystemExit(f"{gaps} pixels of the background show between tiles.")


def check_made(folder: Path, modules: Path, pictures: Path | None) -> int:
    """Return the number of pixels of the background inside of the made site, over all views."""
    made = made_site(folder)
    tiles = folder / "tiles"
    tiles.mkdir()
    frame = Frame("enu", Similarity.identity(), PLACE, "ellipsoidal", crs="EPSG:32634")
    summary = write_mesh_tiles(tiles, made, frame, folder / "work", _tell_nothing)
    print(f"made site: {summary.tiles} tiles in {summary.levels} levels, {summary.triangles:,} triangles")
    total = 0
    with opened(tiles, modules) as (page, heard):
        place(page, SplatOrigin(PLACE.latitude, PLACE.longitude, PLACE.height_m))
        for number, (eye, target) in enumerate(VIEWS):
            eye_m, target_m = SIDE_M * np.array(eye), SIDE_M * np.array(target)
            eye_m[2] += float(site_height(eye_m[None, :2])[0])
            drawn, picture = seen(page, eye_m, target_m, MIXED)
            gaps = enclosed(picture)
            total += gaps
            print(f"view {number}: {drawn}; {gaps} pixels of background between them")
            save(pictures, f"made_{number}.png", picture)
        report(heard)
    return total


def _tell_nothing(_done: int, _total: int) -> None:
    pass


def check_run(out: Path, modules: Path, pictures: Path | None) -> None:
    """Print the enclosed background of a run's tiles, in mixed levels and in the finest alone."""
    tiles = out / "export/mesh-tiles"
    tileset = read_json(tiles / "tileset.json")
    centre, half = box_of(tileset)
    with opened(tiles, modules) as (page, heard):
        place(page, SplatOrigin(0.0, 0.0, 0.0))
        page.evaluate("() => { enu = Cesium.Matrix4.clone(tileset.root.transform); }")  # views are in the tiles' frame
        for number, (eye, target) in enumerate(VIEWS):
            eye_m, target_m = centre + 2.0 * half * np.array(eye), centre + 2.0 * half * np.array(target)
            eye_m[2] = centre[2] + half[2] + 0.1 * half[:2].max()
            for error in (MIXED, FINEST):
                drawn, picture = seen(page, eye_m, target_m, error)
                print(f"{out.name}, view {number}, error {error:g}: {drawn}; {enclosed(picture)} enclosed pixels")
                save(pictures, f"{out.name}_{number}_{error:g}.png", picture)
        report(heard)


def box_of(tileset: dict) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and half sides of a tileset's box, in its own frame."""
    box = np.array(tileset["root"]["boundingVolume"]["box"])
    return box[:3], np.abs(box[3:].reshape(3, 3)).max(axis=0)


def seen(page: Page, eye: np.ndarray, target: np.ndarray, error: float) -> tuple[str, np.ndarray]:
    """Return what is drawn from a viewpoint: the number of tiles of each level, and the image."""
    page.evaluate("([background, error]) => expectMesh(background, error)", [BACKGROUND, error])
    page.evaluate("([eye, target]) => lookFrom(eye, target)", [eye.tolist(), target.tolist()])
    page.evaluate("() => complete()")
    names = page.evaluate("() => drawnTiles()")
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    levels = collections.Counter(name.split("-")[0] for name in names)
    return ", ".join(f"{count} tiles of level {level}" for level, count in sorted(levels.items())), picture


def enclosed(picture: np.ndarray) -> int:
    """Return the number of background pixels that do not hang together with the picture's upper edge or its sides."""
    background = (picture == np.array([255, 0, 255])).all(axis=2).astype(np.uint8)
    _, labels = cv2.connectedComponents(background, connectivity=8)
    outside = np.unique(np.concatenate([labels[0], labels[:, 0], labels[:, -1], labels[-1]]))
    return int((background.astype(bool) & ~np.isin(labels, outside)).sum())


if __name__ == "__main__":
    main()
