"""A made site on a slope of 40 %, with errors like those of the demo's depths: its surface model, cloud and truth.

A level plot is cut into the slope, with a retaining wall behind it and a bank in front. A house stands on it, another
one on the slope itself; there are trees, a hedge, a car, and bushes. Nothing is seen under roofs, little under crowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int8

SLOPE = 0.4
BANK_SLOPE = 0.67  # two thirds: as steep as earth stands
PLOT = (-14.0, 14.0, -7.0, 7.0)  # west, east, south, north of the level plot, metres
RAMP_M = 6.0  # along the contour, over which the plot runs out at its western and eastern ends
LEVEL_M = 0.4  # of the undulation of the slope
NMAD_GSD = 0.3
FAR_SHARE, FAR_GSD = 0.01, 2.0  # of the errors: beyond 2 GSD
WILD_SHARE, WILD_GSD = 0.02, (5.0, 40.0)  # beyond 5 GSD
REACH_CELLS = 1.5  # sigma of the errors' correlation
GAPS_SHARE = 0.06  # of a crown's cells through which the ground is seen
WALL_STEP_GSD = 1.0  # between the cloud's points on walls
GROUND, HOUSE, TREE, THING = range(4)  # kinds of what a place shows
TREES = (  # east, north, radius of the crown, height of its middle over the ground, metres
    (-20.0, 14.0, 3.2, 6.0),
    (-12.0, 16.0, 2.4, 4.5),
    (-9.0, 18.5, 2.8, 5.0),
    (18.0, 15.0, 3.6, 7.0),
    (21.0, 9.0, 2.0, 3.5),
    (20.0, -15.0, 3.0, 5.5),
    (-21.0, -16.0, 3.4, 6.5),
    (-11.0, 4.0, 1.8, 3.2),
)
BOXES = (  # west, east, south, north, height over the ground at its middle, kind: a hedge, a car, bushes
    (-13.0, -12.0, -6.5, 2.0, 1.6, TREE),
    (9.5, 14.0, -5.0, -3.2, 1.5, THING),
    (-3.0, -1.5, -18.0, -16.5, 1.1, TREE),
    (4.0, 5.2, 19.0, 20.2, 0.9, TREE),
)
HOUSES = (  # west, east, south, north, height of the eaves over the ground at its middle, of the ridge over the eaves
    (-6.0, 4.0, -4.0, 4.0, 5.0, 2.5),
    (5.0, 13.0, 16.0, 23.0, 5.0, 2.0),
)

Cells = Float64[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class SlopeScene:
    """The site on a north-up grid.

    Attributes:
        gsd_m: GSD of the photos.
        cell_m: Cell size of the surface model.
        west: East of the grid's upper left corner, metres.
        north: North of that corner, metres.
        surface: Erroneous heights of the topmost surface, NaN where there are none.
        terrain: True heights of the ground everywhere.
        kind: What the topmost surface is: ``GROUND``, ``HOUSE``, ``TREE`` or ``THING``.
        points: Cloud with errors: east, north, up.
        point_kind: What each point lies on.
    """

    gsd_m: float
    cell_m: float
    west: float
    north: float
    surface: Cells
    terrain: Cells
    kind: Int8[np.ndarray, "h w"]
    points: Float64[np.ndarray, "n 3"]
    point_kind: Int8[np.ndarray, " n"]


def terrain_height(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Return the true heights of the ground, metres."""
    natural = SLOPE * north + LEVEL_M * np.sin(east / 9.0) * np.cos(north / 11.0)
    west, right, south, top = PLOT
    inside = np.clip(1.0 - np.maximum(west - east, east - right) / RAMP_M, 0.0, 1.0)
    filled = np.minimum(0.0, (north - south) * BANK_SLOPE)  # the plot at 0, and the bank in front of it
    plot = np.where(north <= top, np.where(north >= south, 0.0, filled), natural)
    shaped = np.where(north < south, np.maximum(natural, plot), plot)
    return np.asarray(natural + inside * (shaped - natural))


def slope_scene(gsd_m: float = 0.028, side_m: float = 56.0, seed: int = 50) -> SlopeScene:
    """Make the site.

    Args:
        gsd_m: GSD of the photos; the surface model's cells are twice as large.
        side_m: Side of the square around its middle.
        seed: Of the errors.
    """
    rng = np.random.default_rng(seed)
    cell, half = 2.0 * gsd_m, round(side_m / (4.0 * gsd_m))  # the grid's lines are multiples of its cell
    centres = (np.arange(2 * half) + 0.5 - half) * cell
    east, north = np.meshgrid(centres, -centres)
    terrain = terrain_height(east, north)
    top, kind = terrain.copy(), np.zeros(terrain.shape, np.int8)
    for box in BOXES:
        _raise(top, kind, _box_top(box, east, north, rng), box[5])
    for house in HOUSES:
        _raise(top, kind, _roof(house, east, north), HOUSE)
    under = np.zeros(terrain.shape, np.bool_)
    for tree in TREES:
        crown = _crown(tree, east, north, cell, rng)
        under |= np.isfinite(crown)
        seen = crown.copy()
        seen[_patches(terrain.shape, GAPS_SHARE, 2.0, rng)] = np.nan
        _raise(top, kind, seen, TREE)
    found = top + _errors(terrain.shape, gsd_m, rng)
    points = np.column_stack([east.ravel(), north.ravel(), found.ravel()])
    points[:, :2] += rng.uniform(-0.5, 0.5, (len(points), 2)) * cell
    walls = np.concatenate([_walls(house, gsd_m, rng) for house in HOUSES])
    every = np.concatenate([points, walls])
    kinds = np.concatenate([kind.ravel(), np.full(len(walls), HOUSE, np.int8)])
    hidden = _patches(terrain.shape, 0.01, 3.0, rng)
    return SlopeScene(
        gsd_m, cell, -half * cell, half * cell, np.where(hidden, np.nan, found), terrain, kind, every, kinds
    )


def _raise(top: Cells, kind: Int8[np.ndarray, "h w"], heights: Cells, what: int) -> None:
    higher = np.isfinite(heights) & (heights > top)
    top[higher], kind[higher] = heights[higher], what


def _roof(house: tuple[float, ...], east: Cells, north: Cells) -> Cells:
    west, right, south, top, eaves, ridge = house
    ground = float(terrain_height(np.array((west + right) / 2.0), np.array((south + top) / 2.0)))
    share = 1.0 - np.abs(north - (south + top) / 2.0) / ((top - south) / 2.0)
    inside = (east > west) & (east < right) & (share > 0.0)
    return np.where(inside, ground + eaves + ridge * share, np.nan)


def _box_top(box: tuple[float, ...], east: Cells, north: Cells, rng: np.random.Generator) -> Cells:
    west, right, south, top, height, kind = box
    inside = (east > west) & (east < right) & (north > south) & (north < top)
    rough = 0.08 * _field(east.shape, 3.0, rng) if kind == TREE else 0.0
    return np.where(inside, terrain_height(east, north) + height + rough, np.nan)


def _crown(tree: tuple[float, ...], east: Cells, north: Cells, cell: float, rng: np.random.Generator) -> Cells:
    x, y, radius, middle = tree
    off = 1.0 - (np.square(east - x) + np.square(north - y)) / radius**2
    rough = 0.12 * radius * _field(east.shape, 0.25 / cell, rng)
    base = float(terrain_height(np.array(x), np.array(y)))
    crown = base + middle + radius * np.sqrt(np.maximum(off, 0.0)) + rough
    return np.where(off > 0.0, np.maximum(crown, terrain_height(east, north) + 0.5), np.nan)


def _walls(house: tuple[float, ...], gsd_m: float, rng: np.random.Generator) -> Float64[np.ndarray, "n 3"]:
    """Points on the four walls, from the ground to the eaves, with errors across them."""
    west, right, south, top, eaves, _ = house
    ground = float(terrain_height(np.array((west + right) / 2.0), np.array((south + top) / 2.0)))
    step = WALL_STEP_GSD * gsd_m
    walls = []
    a, b, c, d = (west, south), (right, south), (right, top), (west, top)
    for (x0, y0), (x1, y1) in ((a, b), (d, c), (a, d), (b, c)):
        length = np.hypot(x1 - x0, y1 - y0)
        along, up = np.meshgrid(np.arange(0.0, length, step) / length, np.arange(0.0, 2.0 * eaves, step))
        east, north = x0 + (x1 - x0) * along.ravel(), y0 + (y1 - y0) * along.ravel()
        height = ground - eaves + up.ravel()
        seen = (height > terrain_height(east, north)) & (height < ground + eaves)
        off = rng.normal(0.0, 1.4826**-1 * NMAD_GSD * gsd_m, seen.sum())
        across = np.array([y1 - y0, x0 - x1]) / length
        walls.append(np.column_stack([east[seen] + off * across[0], north[seen] + off * across[1], height[seen]]))
    return np.concatenate(walls)


def _errors(shape: tuple[int, ...], gsd_m: float, rng: np.random.Generator) -> Cells:
    """Errors of heights: correlated, with small patches of far and of wild ones."""
    error = NMAD_GSD * _field(shape, REACH_CELLS, rng)
    for share, (low, high) in ((FAR_SHARE, (FAR_GSD, WILD_GSD[0])), (WILD_SHARE, WILD_GSD)):
        there = _patches(shape, share, REACH_CELLS, rng)
        error[there] = rng.uniform(low, high, int(there.sum())) * np.where(_field(shape, 6.0, rng)[there] > 0.0, 1, -1)
    return error * gsd_m


def _field(shape: tuple[int, ...], reach: float, rng: np.random.Generator) -> Cells:
    field = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), reach)
    return np.asarray(field / field.std())


def _patches(shape: tuple[int, ...], share: float, reach: float, rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    field = _field(shape, reach, rng)
    return np.asarray(field > np.quantile(field, 1.0 - share))
