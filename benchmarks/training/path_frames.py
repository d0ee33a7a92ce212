"""Render frames along a smooth path between a run's photos: ``path_frames OUT --frames 120 --save FOLDER``.

Frames are rendered as `evaluate` does, level, at training size, with the first photo's intrinsics. Writes PNG frames, a
contact sheet, and:

- each frame's mean luminance and its change from the previous frame, in 8-bit steps like all colours here;
    - for the same places in consecutive frames, matched by the median depths of both: the median colour difference
    (including that of resampling), and the signed median luminance difference, in which texture cancels: a change of
    exposure;
    - the share of a frame nearer than half the depth of the nearest sparse points of the two neighbouring photos, as
    seen from the frame: something floats in front of the camera; and the frame's median depth over the smaller one of
    those photos.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float64
from opened_run import OpenedRun, open_run, write_png
from tables import Row, print_table

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.film.camera_path import (
    FINE_STEPS,
    FilmCamera,
    cameras_along,
    centripetal_knots,
    evenly_timed,
    route_of,
    spline,
    upright_route,
)
from splatpipe.pipeline.film.filming import open_scene
from splatpipe.pipeline.film.photo_route import PhotoTrack, followed_photos
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks
from splatpipe.pipeline.photos.pixels.images import Pixels
from splatpipe.pipeline.raster.device import cpu
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.consistency import DEPTH_TOLERANCE

LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, of coded values
EVERY_PX = 3  # spacing of the pixels that are followed into the next frame, both ways
NEAREST = 0.02  # quantile of the sparse points' depths: a few points are wrong
MIN_DEPTH_SHARE = 0.5  # share of the nearest points' depth: the sparse cloud has holes, but none so deep
MAX_IN_THE_AIR_SHARE = 0.01  # share of a frame: more counts as a crossing floater
MUCH_NEARER = 0.7  # times the smaller median depth of the two neighbouring photos
SHEET_COLUMNS, SHEET_FRAMES, SHEET_WIDTH = 6, 48, 300
FPS = 25
TABLE_FRAMES = 8  # frames in the table; all are in the JSON

COLUMNS = {
    "frame": "frame:",
    "between": "between:",
    "luminance": "luminance:.1f",
    "step": "step:+.2f",
    "same places: colour": "colour:.2f",
    "exposure": "exposure:+.2f",
    "places": "places:,",
    "median depth / photos'": "depth_ratio:.2f",
    "in the air": "in_the_air:.4f",
}


Depth = Float[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class PathFrame:
    """A camera, its render, and the render's median depth."""

    camera: Camera
    pixels: Pixels
    depth: Depth


def same_places(
    camera: Camera, depth: Depth, following: Camera, following_depth: Depth
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
    """Return pixels of a frame and of the next that show the same places, by the median depths of both."""
    rows, columns = (part.ravel() for part in np.mgrid[1 : camera.height : EVERY_PX, 1 : camera.width : EVERY_PX])
    z = depth[rows, columns].astype(np.float64)
    here = np.stack([columns + 0.5, rows + 0.5], axis=1)[z > 0.0]
    z = z[z > 0.0]
    world = camera.unproject(here, z)
    ahead = following.depths(world)
    here, world, ahead = here[ahead > 0.0], world[ahead > 0.0], ahead[ahead > 0.0]
    there = following.project(world)
    inside = ((there >= 1.0) & (there <= [following.width - 1.0, following.height - 1.0])).all(axis=1)
    here, there, ahead = here[inside], there[inside], ahead[inside]
    column, row = there.astype(np.int64).T
    agree = np.abs(following_depth[row, column] / ahead - 1.0) < DEPTH_TOLERANCE
    return here[agree], there[agree]


def change(frame: PathFrame, following: PathFrame) -> Row:
    """Return the changes between two frames in the places that both show; 8-bit steps."""
    here, there = same_places(frame.camera, frame.depth, following.camera, following.depth)
    if len(here) == 0:
        return {"places": 0}
    column, row = here.astype(np.int64).T
    x, y = (part.astype(np.float32) - np.float32(0.5) for part in there.T)
    shape = (-(-len(x) // 1024), 1024)  # OpenCV accepts maps of fewer than 32,768 rows
    sampled = cv2.remap(following.pixels, np.resize(x, shape), np.resize(y, shape), cv2.INTER_LINEAR)
    colours = sampled.reshape(-1, 3)[: len(x)]
    step = colours.astype(np.float64) - frame.pixels[row, column]
    return {
        "places": len(here),
        "colour": float(np.median(np.abs(step).mean(axis=1))),
        "exposure": float(np.median(step @ LUMA)),
    }


class SceneClearance:
    """Distances to the nearest scene content, according to the photos."""

    def __init__(self, run: OpenedRun, cameras: Sequence[Camera]) -> None:
        points, tracks = load_points_and_tracks(run.parts["undistort.dataset"].path)
        self.seen = [points.xyz[tracks[camera.name]] for camera in cameras]
        self.medians = [_median(run.median_depth(camera)) for camera in cameras]

    def clearance_row(self, frame: PathFrame, index: int) -> Row:
        """Return how near a frame's content is, between photo ``index`` and the next."""
        points = np.vstack(self.seen[index : index + 2])
        _, _, z = frame.camera.in_view(points)
        limit = MIN_DEPTH_SHARE * float(np.quantile(z, NEAREST)) if z.size else 0.0
        photos = [median for median in self.medians[index : index + 2] if median is not None]
        median = _median(frame.depth)
        return {
            "depth_ratio": median / min(photos) if photos and median is not None else None,
            "in_the_air": float(((frame.depth > 0.0) & (frame.depth < limit)).mean()),
        }


def _median(depth: Depth) -> float | None:
    surface = depth[depth > 0.0]
    return float(np.median(surface)) if surface.size else None


def path(capture: PhotoTrack, cameras: Sequence[Camera], frames: int) -> list[tuple[float, Camera]]:
    """Return cameras along a smooth, level path through given cameras, with the first one's intrinsics.

    Args:
        capture: Capture that the cameras belong to.
        cameras: Cameras in path order, at least two, not all in one place.
        frames: At least two.

    Returns:
        Each frame's position along the path, counted in cameras from the first, and its camera.
    """
    distance = followed_photos(capture)[1]
    route = upright_route(cameras, capture.up)
    knots = centripetal_knots(route, distance)
    fine = np.linspace(0.0, knots[-1], FINE_STEPS + 1)
    even = evenly_timed(route_of(spline(route.values(), knots, fine)), distance, frames, frames / FPS)
    at = np.interp(even, np.arange(len(fine)), fine)
    along = cameras_along(route_of(spline(route.values(), knots, at)), FilmCamera(1, 1, 1.0), capture.up)
    places = np.interp(at, knots, np.arange(len(cameras))).tolist()
    found = [replace(cameras[0], cam_from_world=camera.cam_from_world) for camera in along]
    return list(zip(places, found, strict=True))


def nearest_first(cameras: Sequence[Camera]) -> list[Camera]:
    """Order cameras from the first, always continuing with the nearest remaining one."""
    ordered, left = [cameras[0]], list(cameras[1:])
    while left:
        here = ordered[-1].centre()
        ordered.append(left.pop(int(np.argmin([np.linalg.norm(camera.centre() - here) for camera in left]))))
    return ordered


def measure_path(run: OpenedRun, cameras: Sequence[Camera], frames: int, folder: Path) -> list[Row]:
    """Render and write the frames and their contact sheet; return a row per frame."""
    capture = open_scene({name: part.path for name, part in run.parts.items()}, 1, cpu()).capture
    surroundings = SceneClearance(run, cameras)
    rows: list[Row] = []
    small: list[Pixels] = []
    before: PathFrame | None = None
    for number, (place, camera) in enumerate(path(capture, cameras, frames)):
        frame = PathFrame(camera, run.picture(camera), run.median_depth(camera))
        index = min(int(place), len(cameras) - 2)
        names = " ".join(Path(photo.name).stem for photo in cameras[index : index + 2])
        row: Row = {"frame": number, "between": names, "luminance": float((frame.pixels @ LUMA).mean())}
        if before is not None:
            row |= {"step": row["luminance"] - rows[-1]["luminance"]} | change(before, frame)
        rows.append(row | surroundings.clearance_row(frame, index))
        write_png(folder / f"frame_{number:04d}.png", frame.pixels)
        height = max(1, round(SHEET_WIDTH * camera.height / camera.width))
        small.append(np.asarray(cv2.resize(frame.pixels, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA)))
        before = frame
    chosen = [small[k] for k in np.unique(np.linspace(0, frames - 1, min(frames, SHEET_FRAMES)).round().astype(int))]
    chosen += [np.zeros_like(small[0])] * (-len(chosen) % SHEET_COLUMNS)
    lines = [np.hstack(chosen[k : k + SHEET_COLUMNS]) for k in range(0, len(chosen), SHEET_COLUMNS)]
    write_png(folder / "sheet.png", np.vstack(lines))
    return rows


def summary(rows: Sequence[Row]) -> Row:
    """Summarise a path's rows."""
    followed = [row for row in rows if row.get("places")]
    crossing = [
        row["frame"]
        for row in rows
        if row["in_the_air"] > MAX_IN_THE_AIR_SHARE or (row["depth_ratio"] or math.inf) < MUCH_NEARER
    ]
    return {
        "frames": len(rows),
        "largest_step": max((abs(row["step"]) for row in rows[1:]), default=None),
        "largest_exposure": max((abs(row["exposure"]) for row in followed), default=None),
        "median_colour": float(np.median([row["colour"] for row in followed])) if followed else None,
        "largest_colour": max((row["colour"] for row in followed), default=None),
        "largest_in_the_air": max(row["in_the_air"] for row in rows),
        "crossing": crossing,
    }


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path, help="OUT of a run, up to training at least")
    options.add_argument("--frames", type=int, default=120)
    options.add_argument("--order", choices=("name", "nearest"), default="name", help="of the photos along the path")
    options.add_argument("--save", type=Path, default=Path("out/path_frames"), help="folder for frames and figures")
    options.add_argument("--threads", type=int, default=1)
    arguments = options.parse_args()
    if arguments.frames < 2:
        options.error("a path has two frames at least")
    try:
        run = open_run(arguments.out)
        cameras = [run.camera(view) for view in run.views]  # in name order, i.e. flight order
        if arguments.order == "nearest":
            cameras = nearest_first(cameras)
        arguments.save.mkdir(parents=True, exist_ok=True)
        with same_bits(arguments.threads):
            rows = measure_path(run, cameras, arguments.frames, arguments.save)
    except SplatpipeError as error:
        options.exit(error.exit_code, f"{error.message} {error.hint}\n")
    result = summary(rows)
    worst = sorted(rows, key=lambda row: max(abs(row.get("exposure", 0.0)), 100.0 * row["in_the_air"]), reverse=True)
    print_table("the frames that stand out most", worst[:TABLE_FRAMES], COLUMNS)
    print("\n".join(f"{name.replace('_', ' ')}: {_text(value)}" for name, value in result.items()))
    text = json.dumps({"summary": result, "frames": rows}, indent=1)
    (arguments.save / "path_frames.json").write_text(text + "\n", encoding="utf-8")


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
