"""Sections: vertical cuts through the ground and everything on it along a line.

The surface model gives the topmost height at each place. If depth maps are available, their points near the plane are
added: a surface model cannot represent walls and overhangs. If there is a terrain model, so is the ground below.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.depths.sources import MIN_CONFIRMED, DepthSource, PosedDepthMap
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
from splatpipe.pipeline.surface.measuring.ground_scale import ground_metres
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs

SAMPLES_PER_CELL = 2.0  # along the line, so that no cell that it crosses for some length is left out
MAX_SAMPLES = 2_000_000  # 20 km at 2 cm: more is a wrong coordinate
THICKNESS_CELLS = 1.5  # on either side of the plane, from where points are taken
MIN_PHOTOS = 2  # that have a point in a cell of the section

Line = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Section:
    """Heights along a line.

    Attributes:
        line: Easting and northing of its start and its end, the CRS's unit.
        distance_m: Ground distance of each place from the start, metres.
        place: Eastings and northings.
        height: Heights of the surface, in the CRS's unit; NaN where there is none.
        sigma_m: Expected deviation of each height, metres; NaN where unknown.
        ground: Heights of the terrain model, in the CRS's unit; NaN where there is none; None without such a model.
        points: Distances from the start and heights, both in metres, of points that photos see near the plane.
    """

    line: Line
    distance_m: Float64[np.ndarray, " n"]
    place: Float64[np.ndarray, "n 2"]
    height: Float64[np.ndarray, " n"]
    sigma_m: Float64[np.ndarray, " n"]
    ground: Float64[np.ndarray, " n"] | None
    points: Float64[np.ndarray, "k 2"]

    @property
    def length_m(self) -> float:
        """Length from start to end, metres."""
        return float(self.distance_m[-1])


def cut_section(
    surface: SurfaceFile,
    line: Line,
    crs: MapCrs,
    sources: Sequence[DepthSource],
    threads: int,
    terrain: SurfaceFile | None = None,
) -> Section:
    """Cut a section through a surface model, and through depth maps and a terrain model if there are any.

    Args:
        surface: The surface model.
        line: Start and end, in the CRS's coordinates.
        crs: CRS of the surface model.
        sources: Depths of the photos, local metres; empty for the surface alone.
        threads: Photos in parallel.
        terrain: The terrain model on the surface model's grid; None for none.

    Raises:
        SplatpipeError: if the line has no length, is absurdly long, or does not cross the surface.
    """
    start, end = np.array(line[:2], np.float64), np.array(line[2:], np.float64)
    length = float(np.linalg.norm(end - start)) if np.isfinite([start, end]).all() else 0.0
    text = ",".join(f"{number:.10g}" for number in line)
    count = math.ceil(length / surface.cell * SAMPLES_PER_CELL) + 1
    if length == 0.0 or count > MAX_SAMPLES:
        raise SplatpipeError(f"The section {text} has no length, or is far too long.", "Check its coordinates.")
    share = np.linspace(0.0, 1.0, count)
    place = start + share[:, None] * (end - start)
    height, sigma_m = surface.along(place)
    if not np.isfinite(height).any():
        raise SplatpipeError(
            f"The section {text} does not cross the surface model.",
            f"Give the easting and northing of its start and end, in {crs.horizontal.name}.",
        )
    metre = ground_metres(crs)
    points = np.zeros((0, 2))
    if sources:
        middle = float(np.median(height[np.isfinite(height)]))
        ends = crs.local_from_crs(np.array([[*start, middle], [*end, middle]]))
        points = _points(sources, ends, surface.cell * metre, threads)
        points = _raised(points, ends, crs)
    ground = None if terrain is None else terrain.along(place)[0]
    return Section(line, share * length * metre, place, height, sigma_m, ground, points)


def _points(
    sources: Sequence[DepthSource], ends: Float64[np.ndarray, "2 3"], cell_m: float, threads: int
) -> Float64[np.ndarray, "k 2"]:
    """Distance from the start and local height of points that enough photos see near the plane: one per cell."""
    parts = [np.zeros((0, 2)), *ordered_map(partial(_photo_points, ends, cell_m), sources, threads)]
    every = np.concatenate(parts)
    cells, numbers = np.unique(np.floor(every / cell_m).astype(np.int64), axis=0, return_inverse=True)
    numbers = numbers.reshape(-1)
    count = np.bincount(numbers, minlength=len(cells))
    means = [np.bincount(numbers, every[:, axis], len(cells)) / np.maximum(count, 1) for axis in (0, 1)]
    return np.stack(means, axis=1)[count >= MIN_PHOTOS]


def _photo_points(ends: Float64[np.ndarray, "2 3"], cell_m: float, source: DepthSource) -> Float64[np.ndarray, "k 2"]:
    """The points of one photo, at most one per cell."""
    found: PosedDepthMap = source.load()
    camera = found.camera
    way = (ends[1] - ends[0])[:2]
    length = float(np.linalg.norm(way))
    along = np.array([*way / length, 0.0])
    aside = np.array([-along[1], along[0], 0.0])
    beside, ahead = camera.cam_from_world[:3, :3] @ aside, float((camera.centre() - ends[0]) @ aside)
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    off = found.depth * (beside[0] * x + beside[1] * y[:, None] + beside[2]) + ahead
    near = (np.abs(off) <= THICKNESS_CELLS * cell_m) & (found.depth > 0.0) & (found.confidence >= MIN_CONFIRMED)
    row, column = np.nonzero(near)
    points = camera.unproject(np.stack([column + 0.5, row + 0.5], axis=1), found.depth[row, column].astype(np.float64))
    places = np.stack([(points - ends[0]) @ along, points[:, 2]], axis=1)
    places = places[(places[:, 0] >= 0.0) & (places[:, 0] <= length)]
    _, first = np.unique(np.floor(places / cell_m).astype(np.int64), axis=0, return_index=True)
    return np.asarray(places[np.sort(first)])


def _raised(
    points: Float64[np.ndarray, "k 2"], ends: Float64[np.ndarray, "2 3"], crs: MapCrs
) -> Float64[np.ndarray, "k 2"]:
    """Convert the points' heights to the CRS's datum, metres."""
    way = (ends[1] - ends[0]) / np.linalg.norm((ends[1] - ends[0])[:2])
    local = ends[0] + points[:, :1] * way
    local[:, 2] = points[:, 1]
    return np.stack([points[:, 0], crs.crs_from_local(local)[:, 2] * crs.height_unit_m], axis=1)
