"""Collects what `viewer.html` shows of a run (cameras, photos, points, sky, CRS; world frame) and writes the page."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View, load_points, load_views
from splatpipe.pipeline.photos.pixels.images import Pixels
from splatpipe.pipeline.photos.pixels.small_views import read_small
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.containers.spz_encoder import SPZ_FROM_Z_UP, spz_bytes
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.panorama import Panorama
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.georeference import scene_box
from splatpipe.pipeline.survey.crs.local_crs import local_crs
from splatpipe.pipeline.survey.crs.world import open_world
from splatpipe.pipeline.web.measured_page import PAGE
from splatpipe.pipeline.web.viewer import ViewerCamera, ViewerScene, ViewerSky, viewer_page

SPLAT = "splat.spz"
SH_STEP = 8.0  # finer than in files: the page is for viewing; 41.6 instead of 40.2 dB cost 6 % of its splat's size
THUMB_HEIGHT, SMALL_THUMB_HEIGHT = 124, 72  # pixels: twice what the page shows; less if there are many photos
MAX_LARGE_THUMBS = 300
JPEG_QUALITY = 74
SKY_ROWS = 64  # twice the panorama's, so that the blur of interpolating twice is invisible
MIN_UP_LENGTH = 0.6  # length of the up direction in the image: in steep views from above, no edge is clearly the top


@dataclass(frozen=True)
class ViewerRendering:
    """The rendering settings a model was trained with.

    Attributes:
        antialias: Whether opacities compensate for the screen-space blur.
        background: Red, green, blue, 0..1.
        near: Distance of the near plane, model units.
        sky: The panorama behind everything; None for none.
    """

    antialias: bool
    background: tuple[float, float, float]
    near: float
    sky: Panorama | None = None


def viewer_rendering(options: RenderOptions, sky: Panorama | None) -> ViewerRendering:
    """The rasterizer options (see `as_trained`) that also apply in the page."""
    return ViewerRendering(options.antialias, options.background, options.near, sky)


def viewer_scene(
    dataset: Path,
    frame: Frame,
    rendering: ViewerRendering,
    held_out: Collection[str] = (),
    gaussians: int = 0,
    title: str = "3D model",
) -> ViewerScene:
    """Collect what the page shows besides the splat.

    Args:
        dataset: The folder that `undistort` wrote.
        frame: The frame of `georef`.
        rendering: How the model is rendered.
        held_out: Names of the held-out photos.
        gaussians: The number of Gaussians.
        title: The page's title.

    Raises:
        StageError: if the dataset cannot be read.
    """
    views, points = load_views(dataset), load_points(dataset)
    in_world = frame.world_from_model.apply(points.xyz)
    height = THUMB_HEIGHT if len(views) <= MAX_LARGE_THUMBS else SMALL_THUMB_HEIGHT
    cameras = tuple(_viewer_camera(view, frame, height, view.camera.name in held_out) for view in views)
    crs = None
    if frame.origin is not None:
        centres = np.array([viewer_camera.camera.centre() for viewer_camera in cameras]).reshape(-1, 3)
        crs = local_crs(open_world(frame), scene_box(in_world, centres))
    return ViewerScene(
        title=title,
        cameras=cameras,
        points=in_world,
        point_colours=points.rgb,
        gaussians=gaussians,
        metres=frame.in_metres,
        placed=frame.origin is not None,
        crs=crs,
        antialias=rendering.antialias,
        background=rendering.background,
        near=rendering.near * float(frame.world_from_model.scale),
        sky=None if rendering.sky is None else _sky(rendering.sky, frame),
        note=frame.note,
    )


def write_viewer(folder: Path, scene: ViewerScene, gaussians: Gaussians, largest_bytes: float) -> None:
    """Write the page, with the splat in it or, if that would be too large, beside it.

    Args:
        folder: The output folder.
        scene: What the page shows.
        gaussians: The splat in the world frame, finite.
        largest_bytes: Largest size of a page that includes its splat.
    """
    splat = viewer_splat(gaussians, scene.antialias)
    fits = 4 * len(splat) <= 3 * largest_bytes  # base64; a page of gigabytes is not even assembled
    page = viewer_page(scene, splat) if fits else ""
    if not fits or len(page.encode()) > largest_bytes:
        write_file(folder / SPLAT, splat)
        page = viewer_page(scene, SPLAT)
    write_file(folder / PAGE, page)


def viewer_splat(gaussians: Gaussians, antialias: bool) -> bytes:
    """The SPZ file that the page renders.

    Args:
        gaussians: The splat in the world frame (z up), finite.
        antialias: Whether its opacities compensate for the screen-space blur.
    """
    return spz_bytes(gaussians, antialias, SH_STEP, torch.tensor(SPZ_FROM_Z_UP, dtype=torch.float64))


def upright(camera: Camera) -> tuple[Camera, int]:
    """The camera rotated by quarter turns so that the world's up (+z) is at the top of its image.

    Returns:
        The camera of the rotated image, and the number of anticlockwise quarter turns, as for ``np.rot90``.
    """
    up_right, up_down = float(camera.cam_from_world[0, 2]), float(camera.cam_from_world[1, 2])
    if math.hypot(up_right, up_down) < MIN_UP_LENGTH:
        return camera, 0
    turns = round(math.atan2(up_right, -up_down) / (math.pi / 2.0)) % 4
    for _ in range(turns):
        camera = _quarter(camera)
    return camera, turns


def _quarter(camera: Camera) -> Camera:
    """The camera of the image rotated anticlockwise by a quarter turn: its right edge becomes the top."""
    turn = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return replace(
        camera,
        width=camera.height,
        height=camera.width,
        fx=camera.fy,
        fy=camera.fx,
        cx=camera.cy,
        cy=camera.width - camera.cx,
        cam_from_world=turn @ camera.cam_from_world,
    )


def _viewer_camera(view: View, frame: Frame, height: int, held_out: bool) -> ViewerCamera:
    camera, turns = upright(_in_world(view.camera, frame))
    size = (view.camera.width, view.camera.height)
    picture = np.rot90(read_small(view.image_path, size, (height, height))[1], turns)
    return ViewerCamera(camera, _thumb(picture, height), held_out)


def _in_world(camera: Camera, frame: Frame) -> Camera:
    similarity = frame.world_from_model
    pose = np.eye(4)
    pose[:3, :3] = camera.cam_from_world[:3, :3] @ np.asarray(similarity.rotation).T
    pose[:3, 3] = -pose[:3, :3] @ similarity.apply(camera.centre()[None])[0]
    return replace(camera, cam_from_world=pose)


def _thumb(picture: Pixels, height: int) -> bytes:
    scale = min(1.0, height / picture.shape[0])
    size = [max(1, round(scale * side)) for side in (picture.shape[1], picture.shape[0])]
    small = cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise StageError("A photo's small picture could not be coded as JPEG.")
    return bytes(data)


def _sky(sky: Panorama, frame: Frame) -> ViewerSky:
    """The sky panorama resampled to world directions."""
    elevation = (np.arange(SKY_ROWS) + 0.5) / SKY_ROWS * math.pi - math.pi / 2.0
    azimuth = (np.arange(2 * SKY_ROWS) + 0.5) / SKY_ROWS * math.pi - math.pi
    rays = _directions(elevation, azimuth) @ np.asarray(frame.world_from_model.rotation)  # rows: Rᵀ ray
    colours = sky.at(rays).detach().clamp(0.0, 1.0).numpy()
    return ViewerSky(np.rint(colours * 255.0).astype(np.uint8))


def _directions(
    elevation: Float64[np.ndarray, " rows"], azimuth: Float64[np.ndarray, " columns"]
) -> Float64[np.ndarray, "rows columns 3"]:
    rows, columns = np.meshgrid(elevation, azimuth, indexing="ij")
    return np.stack([np.cos(rows) * np.cos(columns), np.cos(rows) * np.sin(columns), np.sin(rows)], axis=2)
