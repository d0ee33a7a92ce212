"""initialize: a Gaussian for each sparse point and each dense point from depth maps, sized by neighbour distance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.plan_area import PlanArea, read_model_area
from splatpipe.pipeline.mvs.dense import DensePoints, PointBudget, covering_views, dense_points
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import Points, View, load_points, load_split, load_views
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.splat.model.sparse_count import sparse_comment
from splatpipe.pipeline.splat.sky.backdrop import coarse_start

Doubles = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]

SH_DEGREE = 3
NEIGHBOURS = 3
MIN_SIZE_PER_EXTENT = 1e-6  # least size of a Gaussian, relative to the scene's extent
MIN_EXTENT = 1e-12  # least extent, for a scene of one point at its camera
QUERY_CHUNK = 65_536
MAX_DENSE = 50_000  # dense points, spread evenly; density control adds finer detail where it pays


def run(config: InitializeConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `init.ply`: isotropic Gaussians at the sparse points, then at the dense ones, in the model's frame.

    With a boundary, all points inside are used, and of those outside only enough for a coarse backdrop.

    Raises:
        SplatpipeError: if the model has no points.
    """
    points = load_points(inputs["undistort.dataset"])
    usable = np.flatnonzero(np.isfinite(points.xyz).all(axis=1))
    if usable.size == 0:
        raise SplatpipeError(
            "The sparse model has no points to start from.",
            hint="Export it with its points (points3D.bin), or start from the photos.",
        )
    chosen = choose_points(points, usable, config.max_gaussians)
    if chosen.size < usable.size:
        report.warning(
            f"{usable.size - chosen.size} of {usable.size} sparse points are left out (initialize.max_gaussians)."
        )
    views = load_views(inputs["undistort.dataset"])
    centres = np.array([view.camera.centre() for view in views])
    xyz, rgb = points.xyz[chosen], points.rgb[chosen]
    area = read_model_area(inputs.parts.get("georef.boundary"))
    sparse, summary = int(chosen.size), {}
    if config.dense:
        more = _dense(config, views, inputs, area, out, report)
        xyz, rgb = np.concatenate([xyz, more.xyz]), np.concatenate([rgb, more.rgb])
    if area is not None:
        rows = coarse_start(inside := area.contains(xyz))
        xyz, rgb, sparse = xyz[rows], rgb[rows], int(np.searchsorted(rows, sparse))
        summary = {"inside": int(inside.sum())}
    if config.dense:
        summary |= {"points": sparse, "dense_points": len(xyz) - sparse}
    sizes = point_sizes(xyz, centres, config.max_angle, report)
    gaussians = make_gaussians(xyz, rgb, sizes, config.opacity)
    write_splat(out / "init.ply", gaussians, [sparse_comment(sparse)])
    return {"gaussians": len(xyz), "median_size": float(np.median(sizes)), **summary}


def _dense(
    config: InitializeConfig, views: list[View], inputs: Inputs, area: PlanArea | None, out: Path, report: Reporter
) -> DensePoints:
    """Return dense points from the training photos only: held-out views must not influence what they evaluate."""
    cover = PointBudget(MAX_DENSE, None if area is None else area.contains, config.max_megapixels)
    kept = set(load_split(inputs["split.views"]).train)
    used = [view for view in views if view.camera.name in kept]
    dataset, threads = inputs["undistort.dataset"], inputs.machine.threads
    if config.photos == "covering":
        used = covering_views(dataset, used)
    return dense_points(dataset, used, cover, out, threads, report)


def choose_points(points: Points, usable: npt.NDArray[np.int64], limit: int) -> npt.NDArray[np.int64]:
    """Return the rows of at most ``limit`` usable points, preferring the longest tracks, in their original order.

    Args:
        points: All sparse points.
        usable: (n,) rows to choose from.
        limit: Maximum number.
    """
    if usable.size <= limit:
        return usable
    order = np.lexsort((usable, points.errors_px[usable], -points.track_lengths[usable].astype(np.int64)))
    return np.sort(usable[order[:limit]])


def point_sizes(xyz: Doubles, centres: Doubles, max_angle: float, report: Reporter | None = None) -> Doubles:
    """Mean distance of each point to its three nearest neighbours elsewhere, capped for outliers.

    Args:
        xyz: (n, 3) points, world units.
        centres: (m, 3) camera centres, m > 0.
        max_angle: Upper limit on size, relative to the distance to the nearest camera.
        report: Receives progress.

    Returns:
        (n,) sizes, world units, all above 0.
    """
    origin = np.median(xyz, axis=0)
    points, cameras = (np.ascontiguousarray(where - origin, np.float32) for where in (xyz, centres))
    extent = float(np.abs(points).max()) + float(np.linalg.norm(cameras, axis=1).max())
    places, place_of = np.unique(points, axis=0, return_inverse=True)
    sizes = max_angle * _distances(cameras, places, 1)[:, 0]
    neighbours = min(NEIGHBOURS, len(places) - 1)
    if neighbours > 0:  # the nearest position is the point's own
        sizes = np.minimum(sizes, _distances(places, places, neighbours + 1, report)[:, 1:].mean(axis=1))
    sizes = np.maximum(sizes, MIN_SIZE_PER_EXTENT * max(extent, MIN_EXTENT))
    return np.asarray(sizes[place_of.reshape(-1)])


def _distances(targets: Singles, points: Singles, count: int, report: Reporter | None = None) -> Doubles:
    """(n, count) distances from each point to its nearest targets, ascending."""
    tree = cKDTree(targets)
    distances = np.empty((len(points), count))
    for start in range(0, len(points), QUERY_CHUNK):
        chunk = slice(start, start + QUERY_CHUNK)
        distances[chunk] = tree.query(points[chunk], range(1, count + 1))[0]
        if report is not None:
            report.progress(min(start + QUERY_CHUNK, len(points)), len(points), "measuring neighbours", "points")
    return distances


def make_gaussians(xyz: Doubles, rgb: npt.NDArray[np.uint8], sizes: Doubles, opacity: float) -> Gaussians:
    """Make isotropic Gaussians of equal opacity, with the points' colours and no view dependence.

    Args:
        xyz: (n, 3) world units.
        rgb: (n, 3) 8-bit colours.
        sizes: (n,) standard deviations, world units.
        opacity: In (0, 1).
    """
    count = len(xyz)
    sh = torch.zeros(count, (SH_DEGREE + 1) ** 2, 3)
    sh[:, 0] = rgb_to_dc(torch.from_numpy(rgb.astype(np.float32) / np.float32(255.0)))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    scales = torch.from_numpy(np.log(sizes).astype(np.float32))
    return Gaussians(
        means=torch.from_numpy(xyz.astype(np.float32)),
        log_scales=scales[:, None].repeat(1, 3),
        quats=quats,
        opacity_logits=torch.full((count,), float(np.log(opacity / (1.0 - opacity)))),
        sh=sh,
    )
