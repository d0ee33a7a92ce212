"""The colours of texture pages: levelled photos in their charts, mixed at seams, and plain colours for the unseen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np
from jaxtyping import Int64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.depths.photo_gains import PhotoGains
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource, pixel_loader
from splatpipe.pipeline.surface.depths.photo_set import rotate
from splatpipe.pipeline.surface.depths.point_visibility import Points
from splatpipe.pipeline.surface.depths.sources import LruCache
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh
from splatpipe.pipeline.surface.texture.charts import BORDER, CELL, Charts
from splatpipe.pipeline.surface.texture.face_views import NONE
from splatpipe.pipeline.surface.texture.seams import Blends
from splatpipe.pipeline.surface.texture.texels import Texels, texels_of
from splatpipe.pipeline.surface.texture.textured_mesh import Atlas

Page = UInt8[np.ndarray, "h w 3"]
AT_ONCE = 1 << 19  # texels of a task
MIXED_AT_ONCE = 1 << 22  # texels of the charts that are mixed at a time: some 0.2 GB


@dataclass(frozen=True, eq=False)
class TextureInput:
    """What pages are coloured from.

    Attributes:
        coloured: The mesh, with the colours that unseen triangles get.
        charts: Its charts.
        atlas: Their places.
        blends: What is mixed into triangles at seams.
        sources: The photos.
        levels: Their gains.
        pixels: Cache of their pixels.
    """

    coloured: ColouredMesh
    charts: Charts
    atlas: Atlas
    blends: Blends
    sources: Sequence[PhotoSource]
    levels: PhotoGains
    pixels: LruCache[UInt8[np.ndarray, "_ _ 3"]]

    def sample(self, number: int, points: Points, cell_m: float) -> UInt8[np.ndarray, "n 3"]:
        """Levelled colours of points in a photo."""
        source = self.sources[number]
        pixels = self.pixels.get(number, pixel_loader(source))
        return self.levels.sample(number, (source, pixels), points, np.ones(points[0].shape, np.bool_), cell_m)


def colour_page(task: TextureInput, number: int, threads: int) -> Page:
    """Colour a page; bit-identical for any number of threads.

    Args:
        task: The mesh, its charts and photos.
        number: Number of the page.
        threads: Parts of it in parallel.

    Raises:
        ValueError: if pixels do not fit their camera.
    """
    width, height = (int(side) for side in task.atlas.sizes[number])
    page = np.zeros((height, width, 3), np.uint8)
    for charts, colours in zip(
        _chart_groups(task, number),
        ordered_map(partial(_draw_charts, task), _chart_groups(task, number), threads),
        strict=True,
    ):
        start = 0
        for chart in charts:
            _, left, top, across, down = (int(each) for each in task.atlas.rects[chart])
            page[top : top + down, left : left + across] = colours[start : start + across * down].reshape(
                down, across, 3
            )
            start += across * down
    _draw_cells(task, number, page)
    _mix_seams(task, number, page, threads)
    return page


def _chart_groups(task: TextureInput, number: int) -> Iterator[list[int]]:
    """Charts of a page in tasks: consecutive ones of one photo and one scale, with not too many texels."""
    charts = np.flatnonzero((task.atlas.rects[:, 0] == number) & (task.charts.photo != NONE)).tolist()
    for _, group in groupby(charts, key=lambda chart: (task.charts.photo[chart], task.charts.scale[chart])):
        held: list[int] = []
        texels = 0
        for chart in group:
            size = int(task.charts.size[chart].prod())
            if held and texels + size > AT_ONCE:
                yield held
                held, texels = [], 0
            held.append(chart)
            texels += size
        yield held


def _draw_charts(task: TextureInput, charts: list[int]) -> UInt8[np.ndarray, "n 3"]:
    """Colours of the texels of charts of one photo and scale, one after the other, row by row."""
    number, scale = int(task.charts.photo[charts[0]]), float(task.charts.scale[charts[0]])
    camera = task.sources[number].camera
    columns, rows = [], []
    for chart in charts:
        width, height = (int(side) for side in task.charts.size[chart])
        left, top = task.charts.origin[chart]
        column = left + (np.arange(width) + (0.5 - BORDER)) / scale
        row = top + (np.arange(height) + (0.5 - BORDER)) / scale
        columns.append(np.tile(column, height))
        rows.append(np.repeat(row, width))
    x, y = (np.concatenate(columns) - camera.cx) / camera.fx, (np.concatenate(rows) - camera.cy) / camera.fy
    centre, ray = camera.centre(), rotate(camera.cam_from_world[:3, :3].T, x, y)
    east, north, up = (centre[axis] + ray[axis] for axis in range(3))
    return task.sample(number, (east, north, up), 1.0 / (scale * max(camera.fx, camera.fy)))


def _draw_cells(task: TextureInput, number: int, page: Page) -> None:
    """Colour the cells of unseen triangles by interpolation between the colours of their corners."""
    charts = np.flatnonzero((task.atlas.rects[:, 0] == number) & (task.charts.photo == NONE))
    faces = np.flatnonzero(np.isin(task.atlas.chart, charts))
    if not faces.size:
        return
    colour = task.coloured.colours[task.coloured.mesh.triangles[faces]].astype(np.float32)
    first = np.floor(task.atlas.corners[faces, 0]).astype(np.int64)
    for chart in charts:
        _, left, top, across, down = task.atlas.rects[chart]
        page[top : top + down, left : left + across] = np.round(colour.mean(axis=(0, 1))).astype(np.uint8)
    for down in range(CELL):
        for right in range(CELL):
            x, y = np.float32(right / (CELL - 1)), np.float32(down / (CELL - 1))
            value = colour[:, 0] * (1 - x - y) + colour[:, 1] * x + colour[:, 2] * y
            page[first[:, 1] + down, first[:, 0] + right] = np.clip(np.round(value), 0, 255).astype(np.uint8)


def _mix_seams(task: TextureInput, number: int, page: Page, threads: int) -> None:
    """Mix the photos at seams into a page, a few charts at a time."""
    blends = task.blends.select(task.atlas.page()[task.blends.face] == number)
    chart = task.atlas.chart[blends.face]
    order = np.argsort(chart, kind="stable")
    texels = task.atlas.rects[:, 3:].astype(np.int64).prod(axis=1)
    texels[task.atlas.rects[:, 0] != number] = 0
    group = (np.cumsum(texels) // MIXED_AT_ONCE)[chart[order]]
    for rows in np.split(order, np.flatnonzero(np.diff(group)) + 1):
        if rows.size:
            _mix_charts(task, blends.select(np.sort(rows)), page, threads)


def _mix_charts(task: TextureInput, blends: Blends, page: Page, threads: int) -> None:
    """Mix photos into the triangles of some charts.

    Args:
        task: The mesh, its charts and photos.
        blends: What is mixed into them.
        page: The page, with the charts' own photos in place.
        threads: Photos in parallel.
    """
    faces, starts, counts = np.unique(blends.face, return_index=True, return_counts=True)
    height, width = page.shape[:2]
    texels = texels_of(task.atlas.corners[faces].astype(np.float64), width, height)
    texels = _inside_charts(task.atlas, faces, texels, width)
    repeats = counts[texels.face]
    texel = np.repeat(np.arange(len(texels.face)), repeats)
    number_of_blend = np.arange(len(texel)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    blend = starts[texels.face][texel] + number_of_blend
    weight = np.clip(texels.weight, 0.0, 1.0)
    weight /= weight.sum(axis=1, keepdims=True)
    share = np.zeros(len(texel), np.float32)
    for corner in range(3):
        share += weight[texel, corner] * blends.weight[blend, corner]
    photo = blends.photo[blend]
    own = photo == task.charts.photo[task.atlas.chart[faces]][texels.face][texel]
    flat = page.reshape(-1, 3)
    total, mixed = np.zeros(len(texels.face), np.float32), np.zeros((len(texels.face), 3), np.float32)
    total[texel[own]] = share[own]
    mixed[texel[own]] = share[own, None] * flat[texels.place[texel[own]]]
    others = np.flatnonzero(~own & (share > 0.0))
    others = others[np.argsort(photo[others], kind="stable")]
    cuts = np.flatnonzero(np.diff(photo[others])) + 1
    groups = [
        part for each in np.split(others, cuts) if each.size for part in np.array_split(each, 1 + len(each) // AT_ONCE)
    ]
    sample = partial(_sample_blend, task, faces, texels)
    for rows, colours in zip(
        groups, ordered_map(lambda rows: sample(int(photo[rows[0]]), texel[rows]), groups, threads), strict=True
    ):
        total[texel[rows]] += share[rows]
        mixed[texel[rows]] += share[rows, None] * colours
    flat[texels.place] = np.clip(np.round(mixed / total[:, None]), 0, 255).astype(np.uint8)


def _inside_charts(atlas: Atlas, faces: Int64[np.ndarray, " n"], texels: Texels, width: int) -> Texels:
    """Texels that lie in the rectangles of their triangles' charts."""
    rects = atlas.rects[atlas.chart[faces[texels.face]]]
    column, row = texels.place % width, texels.place // width
    kept = (column >= rects[:, 1]) & (column < rects[:, 1] + rects[:, 3])
    kept &= (row >= rects[:, 2]) & (row < rects[:, 2] + rects[:, 4])
    return Texels(texels.place[kept], texels.face[kept], texels.weight[kept])


def _sample_blend(
    task: TextureInput, faces: Int64[np.ndarray, " n"], texels: Texels, number: int, rows: Int64[np.ndarray, " r"]
) -> UInt8[np.ndarray, "r 3"]:
    """Colours of texels' places on the surface in a photo."""
    mesh, weight = task.coloured.mesh, texels.weight[rows].astype(np.float64)
    corners = mesh.triangles[faces[texels.face[rows]]]
    east, north, up = (sum(weight[:, k] * mesh.vertices[corners[:, k], axis] for k in range(3)) for axis in range(3))
    camera = task.sources[number].camera
    pose = camera.cam_from_world
    depth = np.median(pose[2, 0] * east + pose[2, 1] * north + pose[2, 2] * up + pose[2, 3])
    scale = float(task.charts.scale[task.atlas.chart[faces[texels.face[rows[0]]]]])
    return task.sample(number, (east, north, up), float(depth) / (scale * max(camera.fx, camera.fy)))
