"""The photos and depths of a run, as the surface asks for them: in local metres, read when they are needed."""

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
from splatpipe.pipeline.mvs.depth_maps import DepthMapFile, kept_depth_maps
from splatpipe.pipeline.mvs.filling import filled
from splatpipe.pipeline.photos.dataset import load_views
from splatpipe.pipeline.photos.photo_list import decode, load_photo_list
from splatpipe.pipeline.photos.undistortion import RegisteredPhoto, place, read_flown
from splatpipe.pipeline.surface.photo_samples import DistortionGrid, PhotoSource
from splatpipe.pipeline.surface.site_extent import SiteExtent, load_site
from splatpipe.pipeline.surface.sources import DepthSource, MetricMap, PosedDepthMap
from splatpipe.pipeline.survey.frames import Frame, load_frame

LENS_STEP = 8.0  # pixels


@dataclass(frozen=True, eq=False)
class RunSurface:
    """What all products of a run are made from.

    Attributes:
        frame: The run's, in metres.
        area: Nothing outside of it is shown; None for all.
        boundary: The part that tells the area; None where the run has none.
        depths: Of its photos.
        photos: As flown, those with depths and others.
        finer: How many pixels of a photo as flown lie along one of its depths, the middle one of all.
    """

    frame: Frame
    area: PlanArea | None
    boundary: Path | None
    depths: tuple[DepthSource, ...]
    photos: tuple[PhotoSource, ...]
    finer: float


def open_run_surface(inputs: Inputs, report: Reporter) -> RunSurface | None:
    """Open what a run's products are made from; None without metres, or without any depths.

    Args:
        inputs: Of a stage that reads `depths.maps`, `splat_depths.maps`, `undistort.dataset`, `georef.frame`,
            `georef.model`, `georef.boundary` and `ingest.photos`.
        report: Told of photos that are not there.

    Raises:
        SplatpipeError: if one of them is broken.
    """
    frame, views = load_frame(inputs["georef.frame"]), load_views(inputs["undistort.dataset"])
    found, rendered = (kept_depth_maps(inputs[part], views) for part in ("depths.maps", "splat_depths.maps"))
    maps = _of_both(found, rendered)
    if not maps or not frame.in_metres:
        return None
    local_from_model = frame.world_from_model
    depths = {name: _in_metres(*each, local_from_model) for name, each in maps.items()}
    flown = load_photo_list(inputs["ingest.photos"]).photos
    placed = place(read_flown(inputs["georef.model"]), flown, math.inf, report)
    photos = photo_sources(placed, depths, local_from_model, (inputs["ingest.photos"], inputs.photos_dir))
    focal = {view.photo.name: view.source.mean_focal_length() for view in placed}
    finer = statistics.median(focal.get(name, each.camera.fx) / each.camera.fx for name, each in depths.items())
    boundary = inputs.parts.get("georef.boundary")
    return RunSurface(frame, read_world_area(boundary), boundary, tuple(depths.values()), tuple(photos), finer)


def open_surveyed(wanted: bool, inputs: Inputs, report: Reporter) -> tuple[RunSurface, SiteExtent, float] | None:
    """The same, with the site that `dsm` left and the side of its cells.

    None, which is told, where there is no surface model or nothing is wanted.

    Args:
        wanted: Whether the stage's product is asked for.
        inputs: Of a stage that reads `dsm.site` besides.
        report: As above.

    Raises:
        SplatpipeError: as above.
    """
    surveyed = load_site(inputs["dsm.site"]) if wanted else None
    surface = None if surveyed is None else open_run_surface(inputs, report)
    if surveyed is None or surface is None:
        report.progress(1, 1, "nothing is made", "steps")
        return None
    return surface, *surveyed


def metric_depths(maps: Sequence[DepthMapFile], local_from_model: Similarity) -> list[DepthSource]:
    """Depth maps of the model's frame in local metres."""
    return [_in_metres(kept, None, local_from_model) for kept in maps]


def _of_both(
    found: Sequence[DepthMapFile], rendered: Sequence[DepthMapFile]
) -> dict[str, tuple[DepthMapFile, DepthMapFile | None]]:
    """Each photo's depths by its name, and what fills their holes."""
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
                found = filled(found, filling.load())
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
    """The photos as flown, at their full size, through their lenses.

    Args:
        placed: With their pinhole cameras of full size.
        depths: By the photos' names; a photo without any colours nothing.
        local_from_model: The frame's, in metres.
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
