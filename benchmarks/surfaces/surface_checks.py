"""Compare each product of a run with the demo's truth: rows of figures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from roof_edges import edge_distances, edge_figures
from surface_measures import figures, fitted_colours, harmonic, near_steps, psnr, reached, relief_errors, rmse
from surface_products import Facade, Points, Raster, colours
from surface_scene import GSD_M, STEP_CELLS, STEP_M, SceneTruth, TruthGrid, site_of, true_picture
from tables import Row
from triangle_distances import Surface, spread, surface_of, thinned

from splatpipe.demo import CAPTURE
from splatpipe.demo.truth.orthographic import AHEAD_M, MARGIN_M, facade_view, top_view, wall_planes
from splatpipe.demo.truth.parts import BRICKS, GROUND, HOUSE, PLAIN, SHEETED, SLATED, TILED
from splatpipe.demo.truth.relief import relief_in
from splatpipe.demo.truth.visibility import MIN_VIEWS, photos_that_see
from splatpipe.pipeline.photos.targets.quadrant_targets import find_quadrant_targets

TOLERANCE_GSD = 2.0  # for clouds and meshes
SAMPLES = 100_000  # points on the true surface and on a product: the standard deviation of a share is below 0.002
SPACING_M = 0.05  # between samples on the true surface
SEED = 18
TARGET_REACH_PX = 32  # half-size of the search window; a target is some 18 px
FOUND_PX = 12.0  # a detection farther off is another target, or false
SEEN_M = 0.05  # a target this far below the visible surface is hidden
# In front of or behind a wall's plane, what belongs to it: reveals, sills, frames, steps at the roof's edge.
WALL_M = 0.5
SAME_NORMAL = 0.9  # cosine between a façade's normal and its wall's
SAME_WALL_M = 2.0  # largest distance between their planes
WALL_PARTS = (HOUSE, PLAIN, BRICKS)
MAIN_ROOF_M = 4.3  # height of its eaves, less a little; the annex and the canopy are lower


def measure_dsm(site: TruthGrid, raster: Raster) -> list[Row]:
    """Return a row for all cells that count, one per class, and those counted separately."""
    found = site.cut(np.where(raster.there, raster.bands[0].astype(np.float64), np.nan), np.nan)
    errors = relief_errors(found, site.relief.height, site.relief.cosine)
    clear = site.below & ~site.steps
    counts, roofs = site.seen & clear, site.roofs | site.ground
    others = ~(site.ground | site.house)
    rows = {
        "roofs and ground": counts & roofs,
        "roofs": counts & site.roofs,
        "ground": counts & site.ground,
        "metal roof": counts & (site.parts == SHEETED),
        "apart: near steps": site.seen & site.below & site.steps & roofs,
        "apart: fewer than 3 photos": site.below & ~site.seen & roofs,
        "apart: trees and things": site.seen & site.below & others,
    }
    return [{"what": what} | figures(errors[mask], GSD_M) for what, mask in rows.items()]


def target_differences(
    site: TruthGrid, picture: UInt8[np.ndarray, "h w 3"], cell_m: float
) -> dict[str, Float64[np.ndarray, " 2"]]:
    """Return metres east and south from each target's true place to the orthophoto's; NaN where it is not found.

    Only targets that are truly visible from above, and in three photos.
    """
    points = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))["points"]
    apart = {}
    for point in points:
        if point["where"] == "wall":
            continue
        column, row, height = site.way(np.array([point["xyz_m"]]))[0]
        at = int(row), int(column)
        inside = 0 <= at[0] < picture.shape[0] and 0 <= at[1] < picture.shape[1]
        if inside and site.seen[at] and abs(site.relief.height[at] - height) < SEEN_M:
            apart[point["name"]] = target_difference(picture, np.array([column, row])) * cell_m
    return apart


def target_difference(
    picture: UInt8[np.ndarray, "h w 3"], place: Float64[np.ndarray, " 2"]
) -> Float64[np.ndarray, " 2"]:
    """Return the pixels from a place to the quadrant target detected there; NaN if there is none."""
    left, top = np.maximum(place.astype(int) - TARGET_REACH_PX, 0)
    crop = picture[top : top + 2 * TARGET_REACH_PX, left : left + 2 * TARGET_REACH_PX]
    found = [np.array([t.x + left, t.y + top]) - place for t in find_quadrant_targets(np.ascontiguousarray(crop))]
    near = min(found, key=lambda apart: float(np.hypot(*apart)), default=np.full(2, np.inf))
    return near if np.hypot(*near) <= FOUND_PX else np.full(2, np.nan)


def measure_ortho(site: TruthGrid, raster: Raster, true: Path | None) -> tuple[Row, list[Row]]:
    """Return the orthophoto's figures, and a row of contrasts per texture; without the true image only the targets.

    Args:
        site: The truth on the orthophoto's grid.
        raster: The orthophoto.
        true: Path of the true image from above.
    """
    picture, there = site.cut(colours(raster), 0), site.cut(raster.there, False)
    apart = target_differences(site, picture, raster.cell)
    places = np.array(list(apart.values())).reshape(-1, 2)
    off = rmse(places)
    row: Row = {"targets": len(apart), "found": int(np.isfinite(places).all(axis=1).sum())}
    row |= {"rmse": None if off is None else off / GSD_M, "complete": float(there[site.seen].mean())}
    if true is None:
        return row, []
    truth, whole = true_picture(true, top_view(), site)
    counts = site.seen & whole
    row["psnr"] = psnr(picture, truth, counts)
    row["psnr_cc"] = psnr(np.where(there[..., None], fitted_colours(picture, truth, counts & there), 0), truth, counts)
    main = site.house & (site.true_heights > MAIN_ROOF_M)
    distances = [edge_distances(picture, truth, roof, counts) for roof in (main, site.house & ~main)]
    row |= edge_figures(np.concatenate(distances))
    return row, _contrasts(site, picture, truth, counts)


def _contrasts(
    site: TruthGrid,
    picture: UInt8[np.ndarray, "h w 3"],
    truth: UInt8[np.ndarray, "h w 3"],
    counts: Bool[np.ndarray, "h w"],
) -> list[Row]:
    from texture_contrast import EDGE_PX  # imported here, since it loads torch
    from texture_contrast import figures as contrast_figures

    rows = []
    kernel = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    for name, part in {"tiles": TILED, "slates": SLATED, "metal roof": SHEETED, "ground": GROUND}.items():
        inner = cv2.erode((counts & (site.parts == part)).astype(np.uint8), kernel, borderValue=0) > 0
        rows.append({"texture": name} | contrast_figures([(truth, picture, inner)]))
    return rows


def matching(facades: list[Facade], name: str) -> Facade | None:
    """Return the elevation of a wall of the house; None if there is none."""
    wall, span, high = wall_planes()[name]
    middle = wall.point(span / 2.0, high / 2.0)
    near = []
    for facade in facades:
        normal = facade.axes()[2]
        off = abs(float((facade.corners.mean(axis=0) - middle) @ wall.n))
        if normal @ wall.n > SAME_NORMAL and off < SAME_WALL_M:
            near.append((float(np.linalg.norm(facade.corners.mean(axis=0) - middle)), len(near), facade))
    return min(near)[2] if near else None


def facade_errors(facade: Facade, points: Points, normals: Points) -> Float64[np.ndarray, " n"]:
    """Return distances along the true normal at points of the true surface, positive outside; NaN without a depth."""
    right, down, normal = facade.axes()
    axes = np.stack([right / (right @ right), down / (down @ down), normal])
    column, row, depth = ((points - facade.corners[0]) @ axes.T).T
    height, width = facade.depth.shape
    inside = (column >= 0.0) & (row >= 0.0) & (column < width) & (row < height)
    at = np.where(inside, row, 0.0).astype(np.intp), np.where(inside, column, 0.0).astype(np.intp)
    return np.asarray(np.where(inside, facade.depth[at] - depth, np.nan) * np.abs(normals @ normal))


def measure_facades(truth: SceneTruth, facades: list[Facade]) -> list[Row]:
    """Return a row per wall, one for all and one for the plain walls; a wall without an elevation counts as missing."""
    rows, every, plain = [], [], []
    for name, (wall, span, _high) in wall_planes().items():
        view = facade_view(name, GSD_M)
        relief = relief_in(view, truth.triangles)
        parts = np.where(relief.triangle >= 0, truth.parts[relief.triangle], -1)
        near = np.abs(relief.height + AHEAD_M[name]) < WALL_M
        clear = ~near_steps(relief.height, STEP_M, STEP_CELLS)
        row, column = np.nonzero(np.isin(parts, WALL_PARTS) & near & clear & (relief.cosine > 0.0))
        points = view.from_grid(np.column_stack([column + 0.5, row + 0.5, -relief.height[row, column]]))
        normals = truth.normals[relief.triangle[row, column]]
        seen = photos_that_see(points, normals, truth.true_views) >= MIN_VIEWS
        within = (points[seen] - wall.origin) @ wall.u
        assert within.size == 0 or (within.min() > -2.0 * MARGIN_M and within.max() < span + 2.0 * MARGIN_M)
        facade = matching(facades, name)
        errors = np.full(int(seen.sum()), np.nan)
        line: Row = {"what": name, "corners": None}
        if facade is not None:
            errors = facade_errors(facade, points[seen], normals[seen])
            line["corners"] = corner_distance(facade, wall.origin, wall.point(span, 0.0)) / GSD_M
        rows.append(line | figures(errors, GSD_M))
        every.append(errors)
        plain.append(errors[parts[row, column][seen] == PLAIN])
    worst = [row["corners"] for row in rows]
    whole: Row = {"what": "all walls", "corners": None if None in worst else max(worst)}
    rows.append(whole | figures(np.concatenate(every), GSD_M))
    return [*rows, {"what": "plain walls"} | figures(np.concatenate(plain), GSD_M)]


def corner_distance(facade: Facade, left: Float64[np.ndarray, " 3"], right: Float64[np.ndarray, " 3"]) -> float:
    """Return the largest plan distance between an elevation's four corners and the wall's, metres."""
    pairs = zip(facade.corners[:, :2], np.stack([left, right, right, left])[:, :2], strict=True)
    return max(float(np.linalg.norm(found - true)) for found, true in pairs)


def measure_points(
    truth: SceneTruth, surface: Surface, points: Points, distances_to: Callable[[Points], Float64[np.ndarray, " n"]]
) -> Row:
    """Return precision, recall and F1 at 2 GSD of a cloud, or of points sampled on a mesh.

    Args:
        truth: The scene.
        surface: Its triangles below the flight.
        points: Points of the product, in the truth's metres.
        distances_to: Distances from points of the true surface to the product.
    """
    rng = np.random.default_rng(SEED)
    own = thinned(points[truth.flown_over(points)], GSD_M)
    own = own[rng.permutation(len(own))[:SAMPLES]]
    bound = TOLERANCE_GSD * GSD_M
    precision = reached(surface.distances(own), bound)
    places = seen_places(truth, rng)
    recall = reached(distances_to(places), bound)
    figure: Row = {"points": len(points), "true places": len(places), "precision": precision, "recall": recall}
    return figure | {"f1": harmonic(precision, recall)}


def near_triangles(truth: SceneTruth) -> Bool[np.ndarray, " m"]:
    """Return the triangles that may lie partly below the flight."""
    (west, south), (east, north) = truth.flown_box
    x, y = truth.triangles[..., 0], truth.triangles[..., 1]
    return np.asarray(
        (x.max(axis=1) > west) & (x.min(axis=1) < east) & (y.max(axis=1) > south) & (y.min(axis=1) < north)
    )


def seen_places(truth: SceneTruth, rng: np.random.Generator) -> Points:
    """Sample the true surface below the flight where at least three photos see it, at a uniform density."""
    rows = np.flatnonzero(near_triangles(truth))
    places, of = spread(truth.triangles[rows], 3 * SAMPLES, rng)
    below = truth.flown_over(places)
    places, of = places[below][:SAMPLES], rows[of[below]][:SAMPLES]
    return places[photos_that_see(places, truth.normals[of], truth.true_views) >= MIN_VIEWS]


def true_surface_of(truth: SceneTruth) -> Surface:
    """Return the surface that precision is measured against."""
    return surface_of(truth.triangles[near_triangles(truth)], SPACING_M, np.random.default_rng(SEED))


def ortho_site(truth: SceneTruth, raster: Raster, crs_from_true: Callable[[Points], Points]) -> TruthGrid:
    """Return the truth on an orthophoto's grid; visibility in the photos is computed per block of 4 × 4 pixels."""
    return site_of(truth, raster, crs_from_true, every=4)
