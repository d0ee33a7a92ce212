"""Charts: triangles that show one photo, flattened by projection into it, and small cells for the unseen.

In its own photo no visible triangle hides another, so charts need no unfolding: their texture is the photo itself.
Triangles of a chart are connected; or there are a few groups of them near each other in the photo, which together need
less room than with a border each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int16, Int32, Int64

from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.point_visibility import project_points
from splatpipe.pipeline.surface.shapes.triangles import TriangleMesh
from splatpipe.pipeline.surface.texture.face_choice import Labels, same_label
from splatpipe.pipeline.surface.texture.face_graph import connected_parts
from splatpipe.pipeline.surface.texture.face_views import NONE

BORDER = 2  # texels around a chart's triangles: filters read beyond them
MAX_SIDE = 1024  # photo pixels: larger charts are cut
MIN_FILL, MIN_AREA = 0.45, 4096.0  # charts that fill less of their rectangle are cut, if it has so many photo pixels
CUTS = 16  # rounds of cutting
NEAR = (16, 32, 64)  # photo pixels: small charts in a square of such a side share a rectangle, if that needs less room
CELL = 3  # texels to each side of the cell of an unseen triangle: interpolation never leaves it
CELLS_ACROSS = 256  # cells in a row of a chart of unseen triangles, and rows
ROUNDS = 40  # of bisection for the texels' size


@dataclass(frozen=True, eq=False)
class Charts:
    """Charts and where their triangles lie in them.

    Attributes:
        chart: Chart of each triangle.
        corners: Column and row of the triangles' corners in their charts, texels; the border is included.
        photo: Photo of each chart, ``NONE`` for cells of unseen triangles.
        origin: Column and row in the photo (its pinhole camera) of the chart's first texel inside the border.
        scale: Texels over pixels of the photo, at most 1.
        size: Width and height with the border, texels.
    """

    chart: Int32[np.ndarray, " m"]
    corners: Float32[np.ndarray, "m 3 2"]
    photo: Int16[np.ndarray, " c"]
    origin: Float64[np.ndarray, "c 2"]
    scale: Float64[np.ndarray, " c"]
    size: Int32[np.ndarray, "c 2"]


def make_charts(
    mesh: TriangleMesh,
    label: Labels,
    beyond: Int32[np.ndarray, "m 3"],
    sources: Sequence[PhotoSource],
    most_texels: float,
) -> Charts:
    """Divide a mesh into charts.

    Args:
        mesh: The mesh.
        label: Photo of each triangle.
        beyond: From ``adjacent_faces``.
        sources: The photos.
        most_texels: Limit on all texels: if photos have more, the finest are reduced first.
    """
    seen = np.flatnonzero(label != NONE)
    places, pixel_m = _project(mesh, label, sources)
    _, part = connected_parts(beyond, same_label(label, beyond))
    part = _shared(_cut(part[seen], places[seen]), label[seen], places[seen])
    _, first, part = np.unique(part, return_index=True, return_inverse=True)
    photo = label[seen][first]
    order = np.lexsort((first, photo))  # by photo, so that a page needs few
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    part, photo = rank[part], photo[order]
    low, high = _boxes(part, places[seen], len(order))
    fine_m = np.bincount(part, pixel_m[seen], len(order)) / np.maximum(np.bincount(part, minlength=len(order)), 1)
    unseen = np.flatnonzero(label == NONE)
    origin = np.floor(low)
    scale = _scales(high - origin, fine_m, most_texels - len(unseen) * CELL**2)
    size = _sizes(high - origin, scale)
    chart, corners = np.empty(len(label), np.int32), np.empty((len(label), 3, 2), np.float32)
    chart[seen] = part
    corners[seen] = (places[seen] - origin[part][:, None]) * scale[part][:, None, None] + BORDER
    made = Charts(chart, corners, photo, origin, scale, size)
    return _with_cells(made, unseen) if unseen.size else made


def _project(
    mesh: TriangleMesh, label: Labels, sources: Sequence[PhotoSource]
) -> tuple[Float64[np.ndarray, "m 3 2"], Float64[np.ndarray, " m"]]:
    """The triangles' corners in their own photos, pixels, and the size of a pixel on them across the ray, metres."""
    places, pixel_m = np.zeros((len(label), 3, 2)), np.zeros(len(label))
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], np.arange(len(sources) + 1))
    for source, start, end in zip(sources, ends[:-1], ends[1:], strict=True):
        if start == end:
            continue
        rows, camera = order[start:end], source.camera
        xyz = mesh.vertices[mesh.triangles[rows]].reshape(-1, 3)
        found = project_points(camera, xyz[:, 0], xyz[:, 1], xyz[:, 2])
        columns, lines = np.clip(found.column, 0.0, camera.width), np.clip(found.row, 0.0, camera.height)
        places[rows] = np.stack([columns, lines], axis=1).reshape(-1, 3, 2)
        pixel_m[rows] = found.depth.reshape(-1, 3).mean(axis=1) / max(camera.fx, camera.fy)
    return places, pixel_m


def _boxes(
    part: Int64[np.ndarray, " s"], places: Float64[np.ndarray, "s 3 2"], count: int
) -> tuple[Float64[np.ndarray, "c 2"], Float64[np.ndarray, "c 2"]]:
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    order = np.argsort(part, kind="stable")
    starts = np.searchsorted(part[order], np.arange(count))
    if count:
        low[:] = np.minimum.reduceat(places[order].min(axis=1), starts)
        high[:] = np.maximum.reduceat(places[order].max(axis=1), starts)
    return low, high


def _cut(part: np.ndarray, places: Float64[np.ndarray, "s 3 2"]) -> Int64[np.ndarray, " s"]:
    """Cut charts that are too large, or fill little of their rectangles, in the middle of the longer side."""
    sides = places[:, 1:] - places[:, :1]
    area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]) / 2.0
    centre = places.mean(axis=1)
    for _ in range(CUTS):
        _, part = np.unique(part, return_inverse=True)
        count = int(part.max(initial=-1)) + 1
        low, high = _boxes(part, places, count)
        extent = high - low
        whole = extent.prod(axis=1)
        fill = np.bincount(part, area, count) / np.maximum(whole, 1e-9)
        cut = (extent.max(axis=1, initial=0.0) > MAX_SIDE) | ((fill < MIN_FILL) & (whole > MIN_AREA))
        if not cut.any():
            break
        axis = extent.argmax(axis=1)
        middle = np.take_along_axis((low + high) / 2.0, axis[:, None], axis=1)[:, 0]
        beyond = np.take_along_axis(centre, axis[part][:, None], axis=1)[:, 0] > middle[part]
        part = 2 * part.astype(np.int64) + (beyond & cut[part])
    return part.astype(np.int64)


def _shared(
    part: Int64[np.ndarray, " s"], photo: Labels, places: Float64[np.ndarray, "s 3 2"]
) -> Int64[np.ndarray, " s"]:
    """Join small charts that lie near each other in their photo."""
    for side in NEAR:
        _, first, part = np.unique(part, return_index=True, return_inverse=True)
        low, high = _boxes(part, places, len(first))
        square = np.floor((low + high) / (2.0 * side)).astype(np.int64)
        square[(high - low).max(axis=1) > side] = -1 - np.arange(len(first))[(high - low).max(axis=1) > side, None]
        keys = np.column_stack([photo[first].astype(np.int64), square])
        _, group = np.unique(keys, axis=0, return_inverse=True)
        group = group.ravel()
        count = int(group.max(initial=-1)) + 1
        least, most = _boxes(group[part], places, count)
        apart = np.bincount(group, _texels(low, high), count)
        joined = _texels(least, most) <= apart
        part = np.where(joined[group], group, count + np.arange(len(first)))[part]
    return part


def _texels(low: Float64[np.ndarray, "c 2"], high: Float64[np.ndarray, "c 2"]) -> Float64[np.ndarray, " c"]:
    """Texels of charts at full resolution, with their borders."""
    return np.asarray(_sizes(high - np.floor(low), np.ones(len(low))).astype(np.float64).prod(axis=1))


def _sizes(extent: Float64[np.ndarray, "c 2"], scale: Float64[np.ndarray, " c"]) -> Int32[np.ndarray, "c 2"]:
    """Width and height of charts with their borders, texels."""
    return np.asarray(np.ceil(extent * scale[:, None]).astype(np.int32) + (1 + 2 * BORDER))


def _scales(
    extent: Float64[np.ndarray, "c 2"], pixel_m: Float64[np.ndarray, " c"], most: float
) -> Float64[np.ndarray, " c"]:
    """Texels per pixel of each chart such that all charts have at most so many texels."""

    def texels(scale: Float64[np.ndarray, " c"]) -> float:
        return float(_sizes(extent, scale).astype(np.float64).prod(axis=1).sum())

    scale = np.ones(len(pixel_m))
    if texels(scale) <= most:
        return scale
    low, high = float(pixel_m.min()), 100.0 * float(pixel_m.max())  # sizes of texels, metres
    for _ in range(ROUNDS):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if texels(np.minimum(pixel_m / middle, 1.0)) <= most else (middle, high)
    return np.asarray(np.minimum(pixel_m / high, 1.0))


def _with_cells(made: Charts, unseen: Int64[np.ndarray, " u"]) -> Charts:
    """Add charts with a small cell for each unseen triangle, in the order of the mesh."""
    per_chart = CELLS_ACROSS * CELLS_ACROSS
    number = np.arange(len(unseen))
    place = number % per_chart
    column, row = place % CELLS_ACROSS, place // CELLS_ACROSS
    first = np.stack([column, row], axis=1) * CELL + (BORDER + 0.5)
    corners = np.array([[0.0, 0.0], [CELL - 1.0, 0.0], [0.0, CELL - 1.0]])
    made.chart[unseen] = len(made.photo) + number // per_chart
    made.corners[unseen] = first[:, None] + corners
    counts = np.bincount(number // per_chart)
    columns, rows = np.minimum(counts, CELLS_ACROSS), -(-counts // CELLS_ACROSS)
    size = np.stack([columns, rows], axis=1).astype(np.int32) * CELL + 2 * BORDER
    return Charts(
        made.chart,
        made.corners,
        np.concatenate([made.photo, np.full(len(size), NONE, np.int16)]),
        np.concatenate([made.origin, np.zeros((len(size), 2))]),
        np.concatenate([made.scale, np.ones(len(size))]),
        np.concatenate([made.size, size]),
    )
