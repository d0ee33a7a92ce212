"""The demo's truth on a product's own grid: heights, parts, the places that count, and the true image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, UInt8
from PIL import Image
from scipy.spatial import Delaunay
from surface_measures import near_steps
from surface_products import Points, Raster

from splatpipe.demo.photography.parallel_view import ParallelView
from splatpipe.demo.truth.parts import BRICKS, GROUND, HOUSE, PLAIN, SHEETED, SLATED, TILED, parts_of, unit_normals
from splatpipe.demo.truth.relief import Relief, surface_model
from splatpipe.demo.truth.truth import Triangles, centre, true_poses, true_surface
from splatpipe.demo.truth.visibility import MIN_VIEWS, TrueView, photos_that_see, true_views

GSD_M = 0.028  # ground sample distance of the original photos at the house
STEP_M = 4.0 * GSD_M  # more than roofs (slope 0.9) rise between cells of 2 GSD; chimneys, dormers and walls are higher
STEP_CELLS = 2
ROOF_UP = 0.5  # upward component of a roof's normal: 60°
ROOF_M = 2.0  # height of the lowest roof, less a little; excludes steps and sills
BUILT = (HOUSE, TILED, SLATED, SHEETED, PLAIN, BRICKS)
BOX = np.array([[x, y, z] for x in (-24.0, 24.0) for y in (-24.0, 24.0) for z in (0.0, 11.0)])  # region of interest
STRAIGHT_M = 2e-3  # deviation from linearity allowed in the transform to a CRS within that box
LINEAR_OF_CODED = np.where(
    np.arange(256) <= 10, np.arange(256) / 255.0 / 12.92, ((np.arange(256) / 255.0 + 0.055) / 1.055) ** 2.4
).astype(np.float32)  # sRGB, IEC 61966-2-1


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """The demo scene and its flight.

    Attributes:
        triangles: Triangles of the whole scene.
        parts: The part that each triangle belongs to.
        true_views: What the photos truly see.
    """

    triangles: Triangles
    parts: Int8[np.ndarray, " m"]
    true_views: list[TrueView]

    @cached_property
    def normals(self) -> Float64[np.ndarray, "m 3"]:
        """Return unit normals of the triangles."""
        return unit_normals(self.triangles)

    @cached_property
    def _flown(self) -> Delaunay:
        return Delaunay(np.array([centre(pose)[:2] for pose in true_poses().values()]))

    def flown_over(self, points: Points) -> Bool[np.ndarray, " n"]:
        """Return which places lie below the flight: within the cameras' convex hull in plan. Nothing else counts."""
        return np.asarray(self._flown.find_simplex(points[:, :2]) >= 0)

    @property
    def flown_box(self) -> Float64[np.ndarray, "2 2"]:
        """Return the least and largest east and north of that hull."""
        return np.stack([self._flown.points.min(axis=0), self._flown.points.max(axis=0)])


def load_truth(depths: Path | None = None) -> SceneTruth:
    """Load the capture's truth; for the depths see ``true_views``."""
    triangles = true_surface()
    return SceneTruth(triangles, parts_of(triangles), true_views(triangles, depths))


@dataclass(frozen=True)
class AffineMap:
    """An affine map of points and its inverse: a frame's axes and zero.

    Attributes:
        matrix: (3, 3).
        offset: (3,).
    """

    matrix: Float64[np.ndarray, "3 3"]
    offset: Float64[np.ndarray, " 3"]

    def __call__(self, points: Points) -> Points:
        return np.asarray(points @ self.matrix.T + self.offset)

    def back(self, points: Points) -> Points:
        """Apply the inverse map."""
        return np.asarray(np.linalg.solve(self.matrix, (points - self.offset).T).T)


def straight(way: Callable[[Points], Points], cell: float) -> AffineMap:
    """Return the affine map that a transform is equal to within the scene.

    Args:
        way: Transform from the truth's metres to a grid's cells and metres of height.
        cell: Size of a cell, metres.
    """
    there = way(BOX)
    known = np.column_stack([BOX, np.ones(len(BOX))])
    solved = np.linalg.lstsq(known, there, rcond=None)[0]
    off = np.abs(known @ solved - there) * [cell, cell, 1.0]
    assert off.max() < STRAIGHT_M, off.max()
    return AffineMap(solved[:3].T, solved[3])


@dataclass(frozen=True, eq=False)
class TruthGrid:
    """The truth on the part of a product's grid that was flown over.

    Attributes:
        truth: The scene.
        way: Map from the truth's metres to column and row of this part, and height.
        left: Product column of this part's first column; may be negative.
        top: Product row of this part's first row; may be negative.
        relief: True heights.
        seen: Where at least three photos truly see the surface, below the flight.
        below: Mask of places below the flight.
    """

    truth: SceneTruth
    way: AffineMap
    left: int
    top: int
    relief: Relief
    seen: Bool[np.ndarray, "h w"]
    below: Bool[np.ndarray, "h w"]

    @cached_property
    def parts(self) -> Int8[np.ndarray, "h w"]:
        """Return the part at each cell; -1 where there is nothing."""
        return np.where(self.relief.triangle >= 0, self.truth.parts[self.relief.triangle], np.int8(-1))

    @cached_property
    def _up(self) -> Float64[np.ndarray, "h w"]:
        return np.asarray(np.abs(self.truth.normals[self.relief.triangle, 2]))

    @cached_property
    def true_heights(self) -> Float64[np.ndarray, "h w"]:
        """Return heights in the truth's own frame: a roof's height above the plot."""
        rows, columns = np.indices(self.relief.height.shape)
        places = np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5, self.relief.height.ravel()])
        places[:, 2] = np.where(np.isfinite(places[:, 2]), places[:, 2], 0.0)
        return self.way.back(places)[:, 2].reshape(rows.shape)

    @cached_property
    def ground(self) -> Bool[np.ndarray, "h w"]:
        """Return the cells of the plot."""
        return np.asarray(self.parts == GROUND)

    @cached_property
    def roofs(self) -> Bool[np.ndarray, "h w"]:
        """Return the house's cells that face up and are above head height: slopes, and what lies on them."""
        return np.asarray(np.isin(self.parts, BUILT) & (self._up > ROOF_UP) & (self.true_heights > ROOF_M))

    @cached_property
    def house(self) -> Bool[np.ndarray, "h w"]:
        """Return all cells of the house at that height."""
        return np.asarray(np.isin(self.parts, BUILT) & (self.true_heights > ROOF_M))

    @cached_property
    def steps(self) -> Bool[np.ndarray, "h w"]:
        """Return the cells within two of a height step."""
        return near_steps(self.relief.height, STEP_M, STEP_CELLS)

    def cut(self, band: np.ndarray, fill: float) -> np.ndarray:
        """Cut this part out of a product's band; cells outside the product get the fill value."""
        height, width = self.relief.height.shape
        part = np.full((height, width, *band.shape[2:]), fill, band.dtype)
        top, left = max(0, self.top), max(0, self.left)
        bottom, right = min(band.shape[0], self.top + height), min(band.shape[1], self.left + width)
        if bottom > top and right > left:
            rows, columns = slice(top - self.top, bottom - self.top), slice(left - self.left, right - self.left)
            part[rows, columns] = band[top:bottom, left:right]
        return part


def site_of(truth: SceneTruth, raster: Raster, crs_from_true: Callable[[Points], Points], every: int = 1) -> TruthGrid:
    """Compute the truth on a product's grid.

    Args:
        truth: The scene.
        raster: The product.
        crs_from_true: From the truth's metres to its CRS.
        every: Side of the cell blocks that share one visibility test.
    """
    whole = straight(lambda points: raster.to_grid(crs_from_true(points)), raster.cell)
    (west, south), (east, north) = truth.flown_box
    corners = whole(np.array([[x, y, 0.0] for x in (west, east) for y in (south, north)]))[:, :2]
    (left, top), (right, bottom) = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    way = AffineMap(whole.matrix, whole.offset - [left, top, 0.0])
    relief = surface_model(truth.triangles, way, int(right - left), int(bottom - top), raster.cell)
    seen, below = _seen(truth, relief, way, every)
    return TruthGrid(truth, way, int(left), int(top), relief, seen, below)


def _seen(
    truth: SceneTruth, relief: Relief, way: AffineMap, every: int
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    height, width = relief.height.shape
    row, column = np.mgrid[every // 2 : height + every // 2 : every, every // 2 : width + every // 2 : every]
    row, column = np.minimum(row, height - 1), np.minimum(column, width - 1)
    hit = relief.triangle[row, column].ravel()
    heights = np.where(hit >= 0, relief.height[row, column].ravel(), 0.0)
    places = way.back(np.column_stack([column.ravel() + 0.5, row.ravel() + 0.5, heights]))
    below = truth.flown_over(places) & (hit >= 0)
    count = np.zeros(len(places), np.uint8)
    count[below] = photos_that_see(places[below], truth.normals[hit[below]], truth.true_views)
    pair = ((count >= MIN_VIEWS).reshape(row.shape), below.reshape(row.shape))
    seen, flown = (np.kron(each, np.ones((every, every), bool))[:height, :width] for each in pair)
    return seen, flown


def true_picture(
    path: Path, view: ParallelView, site: TruthGrid
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Return the true image on a site's grid, each pixel the mean of its light, and the mask of its valid pixels.

    Args:
        path: An image by ``demo.truth.orthographic``.
        view: Its view, except for the pixel size.
        site: The product's grid.
    """
    coded = np.asarray(Image.open(path).convert("RGB"))
    own = view.resampled(view.pixel_m * view.width / coded.shape[1])
    height, width = site.relief.height.shape
    corners = np.array([[0.0, 0.0, 0.0], [width, 0.0, 0.0], [0.0, height, 0.0]])
    places = own.to_grid(site.way.back(corners))[:, :2]
    steps = (places[1:] - places[0]) / [[width], [height]]
    fine = max(1, round(float(np.linalg.norm(steps[0]))))  # samples per pixel and side
    light = LINEAR_OF_CODED[coded]
    matrix = np.column_stack([steps[0] / fine, steps[1] / fine, places[0] - 0.5 + (steps[0] + steps[1]) / fine / 2.0])
    size, flags = (width * fine, height * fine), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(light, matrix, size, flags=flags, borderValue=(-1.0, -1.0, -1.0))
    mean = cv2.resize(warped, (width, height), interpolation=cv2.INTER_AREA)
    beside = cv2.dilate((warped[..., 0] < 0.0).astype(np.float32), np.ones((3, 3), np.uint8))
    whole = cv2.resize(beside, (width, height), interpolation=cv2.INTER_AREA) == 0.0
    return coded_of(np.maximum(mean, 0.0)), np.asarray(whole)


def coded_of(light: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Encode linear light, 0 to 1, as 8-bit sRGB."""
    values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.asarray(np.clip(values * 255.0 + 0.5, 0.0, 255.0), np.uint8)
