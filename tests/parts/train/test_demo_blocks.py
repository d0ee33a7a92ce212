"""The demo, divided into blocks and merged."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks, load_views
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.render.rendering import render_depth
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.assembly import count_and_degree, own_pieces
from splatpipe.pipeline.train.blocks.cells.cutting import cut, shares, site, work_map
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import photo_coverages
from splatpipe.pipeline.train.blocks.cells.visibility import block_views, windows


def merged(partition: Partition, trained: Mapping[int, Gaussians]) -> Gaussians:
    count, degree = count_and_degree(partition, trained.__getitem__)
    whole = Gaussians.concat(list(own_pieces(partition, trained.__getitem__)))
    assert (len(whole), whole.sh_degree) == (count, degree)
    return whole


def test_demo_is_divided_assigned_to_photos_and_merged(demo_run: Path) -> None:
    """The demo's own sparse model and coarse depths: four blocks of similar work that see their cells."""
    dataset = next((demo_run / "stages").glob("undistort-*")) / "dataset"
    (ply,) = (demo_run / "stages").glob("train-*/*.ply")
    coarse = read_splat(ply)
    options = RenderOptions(sh_degree=0, near=1e-3)
    points, tracks = load_points_and_tracks(dataset)
    cameras = [view.camera for view in load_views(dataset)]
    up = -np.mean([camera.cam_from_world[1, :3] for camera in cameras], axis=0)
    plan = GroundPlan.across(up)
    seen = photo_coverages(cameras, [tracks[c.name] for c in cameras], lambda grid: render_depth(coarse, grid, options))
    work = work_map(plan, site(plan, seen, points.xyz), seen, points.xyz)
    partition = cut(work, 4)
    found = shares(work, partition)
    assert found.max() <= 1.5 / 4 and found.min() >= 0.5 / 4
    views = block_views(partition, seen, points.xyz, lambda camera: windows(camera, camera.width * camera.height // 6))
    assert min(view.covered for view in views) >= 0.95
    whole = merged(partition, dict.fromkeys(range(4), coarse))
    assert len(whole) == len(coarse)
    pictures = [render(model, cameras[3], options).colour.numpy() for model in (coarse, whole)]
    assert np.abs(pictures[0] - pictures[1]).max() < 2e-3  # only the order of equal depths differs
