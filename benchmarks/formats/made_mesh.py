"""A textured mesh that is made: hills and a block without holes, in charts, with a pattern on its pages."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh, TriangleMesh
from splatpipe.pipeline.surface.texture.textured_mesh import Atlas, TexturedMesh, page_paths

SIDE_M = 120.0
BLOCK = ((-6.0, 6.0), (-4.0, 4.0), 5.0)  # of SIDE_M / 40: west and east, south and north, height
SHAKEN = 0.3  # of a cell, by which vertices lie beside their grid
CHART_CELLS = 50
BORDER_PX = 4
SQUARE_PX = 32
QUALITY = 90


def site_height(places: np.ndarray, side_m: float = SIDE_M) -> np.ndarray:
    """Return the height of the hills and the block at places in plan."""
    scale = side_m / 40.0
    x, y = places.T
    hills = 1.5 * scale * np.sin(x / (6.0 * scale)) * np.cos(y / (9.0 * scale))
    (west, east), (south, north), height = BLOCK
    inside = (x > west * scale) & (x < east * scale) & (y > south * scale) & (y < north * scale)
    return np.asarray(hills + np.where(inside, height * scale, 0.0))


def made_site(folder: Path, cells: int = 400, page_px: int = 4096, side_m: float = SIDE_M) -> TexturedMesh:
    """Make the mesh, and its pages in a folder.

    Args:
        folder: For the pages; a folder ``mesh`` is made in it.
        cells: Of the mesh's grid, per side: a multiple of ``CHART_CELLS``.
        page_px: Side of its one page.
        side_m: Side of the site, in the middle of which is the origin.
    """
    random = np.random.default_rng(1)
    at = np.linspace(-side_m / 2.0, side_m / 2.0, cells + 1)
    plan = np.stack(np.meshgrid(at, at), axis=-1)
    plan[1:-1, 1:-1] += SHAKEN * side_m / cells * random.uniform(-1.0, 1.0, (cells - 1, cells - 1, 2))
    vertices = np.dstack([plan, site_height(plan.reshape(-1, 2), side_m).reshape(plan.shape[:2])]).reshape(-1, 3)
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (each.ravel() for each in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    triangles = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    row, column = np.divmod(np.tile(np.arange(cells**2), 2), cells)
    across = cells // CHART_CELLS
    chart = row // CHART_CELLS * across + column // CHART_CELLS
    size = page_px // across
    corners = _corners(vertices[triangles, :2], chart, (across, size, side_m))
    rects = np.array([[0, k % across * size, k // across * size, size, size] for k in range(across**2)], np.int32)
    (folder / "mesh").mkdir(parents=True)
    (page,) = page_paths(folder / "mesh", 1)
    cv2.imwrite(str(page), _pattern(across, size), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    atlas = Atlas(corners.astype(np.float32), chart.astype(np.int32), rects, np.array([[across * size] * 2], np.int32))
    colours = np.full((len(vertices), 3), 128, np.uint8)
    return TexturedMesh(ColouredMesh(TriangleMesh(vertices, triangles), colours), atlas, (page,))


def _corners(plan: np.ndarray, chart: np.ndarray, layout: tuple[int, int, float]) -> np.ndarray:
    """Each chart fills its square of the page, north up, but for a border."""
    across, size, side_m = layout
    chart_m = side_m / across
    south_west = np.stack([chart % across, chart // across], axis=1) * chart_m - side_m / 2.0
    share = (plan - south_west[:, None]) / chart_m  # a little beyond 0..1 at shaken borders
    inner = size - 2 * BORDER_PX - 2 * SHAKEN * size / CHART_CELLS
    start = BORDER_PX + SHAKEN * size / CHART_CELLS
    left, top = chart % across * size, chart // across * size
    return np.stack(
        [left[:, None] + start + share[..., 0] * inner, top[:, None] + size - start - share[..., 1] * inner], axis=-1
    )


def _pattern(across: int, size: int) -> np.ndarray:
    """A chequered page with a colour for each chart."""
    page = np.zeros((across * size, across * size, 3), np.uint8)
    rows, columns = np.mgrid[:size, :size] // SQUARE_PX
    dark = ((rows + columns) % 2 == 1)[..., None]
    for k in range(across**2):
        colour = np.array([k * 53, k * 97, k * 151]) % 160 + 60
        top, left = k // across * size, k % across * size
        page[top : top + size, left : left + size] = np.where(dark, colour, colour // 2 + 20)
    return page
