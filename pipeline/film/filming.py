"""Films and stills of a trained model: the scene, what an image shows, and how films are written."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float64

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.film.camera_path import FilmCamera, angle_of
from splatpipe.pipeline.film.clearance import Clearance, solid_places
from splatpipe.pipeline.film.options import MAX_FILM_MEGAPIXELS
from splatpipe.pipeline.film.photo_route import PhotoTrack
from splatpipe.pipeline.film.video import VideoWriter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View, load_points_and_tracks, load_views
from splatpipe.pipeline.photos.pixels.images import Pixels, reduced_camera
from splatpipe.pipeline.photos.pixels.small_views import small_view
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.device import Device
from splatpipe.pipeline.render.rendering import Model, as_trained, placed, render_depth, render_normals, render_pixels
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.sky.panorama import read_panorama
from splatpipe.pipeline.splat.sky.sky_mask import WORK_MEGAPIXELS, SkyPhoto, up_of

What = Literal["colour", "depth", "normals"]
ASPECT = 16.0 / 9.0
SAMPLED_CAMERAS = 8  # cameras of a path that determine the depth range
DEPTH_QUANTILES = (0.01, 0.99)  # quantiles of depth between which colours run from near to far
MIN_SIDE, MAX_SIDE = 16, 8192  # sides of an image, pixels
ROWS_AT_ONCE = 256  # rows of an image that are coloured at a time


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """The scene to film.

    Attributes:
        model: The splat, and its sky if it has one.
        options: Render options that it was trained with.
        cameras: The photos' cameras, at training size.
        capture: The capture's data for finding a path.
    """

    model: Model
    options: rasterizer.RenderOptions
    cameras: Sequence[Camera]
    capture: PhotoTrack

    def lens(self, size: tuple[int, int] | None) -> FilmCamera:
        """A camera of a given size with the photos' field of view; default: 16:9 at training size, at most Full HD."""
        if size is None:
            pixels = float(np.median([camera.width * camera.height for camera in self.cameras]))
            width = _even(math.sqrt(min(pixels, 1e6 * MAX_FILM_MEGAPIXELS) * ASPECT))
            size = (width, _even(width / ASPECT))
        return FilmCamera.of_angle(*size, angle_of(self.cameras))


def _even(length: float) -> int:
    return max(MIN_SIDE, 2 * round(length / 2.0))


def open_scene(parts: Mapping[str, Path], threads: int, device: Device) -> TrainedScene:
    """Read the outputs of training and cleaning.

    Args:
        parts: `clean.model`, `train.rendering`, `train.sky` and `undistort.dataset`.
        threads: Number of threads that read photos, if these are needed to find the up direction.
        device: The rendering device.

    Raises:
        StageError: if one is broken.
    """
    gaussians = read_splat(parts["clean.model"])
    options, megapixels = as_trained(parts["train.rendering"], gaussians)
    sky = read_panorama(parts["train.sky"])
    views = load_views(parts["undistort.dataset"])
    points, tracks = load_points_and_tracks(parts["undistort.dataset"])
    cameras = [reduced_camera(view.camera, megapixels) for view in views]
    up = _up(views, cameras, points.xyz, threads) if sky is None else sky.up
    seen = [tracks[camera.name] for camera in cameras]
    capture = PhotoTrack(cameras, seen, points.xyz, up, Clearance(solid_places(gaussians)))
    return TrainedScene(placed((gaussians, sky), device), options, cameras, capture)


def _up(
    views: Sequence[View], cameras: Sequence[Camera], points: Float64[np.ndarray, "n 3"], threads: int
) -> Float64[np.ndarray, " 3"]:
    def photo(index: int) -> SkyPhoto:
        camera, pixels, _ = small_view(views[index], WORK_MEGAPIXELS)
        return SkyPhoto(camera, pixels)

    return up_of(cameras, photo, points[np.isfinite(points).all(axis=1)], threads)


@dataclass(frozen=True, eq=False)
class FrameRenderer:
    """Renders the images of a scene.

    Attributes:
        scene: The scene.
        what: What to show of it.
        upright: Rotation from the model's frame to that of the normals.
        scale: Factor from the model's units to those of the depths.
        depths: Nearest and farthest depth of the colour range, in those units.
    """

    scene: TrainedScene
    what: What
    upright: Float64[np.ndarray, "3 3"]
    scale: float = 1.0
    depths: tuple[float, float] = (1.0, 2.0)

    def values(self, camera: Camera) -> Float[np.ndarray, "h w *k"] | None:
        """Depths (h, w), 0 without a surface, or normals (h, w, 3), 0 without one, float32; None for colours."""
        gaussians, _ = self.scene.model
        if self.what == "depth":
            return (self.scale * render_depth(gaussians, camera, self.scene.options)).astype(np.float32)
        if self.what == "normals":
            normals = render_normals(gaussians, camera, self.scene.options)
            return np.asarray(normals @ self.upright.T.astype(np.float32), np.float32)
        return None

    def pixels(self, camera: Camera, values: Float[np.ndarray, "h w *k"] | None = None) -> Pixels:
        """A viewable image, (h, w, 3) RGB; made from ``values`` if given."""
        values = self.values(camera) if values is None else values
        if values is None:
            return render_pixels(self.scene.model, camera, self.scene.options)
        return coloured_depth(values, self.depths) if self.what == "depth" else coloured_normals(values)


def depth_range(pictures: FrameRenderer, cameras: Sequence[Camera]) -> tuple[float, float]:
    """The range of depths shown by most images of a path, nearest and farthest."""
    found = []
    for index in np.unique(np.linspace(0, len(cameras) - 1, min(SAMPLED_CAMERAS, len(cameras))).round().astype(int)):
        values = pictures.values(reduced_camera(cameras[index], MAX_FILM_MEGAPIXELS))
        if values is not None and (values > 0.0).any():
            found.append(values[values > 0.0])
    if not found:
        return 1.0, 2.0
    nearest, farthest = np.quantile(np.concatenate(found), DEPTH_QUANTILES).tolist()
    return nearest, max(farthest, 1.001 * nearest)


def coloured_depth(depth: Float[np.ndarray, "h w"], depths: tuple[float, float]) -> Pixels:
    """Depths as colours on a log scale: red is near, blue is far, black is no surface; (h, w, 3) RGB."""
    nearest, farthest = depths
    steps = np.empty(depth.shape, np.uint8)
    for rows in _blocks(len(depth)):
        share = np.log(np.maximum(depth[rows], 1e-30) / nearest) / math.log(farthest / nearest)
        steps[rows] = np.clip(255.5 - 255.0 * share, 0.0, 255.0)
    colours = np.ascontiguousarray(cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[:, :, ::-1], np.uint8)
    colours[depth <= 0.0] = 0
    return colours


def coloured_normals(normals: Float[np.ndarray, "h w 3"]) -> Pixels:
    """Normals as colours: red, green, blue grow with x, y, z; grey is no surface; (h, w, 3) RGB."""
    colours = np.empty(normals.shape, np.uint8)
    for rows in _blocks(len(normals)):
        colours[rows] = np.clip(127.5 * normals[rows] + 128.0, 0.0, 255.0)
    return colours


def _blocks(rows: int) -> list[slice]:
    """Blocks of rows of an image, so that temporaries take little memory."""
    return [slice(start, start + ROWS_AT_ONCE) for start in range(0, rows, ROWS_AT_ONCE)]


@dataclass(frozen=True)
class FilmFile:
    """The file of a film, and its frame rate.

    Attributes:
        path: A WebM or MP4 file.
        fps: Frames per second.
    """

    path: Path
    fps: int


def write_film(
    file: FilmFile, cameras: Sequence[Camera], picture: Callable[[Camera], Pixels], report: Reporter
) -> None:
    """Render a path and write it as a film.

    Args:
        file: The output file.
        cameras: One per frame, all of the same even size.
        picture: Renders a frame.
        report: Receives progress.

    Raises:
        MachineError: if the file cannot be written.
    """
    size = (cameras[0].width, cameras[0].height)
    with VideoWriter(file.path, size, file.fps) as film:
        for done, camera in enumerate(cameras, start=1):
            film.write(picture(camera))
            report.progress(done, len(cameras), "filming", "frames")
