"""The house's photos with their depths, as in a run: exact, or with patches of wrong values."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from house_site import RIDGE_M, ROOF, TREE, WALLS, Array, ExactDepths, cameras, depths_of, photo_of
from numpy.typing import NDArray

from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.run_sources import RunSurface
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent
from splatpipe.pipeline.surface.depths.sources import DepthSource
from splatpipe.pipeline.survey.crs.frames import Frame

GSD_M = 0.1
SIDE_M = 10.0  # side of the area made into clouds and meshes: the house, and lawn around it


def house_site() -> SiteExtent:
    """Return a square around the house."""
    return SiteExtent(
        GSD_M,
        -1.0,
        7.0,
        (-SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2, SIDE_M / 2),
        (-SIDE_M / 2, -SIDE_M / 2),
        SIDE_M,
        np.ones((1, 1), np.bool_),
    )


def photos(noise_px: float = 0.0, wild: float = 0.0) -> list[PhotoSource]:
    """Return every other photo of the house.

    Args:
        noise_px: Standard deviation of the depths' parallax, pixels, relative to a photo 5 m away.
        wild: Share of depths that are grossly wrong, in squares of 5 × 5 pixels.
    """
    sources = []
    for number, camera in enumerate(cameras()):
        if number % 2 and number < 9:  # the nadir photos overlap more than needed
            continue
        exact, rng = _exact(number), np.random.default_rng(number)
        depth = exact.depth.astype(np.float64)
        depth *= 1.0 + rng.normal(0.0, noise_px, depth.shape) * depth / (camera.fx * 5.0)
        squares = np.kron(rng.random((camera.height // 5, camera.width // 5)) < wild, np.ones((5, 5), bool))
        depth = np.where(squares, depth * rng.uniform(0.6, 1.4, depth.shape), depth).astype(np.float32)
        found, photo = ExactDepths(camera, depth, exact.confidence), _photo(number)
        source = DepthSource(camera, lambda found=found: found)
        sources.append(PhotoSource(camera, lambda photo=photo: photo, source))
    return sources


@cache
def _photo(number: int) -> NDArray[np.uint8]:
    return photo_of(cameras()[number])


@cache
def _exact(number: int) -> ExactDepths:
    return depths_of(cameras()[number])


def surface_distances(points: Array) -> Array:
    """Return the distances from points to the nearest surface that photos may see: exact except at edges."""
    east, north, up = points.T
    (tree, radius), slope = TREE, (RIDGE_M - 3.0) / ROOF[3]
    parts = [np.abs(up), np.abs(np.linalg.norm(points - np.array(tree), axis=1) - radius)]
    over_roof = (np.abs(east) < ROOF[1] + 0.05) & (np.abs(north) < ROOF[3] + 0.05)
    parts.append(np.where(over_roof, np.abs(up - RIDGE_M + slope * np.abs(north)) / np.hypot(1.0, slope), np.inf))
    for along, across, half, end in ((east, north, WALLS[1], WALLS[3]), (north, east, WALLS[3], WALLS[1])):
        beside = (np.abs(across) < end + 0.05) & (up < RIDGE_M)
        parts.append(np.where(beside, np.abs(np.abs(along) - half), np.inf))
    return np.min(parts, axis=0)


def run_surface(
    frame: Frame, sources: Sequence[PhotoSource], area: PlanArea | None = None, boundary: Path | None = None
) -> RunSurface:
    """Return the photos as a run's, with depths at the photos' resolution."""
    depths = tuple(source.depths for source in sources if source.depths is not None)
    return RunSurface(frame, area, boundary, depths, tuple(sources), 1.0)


class Recorder:
    """A Reporter that records what it receives."""

    def __init__(self) -> None:
        self.steps: list[tuple[float, float]] = []
        self.notes: list[str] = []

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None:
        self.steps.append((done, total))

    def metric(self, name: str, value: float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, message: str, hint: str = "") -> None: ...
