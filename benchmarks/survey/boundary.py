"""Measure what a boundary around the demo's house costs and saves: ``boundary WHOLE BOUNDED --save FOLDER``.

WHOLE and BOUNDED are OUTs of runs on the demo capture that differ only in the boundary; ``boundary --draw FILE``
writes it: the house's outline in plan, grown by a metre. The pixels that count are those of held-out views whose true
surface (the first triangle of the true mesh on their ray) lies inside the true outline. Both runs are measured on the
same pixels, so the splats do not influence the selection.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64
from opened_run import OpenedRun, open_run, write_png
from scipy.spatial import ConvexHull
from tables import Row, print_table

from splatpipe.demo.photography.geodesy import Origin
from splatpipe.demo.site.scene import building_corners
from splatpipe.demo.truth.truth import depth_map, true_poses, true_surface, truth_from_model
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import PlanArea, Ring, read_model_area
from splatpipe.pipeline.photos.pixels.images import reduced_view
from splatpipe.pipeline.raster.threads import same_bits

MARGIN_M = 1.0  # around the house, as if drawn by hand on a map
CORNER_STEPS = 16  # corners of the polygon that stands for the circle by which the outline is grown
COLUMNS = {
    "view": "view:",
    "inside": "inside:.3f",
    "whole dB": "whole:.3f",
    "bounded dB": "bounded:.3f",
    "lost dB": "lost:.3f",
    "outside: whole": "whole_outside:.2f",
    "bounded": "bounded_outside:.2f",
}


def outline() -> Ring:
    """Return the boundary in the true frame: the house's convex hull in plan, grown by the margin; metres."""
    turns = 2.0 * math.pi * np.arange(CORNER_STEPS) / CORNER_STEPS
    circle = MARGIN_M * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    grown = (building_corners().reshape(-1, 3)[:, None, :2] + circle).reshape(-1, 2)
    return np.asarray(grown[ConvexHull(grown).vertices])


def geojson() -> str:
    """Return the boundary as a user would save it: WGS 84, longitude first."""
    ring = outline()
    places = Origin().geodetic(np.column_stack([ring, np.zeros(len(ring))]))
    closed = [[round(x, 9), round(y, 9)] for y, x in [*places[:, :2].tolist(), places[0, :2].tolist()]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [closed]}}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n"


def true_inside(camera: Camera, surface: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Mask the pixels whose true surface lies inside the boundary.

    Args:
        camera: Camera in the true frame.
        surface: Triangles of the true mesh.
    """
    depth = depth_map(camera, surface)
    hit = np.isfinite(depth)
    rows, columns = np.nonzero(hit)
    places = camera.unproject(np.stack([columns + 0.5, rows + 0.5], axis=1), depth[rows, columns])
    inside = np.zeros(hit.shape, np.bool_)
    inside[rows, columns] = PlanArea.seen_from_above([(outline(),)]).contains(places)
    return inside


def measured(
    run: OpenedRun, save: Path | None
) -> dict[str, tuple[Float64[np.ndarray, " 2"], Float64[np.ndarray, " 2"]]]:
    """Return the sum of squared errors and the pixel count of each held-out view, inside and outside."""
    truth = truth_from_model({view.camera.name: view.camera.cam_from_world for view in run.views})
    surface = true_surface()
    found = {}
    for view in run.views:
        if view.camera.name not in run.held_out:
            continue
        camera, photo, mask = reduced_view(view, run.megapixels)
        inside = true_inside(replace(camera, cam_from_world=truth.camera_pose(camera.cam_from_world)), surface)
        render = run.picture(camera)
        errors = np.square((render.astype(np.float64) - photo) / 255.0).mean(axis=2)
        valid = np.ones(inside.shape, np.bool_) if mask is None else mask
        parts = [rows & valid for rows in (inside, ~inside)]
        found[view.camera.name] = (
            np.array([errors[rows].sum() for rows in parts]),
            np.array([rows.sum() for rows in parts], np.float64),
        )
        if save is not None:
            dim = np.where(inside[:, :, None], render, render // 2)
            write_png(save / f"{Path(view.camera.name).stem}.png", np.hstack([photo, render, dim]))
    return found


def decibels(squares: float, pixels: float) -> float:
    """Return the PSNR for a sum of squared errors."""
    return -10.0 * math.log10(squares / pixels) if pixels and squares else math.nan


def compared(whole: OpenedRun, bounded: OpenedRun, save: Path) -> list[Row]:
    """Return a row per held-out view, and one with the mean over views."""
    (save / "whole").mkdir(parents=True, exist_ok=True), (save / "bounded").mkdir(exist_ok=True)
    both = [measured(run, save / name) for name, run in (("whole", whole), ("bounded", bounded))]
    rows: list[Row] = []
    for name, (squares, pixels) in both[0].items():
        row: Row = {"view": name, "inside": pixels[0] / pixels.sum()}
        for label, (sums, counts) in (("whole", (squares, pixels)), ("bounded", both[1][name])):
            row[label], row[f"{label}_outside"] = (decibels(sums[k], counts[k]) for k in (0, 1))
        rows.append(row | {"lost": row["whole"] - row["bounded"]})
    figures = [key for key in rows[0] if key != "view"]
    return [*rows, {"view": "mean", **{key: float(np.nanmean([row[key] for row in rows])) for key in figures}}]


def counts(run: OpenedRun, area: PlanArea) -> tuple[int, int]:
    """Count the Gaussians inside the boundary, and all of them."""
    means = run.model[0].means.double().numpy()
    return int(area.contains(means).sum()), len(means)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("outs", type=Path, nargs="*", help="OUT without, OUT with the boundary")
    options.add_argument("--draw", type=Path, help="write the boundary, and nothing else")
    options.add_argument("--save", type=Path, default=Path("out/boundary"), help="folder for pictures")
    options.add_argument("--threads", type=int, default=1)
    arguments = options.parse_args()
    if arguments.draw is not None:
        arguments.draw.write_text(geojson(), encoding="utf-8")
        return
    try:
        if len(arguments.outs) != 2:
            raise UsageError("Two OUTs are compared: one without, one with the boundary.")
        whole, bounded = (open_run(out) for out in arguments.outs)
        area = read_model_area(bounded.parts["georef.boundary"].path)
        if area is None or not {view.camera.name for view in whole.views} <= true_poses().keys():
            raise UsageError(f"{bounded.out} is no run of the demo capture with a boundary.")
        with same_bits(arguments.threads):
            rows = compared(whole, bounded, arguments.save)
    except SplatpipeError as error:
        options.exit(error.exit_code, f"{error.message} {error.hint}\n")
    print_table("pixels whose true surface lies inside the boundary", rows, COLUMNS)
    (inside, every), (kept, fewer) = counts(whole, area), counts(bounded, area)
    print(f"whole: {every:,} Gaussians, {inside:,} inside; bounded: {fewer:,}, {kept:,} inside; {fewer / every:.1%}")


if __name__ == "__main__":
    main()
