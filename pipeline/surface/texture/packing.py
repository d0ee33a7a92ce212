"""Packing charts into pages: shelves of decreasing height (Coffman et al., SIAM J. Comput. 9(4), 1980)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int32, Int64

from splatpipe.pipeline.surface.texture.charts import Charts
from splatpipe.pipeline.surface.texture.textured_mesh import PAGE_SIDE, Atlas

FILL = 0.9  # share of a page that shelves fill, or a little more
STEP = 64  # pages' widths are multiples of this, texels


def pack_charts(charts: Charts) -> Atlas:
    """Place charts in pages, those of consecutive photos together, so that each page needs few photos."""
    size = charts.size.astype(np.int64)
    width = _page_width(size)
    rects = np.zeros((len(size), 5), np.int32)
    rects[:, 3:] = size
    sizes: list[tuple[int, int]] = []
    start, area = 0, size.prod(axis=1)
    while start < len(size):
        end = start + max(1, int(np.searchsorted(np.cumsum(area[start:]), FILL * width * PAGE_SIDE, side="right")))
        end, places, height = _fill_page(size, start, end, width)
        rects[start:end, 0] = len(sizes)
        rects[start:end, 1:3] = places
        sizes.append((width, height))
        start = end
    corners = charts.corners + rects[charts.chart, None, 1:3].astype(np.float32)
    return Atlas(_float32(corners), charts.chart, rects, np.array(sizes, np.int32).reshape(-1, 2))


def _float32(corners: np.ndarray) -> Float32[np.ndarray, "m 3 2"]:
    return np.asarray(corners, np.float32)


def _page_width(size: Int64[np.ndarray, "c 2"]) -> int:
    side = float(size.prod(axis=1).sum() / FILL) ** 0.5
    least = max(side, float(size.max(initial=1)))
    return min(PAGE_SIDE, STEP * int(np.ceil(least / STEP)))


def _fill_page(
    size: Int64[np.ndarray, "c 2"], start: int, end: int, width: int
) -> tuple[int, Int32[np.ndarray, "k 2"], int]:
    """Place charts from ``start`` on, up to ``end`` or as many as fit.

    Returns:
        The end of the placed charts, their left and top, and the height of the page.
    """
    while True:
        places, height = _shelves(size[start:end], width)
        if height <= PAGE_SIDE:
            return end, places, height
        end = max(start + 1, start + int((end - start) * min(0.98, PAGE_SIDE / height)))


def _shelves(size: Int64[np.ndarray, "k 2"], width: int) -> tuple[Int32[np.ndarray, "k 2"], int]:
    """Left and top of each chart, and the height of all shelves."""
    places = np.zeros((len(size), 2), np.int32)
    left = top = shelf = 0
    for row in np.lexsort((np.arange(len(size)), -size[:, 0], -size[:, 1])):
        across, down = (int(each) for each in size[row])
        if left + across > width:
            left, top, shelf = 0, top + shelf, 0
        places[row] = left, top
        left, shelf = left + across, max(shelf, down)
    return places, top + shelf
