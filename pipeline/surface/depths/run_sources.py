"""The photos and depths of a run for surface products: in local metres, read when needed."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.stage import Inputs, Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import PlanArea, read_world_area
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.mvs.depth_maps import DepthMapFile, list_depth_maps
from splatpipe.pipeline.mvs.filling import fill_gaps
from splatpipe.pipeline.photos.colmap.colmap_reconstruction import read_reconstruction
from splatpipe.pipeline.photos.files.photo_list import decode, load_photo_list
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.photos.pixels.undistortion import RegisteredPhoto, plan_views
from splatpipe.pipeline.surface.depths.photo_samples import DistortionGrid, PhotoSource
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent, load_site
from splatpipe.pipeline.surface.depths.sources import DepthSource, MetricMap, PosedDepthMap
from splatpipe.pipeline.survey.crs.frames import Frame, load_frame

LENS_STEP = 8.0  # pixels


@dataclass(frozen=True, eq=False)
class RunSurface:
    """Inputs of all surface products of a run.

    Attributes:
        frame: The run's frame, metric.
        area: Products are limited to it; None for everything.
        boundary: The part with the area; None if the run has none.
        depths: Depths of its photos.
        photos: The original photos, with or without depths.
        finer: Side of a depth pixel in pixels of the original photo, median over all photos.
    """

    frame: Frame
    area: PlanArea | None
    boundary: Path | None
    depths: tuple[DepthSource, ...]
    photos: tuple[PhotoSource, ...]
    finer: float


def open_run_surface(inputs: Inputs, report: Reporter) -> RunSurface | None:
    """Open the inputs of a run's products; None if the frame is not metric or there are no depths.

    Args:
        inputs: Inputs of a stage that reads `depths.maps`, `splat_depths.maps`, `undistort.dataset`, `georef.frame`,
            `georef.model`, `georef.boundary` and `ingest.photos`.
        report: Receives warnings about missing photos.

    Raises:
        SplatpipeError: if one of them is broken.
    """
    frame, views = load_frame(inputs["georef.frame"]), load_views(inputs["undistort.dataset"])
    found, rendered = (list_depth_maps(inputs[part], views) for part in ("depths.maps", "splat_depths.maps"))
    maps = _pair_maps(found, rendered)
    if not maps or not frame.in_metres:
        return None
    local_from_model = frame.world_from_model
    depths = {name: _in_metres(*each, local_from_model) for name, each in maps.items()}
    flown = load_photo_list(inputs["ingest.photos"]).photos
    placed = plan_views(read_reconstruction(inputs["georef.model"]), flown, math.inf, report)
    photos = photo_sources(placed, depths, local_from_model, (inputs["ingest.photos"], inputs.photos_dir))
    focal = {view.photo.name: view.source.mean_focal_length() for view in placed}
    finer = statistics.median(focal.get(name, each.camera.fx) / each.camera.fx for name, each in depths.items())
    boundary = inputs.parts.get("georef.boundary")
    return RunSurface(frame, read_world_area(boundary), boundary, tuple(depths.values()), tuple(photos), finer)


def open_surveyed(wanted: bool, inputs: Inputs, report: Reporter) -> tuple[RunSurface, SiteExtent, float] | None:
    """Open the same inputs, with the site that `dsm` wrote and the DSM's cell size.

    Returns None, with a message, if there is no surface model or the product is not requested.

    Args:
        wanted: Whether the stage's product is requested.
        inputs: Inputs of a stage that also reads `dsm.site`.
        report: As in ``open_run_surface``.

    Raises:
        SplatpipeError: as ``open_run_surface``.
    """
    surveyed = load_site(inputs["dsm.site"]) if wanted else None
    surface = None if surveyed is None else open_run_surface(inputs, report)
    if surveyed is None or surface is None:
        report.progress(1, 1, "nothing is made", "steps")
        return None
    return surface, *surveyed


def metric_depths(maps: Sequence[DepthMapFile], local_from_model: Similarity) -> list[DepthSource]:
    """Convert depth maps from the model's frame to local metres."""
    return [_in_metres(kept, None, local_from_model) for kept in maps]


def _pair_maps(
    found: Sequence[DepthMapFile], rendered: Sequence[DepthMapFile]
) -> dict[str, tuple[DepthMapFile, DepthMapFile | None]]:
    """Each photo's depths by its name, and the rendered depths that fill their gaps."""
    others = {kept.camera.name: kept for kept in rendered}
    if not found:
        return {name: (kept, None) for name, kept in others.items()}
    return {kept.camera.name: (kept, others.get(kept.camera.name)) for kept in found}


def _in_metres(kept: DepthMapFile, filling: DepthMapFile | None, local_from_model: Similarity) -> DepthSource:
    camera = replace(kept.camera, cam_from_world=local_from_model.camera_pose(kept.camera.cam_from_world))

    def load() -> PosedDepthMap:
        found = kept.load()
        if filling is not None:
            try:
                found = fill_gaps(found, filling.load())
            except ValueError as error:
                raise StageError(f"{camera.name}: {error}.", "Run again with --rerun splat_depths.") from error
        return MetricMap(camera, found.depth * np.float32(local_from_model.scale), found.confidence)

    return DepthSource(camera, load)


def photo_sources(
    placed: Sequence[RegisteredPhoto],
    depths: Mapping[str, DepthSource],
    local_from_model: Similarity,
    folders: tuple[Path, Path],
) -> list[PhotoSource]:
    """The original photos at full size, with their lens distortion.

    Args:
        placed: Photos with their full-size pinhole cameras.
        depths: By the photos' names; a photo without depths colours nothing.
        local_from_model: Transform to local metres.
        folders: The part ``ingest.photos``, and the user's photo folder.
    """
    lenses: dict[int, DistortionGrid] = {}
    sources = []
    for view in placed:
        number = view.target.camera_id
        if number not in lenses:
            lenses[number] = _lens(view.source, view.target)
        pose = np.vstack([view.image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        target = view.target
        focal = float(target.focal_length_x), float(target.focal_length_y)
        middle = float(target.principal_point_x), float(target.principal_point_y)
        camera = Camera(
            view.photo.name, target.width, target.height, *focal, *middle, local_from_model.camera_pose(pose)
        )
        load = partial(decode, view.photo, *folders)
        sources.append(PhotoSource(camera, load, depths.get(view.photo.name), lenses[number]))
    return sources


def _lens(source: pycolmap.Camera, target: pycolmap.Camera) -> DistortionGrid:
    columns = np.arange(0.0, target.width + LENS_STEP, LENS_STEP)
    rows = np.arange(0.0, target.height + LENS_STEP, LENS_STEP)
    pinhole: Float64[np.ndarray, "n 2"] = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    focal = [target.focal_length_x, target.focal_length_y]
    rays = (pinhole - [target.principal_point_x, target.principal_point_y]) / focal
    nodes = np.asarray(source.img_from_cam(np.column_stack([rays, np.ones(len(rays))])), np.float64)
    return DistortionGrid(source.width, source.height, LENS_STEP, nodes.reshape(len(rows), len(columns), 2))
