"""A large synthetic site: a run's photos, cameras, points and splat, repeated as tiles on a grid in plan."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import torch
from jaxtyping import Float64
from opened_run import OpenedRun

from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.photos.pixels.dataset import MODEL, load_points_and_tracks, split_views
from splatpipe.pipeline.splat.containers.ply import read_splat, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.appearance.sky_file import write_skies
from splatpipe.pipeline.train.blocks.cells.cutting import site
from splatpipe.pipeline.train.blocks.cells.partition import Cell
from splatpipe.pipeline.train.blocks.cells.photo_coverage import photo_coverages
from splatpipe.pipeline.train.blocks.cells.thinning import thinned
from splatpipe.pipeline.train.blocks.coarse import SKIES
from splatpipe.pipeline.train.blocks.layout import upward

LOOSER = 1.2  # factor between voxel sizes tried, until all tiles' splats together match the coarse pass's count


@dataclass(frozen=True, eq=False)
class Tiling:
    """Copies of a run's site.

    Attributes:
        run: The run.
        cell: Its site, in plan.
        plan: The ground plan.
        offsets: Offset of each tile, in the model's frame.
    """

    run: OpenedRun
    cell: Cell
    plan: GroundPlan
    offsets: tuple[Float64[np.ndarray, " 3"], ...]

    @staticmethod
    def of(run: OpenedRun, photos: int) -> Tiling:
        """Create enough tiles for at least ``photos`` photos, in a grid that is roughly square.

        Args:
            run: The run.
            photos: Minimum number of photos.
        """
        dataset = run.parts["undistort.dataset"].path
        points, tracks = load_points_and_tracks(dataset)
        cameras = [view.camera for view in run.views]
        plan = GroundPlan.across(upward(run.views, points.xyz, 1))
        cell = site(
            plan, photo_coverages(cameras, [tracks[each.name] for each in cameras], run.median_depth), points.xyz
        )
        width, height = (high - low for low, high in zip(cell.low, cell.high, strict=True))
        tiles = -(-photos // len(run.views))
        columns = max(1, min(tiles, round(math.sqrt(tiles * height / width))))
        places = [(k % columns * width, k // columns * height) for k in range(tiles)]
        return Tiling(run, cell, plan, tuple(x * plan.axes[0] + y * plan.axes[1] for x, y in places))

    @property
    def photos(self) -> int:
        """Return the number of photos of all tiles."""
        return len(self.offsets) * len(self.run.views)

    def names(self) -> Iterator[tuple[str, str]]:
        """Yield each photo's name, and its name in the run."""
        for tile in range(len(self.offsets)):
            for view in self.run.views:
                yield tile_name(tile, view.camera.name), view.camera.name


def tile_name(tile: int, name: str) -> str:
    """Return a photo's name in a tile."""
    return f"tile_{tile:03d}/{name}"


def write_site(tiling: Tiling, folder: Path) -> dict[str, Path]:
    """Write dataset and split of all tiles, with photos as links.

    Args:
        tiling: The tiles.
        folder: Output folder.

    Returns:
        The parts, by name.
    """
    source, dataset = tiling.run.parts["undistort.dataset"].path, folder / "dataset"
    shutil.rmtree(dataset, ignore_errors=True)
    for kind in ("images", "masks", "sky_masks"):
        if (source / kind).is_dir():
            (dataset / kind).mkdir(parents=True)
            for tile in range(len(tiling.offsets)):
                (dataset / kind / f"tile_{tile:03d}").symlink_to((source / kind).resolve())
    (dataset / MODEL).mkdir(parents=True)
    _tiled_model(pycolmap.Reconstruction(source / MODEL), tiling).write(dataset / MODEL)
    held_out = set(tiling.run.held_out)
    names = dict(tiling.names())
    split = split_views(list(names), 0, "")
    split = replace(
        split,
        train=tuple(name for name in sorted(names) if names[name] not in held_out),
        held_out=tuple(name for name in sorted(names) if names[name] in held_out),
    )
    (folder / "split.json").write_text(split.to_json(), encoding="utf-8")
    return {"undistort.dataset": dataset, "split.views": folder / "split.json"}


def _tiled_model(of_one: pycolmap.Reconstruction, tiling: Tiling) -> pycolmap.Reconstruction:
    found = pycolmap.Reconstruction()
    number = 0
    for tile, offset in enumerate(tiling.offsets):
        ids: dict[int, int] = {}
        for image in of_one.images.values():
            number += 1
            ids[image.image_id] = number
            lens = of_one.cameras[image.camera_id]
            camera = pycolmap.Camera(
                camera_id=number, model="PINHOLE", width=lens.width, height=lens.height, params=lens.params
            )
            found.add_camera_with_trivial_rig(camera)
            pose = image.cam_from_world()
            rotation = pose.rotation.matrix()
            keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            copy = pycolmap.Image(
                name=tile_name(tile, image.name), camera_id=number, image_id=number, keypoints=keypoints
            )
            moved = np.column_stack([rotation, pose.translation - rotation @ offset])
            found.add_image_with_trivial_frame(copy, pycolmap.Rigid3d(moved))
        for point in of_one.points3D.values():
            track = [pycolmap.TrackElement(ids[each.image_id], each.point2D_idx) for each in point.track.elements]
            found.add_point3D(point.xyz + offset, pycolmap.Track(track), point.color)
    return found


def write_coarse(tiling: Tiling, most: int, folder: Path, threads: int) -> None:
    """Write the output of a coarse pass over all tiles: the run's splat in each, thinned; its sky and exposures.

    Args:
        tiling: The tiles.
        most: Maximum number of Gaussians.
        folder: Output folder.
        threads: Threads of the sky detection.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    parts, run = tiling.run.parts, tiling.run
    write_splat(folder / "model.ply", _tiled_splat(tiling, most))
    for name, part in (("sky.npz", "train.sky"), ("rendering.json", "train.rendering"), ("plan.json", "train.plan")):
        shutil.copyfile(parts[part].path, folder / name)
    shutil.copyfile(parts["train.history"].path, folder / "history.json")
    exposures = json.loads(parts["train.exposures"].path.read_text(encoding="utf-8"))
    maps = exposures["views"]
    exposures["views"] = {name: maps[own] for name, own in tiling.names() if own in maps}
    (folder / "exposures.json").write_text(json.dumps(exposures), encoding="utf-8")
    kept = [view for view in run.views if view.camera.name not in set(run.held_out)]
    sky = SkyModel.begin(kept, parts["undistort.dataset"].path, threads) if run.model[1] is not None else None
    masks = {} if sky is None else sky.masks
    write_skies(folder / SKIES, {name: masks[own] for name, own in tiling.names() if own in masks})


def _tiled_splat(tiling: Tiling, most: int) -> Gaussians:
    """Repeat the Gaussians of the run's site, thinned evenly to at most ``most`` in total, in every tile."""
    model = read_splat(tiling.run.parts["train.model"].path)
    inside = tiling.cell.contains(tiling.plan.places(model.means.double().numpy()))
    model = model.select(torch.from_numpy(np.flatnonzero(inside)))
    fitting = most // len(tiling.offsets)
    one = model
    voxel = float(np.exp(model.log_scales.numpy().mean(axis=1)).mean())
    while len(one) > fitting:
        one = thinned(model, np.full(len(model), voxel))
        voxel *= LOOSER
    return Gaussians.concat([_moved(one, offset) for offset in tiling.offsets])


def _moved(gaussians: Gaussians, offset: Float64[np.ndarray, " 3"]) -> Gaussians:
    found = gaussians.clone()
    found.means += torch.from_numpy(offset).float()
    return found


def middle_and_edge(cells: Sequence[Cell]) -> tuple[int, int]:
    """Return the cell nearest to the site's centre, and the one farthest from it."""
    centres = np.array([[(a + b) / 2 for a, b in zip(cell.low, cell.high, strict=True)] for cell in cells])
    away = np.linalg.norm(centres - centres.mean(axis=0), axis=1)
    return int(np.argmin(away)), int(np.argmax(away))
