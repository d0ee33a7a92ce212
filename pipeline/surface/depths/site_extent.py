"""The extent of a run's site from its depths: GSD of the photos, height range, and the area that enough photos see.

It uses a sample of every photo's depths, so it takes seconds; the products' grids and tiles follow from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.surface.depths.sources import MIN_CONFIRMED, DepthSource, PosedDepthMap

SAMPLES = 3000  # evenly spaced depths per photo
CELL_GSD = 100.0  # plan cell size in GSDs, such that each cell that a photo sees has several of its samples
MAX_CELLS = 1 << 24  # largest plan: 60 km² at a GSD of 2 cm, and 0.5 GB
MIN_PHOTOS = 3  # photos that have to see a cell
MAX_PIXEL_TIMES = 4.0  # times the usual size on the ground: larger pixels show distant land, not the site
MAX_LEVEL_TIMES = 2.0  # likewise across the ray, for level photos: a flight straight down reaches as far
LEVEL_SINE = 0.17  # a photo is level if its axis is at most 10° below the horizon
MIN_PART_SHARE = 0.02  # share of the area seen below which an isolated part is left out
OUTLIER_SHARE = 0.001  # share of the lowest and of the highest samples that may be wrong
RELIEF_MARGIN_SHARE = 0.1  # share of the relief added below and above, for what the samples missed,
MIN_MARGIN_M = 3.0  # but at least this: a mast or a well


@dataclass(frozen=True, eq=False)
class SiteExtent:
    """The site that a run's photos cover.

    Attributes:
        gsd_m: GSD of the original photos: pixel size at the surface, across the ray; the mean of the photos' medians.
        low_m: Lowest height, local metres.
        high_m: Highest height, local metres.
        reach: Least east and north, largest east and north of the area seen, local metres.
        corner: East and north of the outer (south-west) corner of the plan's first cell, local metres.
        cell_m: Cell size of the plan, metres.
        covered: Cells of the plan that enough photos see, and their neighbours; rows towards north.
    """

    gsd_m: float
    low_m: float
    high_m: float
    reach: tuple[float, float, float, float]
    corner: tuple[float, float]
    cell_m: float
    covered: Bool[np.ndarray, "rows columns"]

    @property
    def box(self) -> Float64[np.ndarray, "2 3"]:
        """Least and largest east, north, up."""
        west, south, east, north = self.reach
        return np.array([[west, south, self.low_m], [east, north, self.high_m]])

    def sees(self, box: Float64[np.ndarray, "2 2"]) -> bool:
        """Whether any covered cell lies in a rectangle (least and largest east and north)."""
        (left, bottom), (right, top) = np.floor((box - self.corner) / self.cell_m).astype(np.int64)
        return bool(self.covered[max(bottom, 0) : max(top, -1) + 1, max(left, 0) : max(right, -1) + 1].any())

    def area_m2(self) -> float:
        """Covered area, square metres."""
        return float(self.covered.sum()) * self.cell_m**2


def save_site(path: Path, site: SiteExtent | None, dsm_cell_m: float = 0.0) -> None:
    """Write a site as JSON for ``load_site``.

    Args:
        path: Output file.
        site: The site; None if nothing is seen.
        dsm_cell_m: Cell size of the surface model, metres.
    """
    if site is None:
        write_json(path, None)
        return
    rows, columns = site.covered.shape
    facts = {"gsd_m": site.gsd_m, "low_m": site.low_m, "high_m": site.high_m, "reach": list(site.reach)}
    packed = np.packbits(site.covered).tobytes().hex()
    plan = {"corner": list(site.corner), "cell_m": site.cell_m, "rows": rows, "columns": columns, "covered": packed}
    write_json(path, {**facts, **plan, "dsm_cell_m": dsm_cell_m})


def load_site(path: Path) -> tuple[SiteExtent, float] | None:
    """Read a file of ``save_site``: the site and the DSM's cell size; None if nothing is seen.

    Raises:
        StageError: if the file is broken.
    """
    try:
        stored: dict[str, Any] | None = read_json(path)
        if stored is None:
            return None
        shape = int(stored["rows"]), int(stored["columns"])
        bits = np.unpackbits(np.frombuffer(bytes.fromhex(stored["covered"]), np.uint8))[: shape[0] * shape[1]]
        gsd, low, high, cell, dsm_cell = (
            float(stored[name]) for name in ("gsd_m", "low_m", "high_m", "cell_m", "dsm_cell_m")
        )
        west, south, east, north = (float(each) for each in stored["reach"])
        corner_east, corner_north = (float(each) for each in stored["corner"])
        covered, corner = bits.reshape(shape).astype(np.bool_), (corner_east, corner_north)
        return SiteExtent(gsd, low, high, (west, south, east, north), corner, cell, covered), dsm_cell
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StageError(f"The site {path.name} cannot be read: {error}", "Run again with --rerun dsm.") from error


def measure_extent(
    sources: Sequence[DepthSource], finer: float, area: PlanArea | None, threads: int
) -> SiteExtent | None:
    """Measure the site from the depths of all photos; None if enough photos see nothing.

    Args:
        sources: Depths in local metres.
        finer: Resolution of the original photos over that of their depths.
        area: Only depths inside count; None for all.
        threads: Photos in parallel.
    """
    samples = list(ordered_map(partial(_sample_depths, finer), sources, threads))
    seen = [sample for sample in samples if len(sample)]
    if not seen:
        return None
    gsd = float(np.mean([np.median(sample[:, 4]) for sample in seen]))
    number = np.repeat(np.arange(len(samples)), [len(sample) for sample in samples])
    every = np.concatenate(samples)
    near = every[:, 3] <= gsd
    if area is not None:
        near &= area.contains(every[:, :3])
    every, number = every[near], number[near]
    if not len(every):
        return None
    cell = CELL_GSD * gsd
    corner = np.floor(every[:, :2].min(axis=0) / cell) * cell
    place = np.floor((every[:, :2] - corner) / cell).astype(np.int64)
    covered = _covered(place, number)
    inside = covered[place[:, 1], place[:, 0]]
    if not inside.any():
        return None
    low, high = _relief(every[inside, 2])
    (west, south), (east, north) = every[inside, :2].min(axis=0), every[inside, :2].max(axis=0)
    reach = float(west), float(south), float(east), float(north)
    wider = cv2.dilate(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return SiteExtent(gsd, low, high, reach, (float(corner[0]), float(corner[1])), cell, wider)


def _sample_depths(finer: float, source: DepthSource) -> Float64[np.ndarray, "n 5"]:
    """East, north, up of sampled depths, the pixel size by which they are near, over its limit, and across the ray."""
    found: PosedDepthMap = source.load()
    camera = found.camera
    step = max(1, round((camera.width * camera.height / SAMPLES) ** 0.5))
    row, column = (grid.ravel() for grid in np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step])
    sure = (found.depth[row, column] > 0.0) & (found.confidence[row, column] >= MIN_CONFIRMED)
    row, column = row[sure], column[sure]
    depth = found.depth[row, column].astype(np.float64)
    points = camera.unproject(np.stack([column + 0.5, row + 0.5], axis=1), depth)
    away = np.linalg.norm(points - camera.centre(), axis=1)
    sine = (camera.centre()[2] - points[:, 2]) / np.maximum(away, 1e-9)
    pixel = depth / max(camera.fx, camera.fy) / finer
    is_level = float(camera.cam_from_world[2, 2]) >= -LEVEL_SINE
    size = pixel / MAX_LEVEL_TIMES if is_level else pixel / np.maximum(sine, 1e-3) / MAX_PIXEL_TIMES
    return np.column_stack([points, size, pixel])


def _covered(cell: Int64[np.ndarray, "n 2"], number: Int64[np.ndarray, " n"]) -> Bool[np.ndarray, "rows columns"]:
    """Cells that enough photos see and that are not in small isolated parts."""
    columns, rows = cell.max(axis=0) + 1
    if rows * columns > MAX_CELLS:
        raise SplatpipeError("The photos' depths reach too far for a surface.", "Set a --boundary.")
    place = cell[:, 1] * columns + cell[:, 0]
    pairs = np.unique(np.stack([place, number], axis=1), axis=0)
    count = np.bincount(pairs[:, 0], minlength=rows * columns).reshape(rows, columns)
    covered = (count >= MIN_PHOTOS).astype(np.uint8)
    _, parts = cv2.connectedComponents(covered, connectivity=8)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    # The largest one is kept even if the site is in many pieces.
    kept = sizes >= min(MIN_PART_SHARE * sizes.sum(), sizes.max())
    return np.asarray((covered > 0) & kept[parts])


def _relief(up: Float64[np.ndarray, " n"]) -> tuple[float, float]:
    low, high = np.quantile(up, [OUTLIER_SHARE, 1.0 - OUTLIER_SHARE])
    margin = max(MIN_MARGIN_M, RELIEF_MARGIN_SHARE * (high - low))
    return float(low - margin), float(high + margin)
