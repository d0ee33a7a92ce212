"""True orthographic images of the scene: ``python -m splatpipe.demo.truth.orthographic --out /tmp/demo-orthographic``.

The house's plot from above and its four façades, by the renderer of the capture's photos: same light, same textures,
no sensor noise, exposure 0 EV. The pixel size is half the photos' GSD, so that images on any grid can be made from
them by averaging. Same requirements as ``generate``; about two CPU minutes at 8 paths per pixel. The images are too
large for the repository: render them for comparisons. Finished strips are kept in ``--out``, so that an interrupted
run resumes.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from splatpipe.demo.photography.parallel_view import ParallelView
from splatpipe.demo.photography.sensor import GAIN, WHITE_BALANCE, coded
from splatpipe.demo.site.house import EAVES, HALF_LENGTH, HALF_WIDTH, RIDGE
from splatpipe.demo.site.mesh import Plane
from splatpipe.demo.site.scene import build_scene, turned

PIXEL_M = 0.014  # half of the photos' GSD
TOP_HALF_M, TOP_HEIGHT_M = 18.0, 30.0  # half side and height of the top view; nothing in it is higher
# Distance that a façade is viewed from: beyond annex, eaves and steps, but nearer than trees and the van in the south.
AHEAD_M = {"south": 4.0, "north": 5.5, "west": 5.5, "east": 5.5}
MARGIN_M = 0.3  # around a wall
STRIP_ROWS = 512
SEED = 20261123


def top_view(pixel_m: float = PIXEL_M) -> ParallelView:
    """The plot from above, north up."""
    count = round(2.0 * TOP_HALF_M / pixel_m)
    origin = np.array([-TOP_HALF_M, TOP_HALF_M, TOP_HEIGHT_M])
    return ParallelView("top", origin, np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]), pixel_m, count, count)


def wall_planes() -> dict[str, tuple[Plane, float, float]]:
    """The four walls of the house by name: plane (lower left corner, level and upright axis), length, greatest height.

    In the world's axes; seen from outside, u points to the right and the plane's normal to the viewer.
    """
    length, width = 2.0 * HALF_LENGTH, 2.0 * HALF_WIDTH
    sides = {
        "south": ((-HALF_LENGTH, -HALF_WIDTH, 0), (1, 0, 0), length, EAVES),
        "north": ((HALF_LENGTH, HALF_WIDTH, 0), (-1, 0, 0), length, EAVES),
        "west": ((-HALF_LENGTH, HALF_WIDTH, 0), (0, -1, 0), width, RIDGE),
        "east": ((HALF_LENGTH, -HALF_WIDTH, 0), (0, 1, 0), width, RIDGE),
    }
    up = (0, 0, 1)
    return {
        name: (Plane.make(turned(np.array(corner, float)), turned(np.array(u, float)), up), span, high)
        for name, (corner, u, span, high) in sides.items()
    }


def facade_view(name: str, pixel_m: float = PIXEL_M) -> ParallelView:
    """The front view of a wall of the house, with a margin around it."""
    wall, span, high = wall_planes()[name]
    origin = wall.point(-MARGIN_M, high + MARGIN_M, AHEAD_M[name])
    size = (round(metres / pixel_m) for metres in (span + 2.0 * MARGIN_M, high + 2.0 * MARGIN_M))
    return ParallelView(name, origin, wall.u, -wall.v, pixel_m, *size)


def views(pixel_m: float = PIXEL_M) -> list[ParallelView]:
    """All orthographic views."""
    return [top_view(pixel_m), *(facade_view(name, pixel_m) for name in wall_planes())]


def main() -> None:
    from splatpipe.demo.photography.render import Renderer  # takes mitsuba, which only rendering needs

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--spp", type=int, default=8, help="paths a pixel")
    parser.add_argument("--pixel", type=float, default=PIXEL_M, help="metres a pixel")
    parser.add_argument("--only", action="append", help="names of the pictures")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    renderer = Renderer(build_scene())
    for number, view in enumerate(views(arguments.pixel)):
        if arguments.only and view.name not in arguments.only:
            continue
        strips = []
        for top in range(0, view.height, STRIP_ROWS):
            rows = min(STRIP_ROWS, view.height - top)
            strip = replace(view, origin=view.origin + view.down * (top * view.pixel_m), height=rows)
            file = arguments.out / f"{view.name}.{view.pixel_m:g}.{arguments.spp}.{top}.npy"
            if not file.exists():
                seed = SEED + 1000 * number + top // STRIP_ROWS
                partial = file.with_suffix(".part.npy")
                np.save(partial, renderer.orthographic(strip, arguments.spp, seed).astype(np.float16))
                partial.rename(file)
            strips.append(coded(np.load(file).astype(np.float64) * GAIN * WHITE_BALANCE))
            print(f"{view.name}: {top + rows} of {view.height} rows", flush=True)
        Image.fromarray(np.concatenate(strips)).save(arguments.out / f"{view.name}.png")


if __name__ == "__main__":
    main()
