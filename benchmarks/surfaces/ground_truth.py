"""Compare a run's terrain model and classified cloud with the demo's truth: ``ground_truth OUT``, or ``--slope``.

OUT is a run on the demo capture with its control, with ``dtm.tif`` and, for the classes, ``cloud.laz``. Places count if
they lie below the flight. A point of the cloud is ground, house, foliage or something else by the nearest true surface;
points farther than 5 GSD from any are not counted. Heights are compared along plumb lines: open ground is what three
photos see of the plot from above, and the plot goes on under house and trees.

``--slope`` makes the same tables for the made slope of ``slope_scene``.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import laspy
import numpy as np
from jaxtyping import Bool, Float64, Int8, UInt8
from scipy.spatial import cKDTree
from slope_products import classified_slope
from slope_scene import GROUND as SLOPE_GROUND
from slope_scene import HOUSE as SLOPE_HOUSE
from slope_scene import TREE as SLOPE_TREE
from slope_scene import slope_scene
from surface_checks import GSD_M, SEED, near_triangles
from surface_products import ProductTransform, frames_of, read_raster
from surface_scene import BUILT, SceneTruth, load_truth, site_of
from tables import Row, print_table
from triangle_distances import spread

from splatpipe.demo.truth.parts import FOLIAGE, GROUND
from splatpipe.pipeline.engine.errors import SplatpipeError

FAR_GSD = 5.0  # points farther from any true surface are noise
SAMPLES_PER_M2 = 4000.0  # on the true surface: a spacing of half a GSD
MAX_SAMPLES = 12_000_000
NOISE = (7, 18)
GROUND_CLASS, BUILDING_CLASS = 2, 6
CLASSES = {"what": "what:", "points": "points:,", "share": "share:.4f", "bound": "bound:", "holds": "holds:"}
HEIGHTS = {"what": "what:", "cells": "cells:,", "RMSE GSD": "rmse:.2f", "p90 GSD": "p90:.2f", "p95 GSD": "p95:.2f"}
HEIGHTS |= {"complete": "complete:.4f", "bound": "bound:", "holds": "holds:"}

Shares = dict[str, tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"], float, bool]]


def class_rows(
    ground: Bool[np.ndarray, " n"],
    house: Bool[np.ndarray, " n"],
    foliage: Bool[np.ndarray, " n"],
    classes: UInt8[np.ndarray, " n"],
    bounds: tuple[float, float],
) -> list[Row]:
    """Return the shares of wrong classes, each with its bound.

    Args:
        ground: Which points are truly ground.
        house: Which are truly the house.
        foliage: Which are truly trees, bushes or hedges; the rest is something else.
        classes: The points' classes.
        bounds: Of ground taken for object, and of objects taken for ground.
    """
    is_object = ~np.isin(classes, [GROUND_CLASS, *NOISE])
    shares: Shares = {
        "ground taken for object": (ground, is_object, bounds[0], False),
        "objects taken for ground": (~ground, classes == GROUND_CLASS, bounds[1], False),
        "house in class 6": (house, classes == BUILDING_CLASS, 0.85, True),
        "trees and hedges in class 6": (foliage, classes == BUILDING_CLASS, 0.10, False),
    }
    rows = []
    for what, (of, those, bound, least) in shares.items():
        share = float(those[of].mean())
        holds = share >= bound if least else share <= bound
        rows.append({"what": what, "points": int(of.sum()), "share": share, "bound": bound, "holds": holds})
    return rows


def height_row(what: str, errors_gsd: Float64[np.ndarray, " n"], bound: str, holds: bool) -> Row:
    """Return the figures of a terrain's errors, NaN where it has no height."""
    known = errors_gsd[np.isfinite(errors_gsd)]
    row: Row = {"what": what, "cells": len(errors_gsd), "complete": len(known) / max(1, len(errors_gsd))}
    row |= {"rmse": float(np.sqrt(np.mean(known**2))), "bound": bound, "holds": holds}
    return row | {f"p{p}": float(np.quantile(np.abs(known), p / 100.0)) for p in (90, 95)}


def rmse_row(what: str, errors_gsd: Float64[np.ndarray, " n"], bound: float) -> Row:
    """Return a row that demands a root mean square error in GSD."""
    known = errors_gsd[np.isfinite(errors_gsd)]
    return height_row(what, errors_gsd, f"RMSE {bound:g}", bool(np.sqrt(np.mean(known**2)) <= bound))


def within_row(what: str, errors_gsd: Float64[np.ndarray, " n"], share: float, bound: float) -> Row:
    """Return a row that demands a share of the cells within some GSD; missing ones are beyond."""
    holds = bool((np.abs(errors_gsd) <= bound).mean() >= share)
    return height_row(what, errors_gsd, f"{share:.0%} in {bound:g}", holds)


def demo_heights(out: Path, truth: SceneTruth, frames: ProductTransform) -> list[Row]:
    """Return the terrain's errors on open ground, and under house and foliage."""
    raster = read_raster(out / "dtm.tif")
    site = site_of(truth, raster, frames.crs_from_true, every=4)
    found = site.cut(np.where(raster.there, raster.bands[0].astype(np.float64), np.nan), np.nan)
    flat = np.array([[x, y, 0.0] for x in (-20.0, 20.0) for y in (-20.0, 20.0)])
    on_grid = site.way(flat)
    plane = np.linalg.lstsq(np.column_stack([on_grid[:, :2], np.ones(4)]), on_grid[:, 2], rcond=None)[0]
    rows, columns = np.indices(found.shape)
    true = (columns + 0.5) * plane[0] + (rows + 0.5) * plane[1] + plane[2]
    errors = (found - true) / GSD_M
    under = site.below & np.isin(site.parts, [*BUILT, FOLIAGE])
    return [
        rmse_row("open ground", errors[site.ground & site.seen], 1.0),
        rmse_row("under house and trees", errors[under], 5.0),
    ]


def demo_classes(out: Path, truth: SceneTruth, frames: ProductTransform) -> list[Row]:
    """Return the shares of wrongly classified points of the cloud."""
    cloud = laspy.read(out / "cloud.laz")
    points, classes = frames.true_from_crs(np.asarray(cloud.xyz, np.float64)), np.asarray(cloud.classification)
    parts = nearest_parts(truth, points)
    counts = (parts >= 0) & truth.flown_over(points)
    parts, classes = parts[counts], classes[counts]
    return class_rows(parts == GROUND, np.isin(parts, BUILT), parts == FOLIAGE, classes, (0.03, 0.05))


def nearest_parts(truth: SceneTruth, points: Float64[np.ndarray, "n 3"]) -> Int8[np.ndarray, " n"]:
    """Return the part of the true surface nearest to each point; -1 where that is far."""
    rows = np.flatnonzero(near_triangles(truth))
    corners = truth.triangles[rows]
    corners = corners[(np.abs(corners.reshape(len(rows), -1)).max(axis=1) < 200.0)]
    rows = rows[(np.abs(truth.triangles[rows].reshape(len(rows), -1)).max(axis=1) < 200.0)]
    area = float(0.5 * np.linalg.norm(np.cross(*(corners[:, k] - corners[:, 0] for k in (1, 2))), axis=1).sum())
    count = min(MAX_SAMPLES, round(area * SAMPLES_PER_M2))
    places, of = spread(corners, count, np.random.default_rng(SEED))
    away, nearest = cKDTree(places, balanced_tree=False).query(points)
    return np.where(away <= FAR_GSD * GSD_M, truth.parts[rows[of[nearest]]], -1).astype(np.int8)


def measure_demo(out: Path) -> dict[str, list[Row]]:
    """Return the tables of a run on the demo capture."""
    truth = load_truth()
    raster = read_raster(out / "dtm.tif")
    frames = frames_of(out, raster.crs, "none")
    tables = {"heights": demo_heights(out, truth, frames)}
    return tables | ({"classes": demo_classes(out, truth, frames)} if (out / "cloud.laz").is_file() else {})


def measure_slope(gsd_m: float, side_m: float) -> dict[str, list[Row]]:
    """Return the tables of the made slope."""
    scene = slope_scene(gsd_m, side_m)
    with tempfile.TemporaryDirectory() as folder:
        made = classified_slope(scene, Path(folder))
    errors = (made.terrain - scene.terrain) / gsd_m
    is_open = scene.kind == SLOPE_GROUND
    kinds = scene.point_kind
    return {
        "heights": [
            within_row("open ground", errors[is_open], 0.95, 4.0),
            within_row("under house and trees", errors[~is_open], 0.90, 15.0),
        ],
        "classes": class_rows(
            kinds == SLOPE_GROUND, kinds == SLOPE_HOUSE, kinds == SLOPE_TREE, made.classes, (0.05, 0.10)
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", help="OUT of a run on the demo capture")
    parser.add_argument("--slope", action="store_true", help="the made slope instead")
    parser.add_argument("--gsd", type=float, default=GSD_M, help="of the made slope, metres")
    parser.add_argument("--side", type=float, default=56.0, help="of the made slope, metres")
    arguments = parser.parse_args()
    if (arguments.out is None) != arguments.slope:
        parser.error("give OUT, or --slope")
    try:
        tables = measure_slope(arguments.gsd, arguments.side) if arguments.slope else measure_demo(arguments.out)
    except SplatpipeError as error:
        parser.exit(error.exit_code, f"{error.message} {error.hint}\n")
    for name, rows in tables.items():
        print_table(name, rows, {"heights": HEIGHTS, "classes": CLASSES}[name])


if __name__ == "__main__":
    main()
