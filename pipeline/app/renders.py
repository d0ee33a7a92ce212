"""Implements ``splatpipe render``: films and stills of a finished run along its cameras, an orbit, or keyframes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from splatpipe.pipeline.app.library.trained_scene import in_model_frame, scene_parts
from splatpipe.pipeline.app.render_request import OWN_PATHS, RenderRequest
from splatpipe.pipeline.app.terminal.console import RunConsole
from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.engine.events import Event, EventReporter
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.film.camera_path import FilmCamera, Route, cameras_along
from splatpipe.pipeline.film.filming import (
    FilmFile,
    FrameRenderer,
    TrainedScene,
    What,
    depth_range,
    open_scene,
    write_film,
)
from splatpipe.pipeline.film.keyframe_file import Keyframes, read_keyframes
from splatpipe.pipeline.film.orbit import orbit
from splatpipe.pipeline.film.photo_route import followed_photos, photo_film
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.raster.device import choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.view_measures import flat_stems
from splatpipe.pipeline.survey.crs.frames import load_frame

ORBIT_STILLS = 12
UP = np.array([0.0, 0.0, 1.0])  # in the world frame of `splat.ply`


@dataclass(frozen=True, eq=False)
class RenderTask:
    """A scene, its georeference, and what to render of it.

    Attributes:
        scene: The trained scene, in the model frame.
        world_from_model: Transform to the world frame of `splat.ply`.
        request: What to render.
        keyframes: Keyframes from the path's file; None without one.
        size: Image size in pixels; None for one like that of the training images.
    """

    scene: TrainedScene
    world_from_model: Similarity
    request: RenderRequest
    keyframes: Keyframes | None
    size: tuple[int, int] | None

    def film(self) -> list[Camera]:
        """The camera of each film frame, in the model frame."""
        seconds, fps = self.request.seconds, self.request.fps
        capture, lens = self.scene.capture, self.scene.lens(self.size)
        if self.keyframes is not None:
            distance = followed_photos(capture)[1] * self.world_from_model.scale
            route, angles = self.keyframes.film(distance, fps, seconds)
            return self._from_world(route, self._lenses(angles, len(route)))
        frames = max(1, round(seconds * fps))
        route = orbit(capture, frames) if self.request.path == "orbit" else photo_film(capture, frames, seconds)
        return cameras_along(route, lens, capture.up)

    def stills(self) -> tuple[list[str], list[Camera]]:
        """Names and cameras of the stills, in the model frame: the photos' own, an orbit's, or the keyframes'."""
        if self.keyframes is not None:
            route = self.keyframes.route
            cameras = self._from_world(route, self._lenses(self.keyframes.angles_deg, len(route)))
        elif self.request.path == "orbit":
            capture = self.scene.capture
            cameras = cameras_along(orbit(capture, ORBIT_STILLS), self.scene.lens(self.size), capture.up)
        else:
            cameras = [camera.scaled(*self.size) if self.size else camera for camera in self.scene.cameras]
        return flat_stems([camera.name for camera in cameras]), cameras

    def _lenses(self, angles_deg: np.ndarray | None, count: int) -> list[FilmCamera]:
        lens = self.scene.lens(self.size)
        if angles_deg is None:
            return [lens] * count
        return [FilmCamera.of_angle(lens.width, lens.height, float(angle)) for angle in angles_deg]

    def _from_world(self, route: Route, lenses: Sequence[FilmCamera]) -> list[Camera]:
        """Convert a route in the world frame of `splat.ply` to cameras in the model frame."""
        cameras = cameras_along(route, lenses, UP)
        return [in_model_frame(camera, self.world_from_model) for camera in cameras]


def render_run(out: Path, request: RenderRequest, threads: int, device: str = "auto") -> dict[str, Any]:
    """Render a trained run.

    Args:
        out: Its OUT.
        request: What to render.
        threads: Threads of the rasterizer, at least 1.
        device: ``auto``, ``cpu`` or ``cuda``.

    Returns:
        A summary of what was written.

    Raises:
        SplatpipeError: if there is nothing to render, or the request is invalid.
        MachineError: if the device does not work.
    """
    what, size = request.validate()
    chosen = choose_device(device)
    keyframes = None if request.path in OWN_PATHS else read_keyframes(_keyframe_file(request.path))
    parts = scene_parts(out)
    target = request.target(out)
    console, began = RunConsole(), time.monotonic()
    console(Event("stage_started", "render", {"reason": f"{what} along {request.path}"}))
    try:
        with same_bits(threads):
            similarity = load_frame(parts["georef.frame"]).world_from_model
            task = RenderTask(open_scene(parts, threads, chosen), similarity, request, keyframes, size)
            summary = _render(task, what, target, EventReporter("render", console))
    finally:
        console.close()
    console(Event("stage_finished", "render", {"seconds": time.monotonic() - began, "summary": summary}))
    return summary


def _render(task: RenderTask, what: What, target: Path, report: Reporter) -> dict[str, Any]:
    pictures = FrameRenderer(task.scene, what, task.world_from_model.rotation, task.world_from_model.scale)
    if not task.request.stills:
        cameras = task.film()
        pictures = replace(pictures, depths=depth_range(pictures, cameras))
        write_film(FilmFile(target, task.request.fps), cameras, pictures.pixels, report)
    else:
        names, cameras = task.stills()
        pictures = replace(pictures, depths=depth_range(pictures, cameras))
        for done, (name, camera) in enumerate(zip(names, cameras, strict=True), start=1):
            write_still(target / name, pictures, camera)
            report.progress(done, len(cameras), "rendering", "pictures")
    summary = {"pictures": len(cameras), "width": cameras[0].width, "height": cameras[0].height, "file": str(target)}
    return summary if what != "depth" else summary | {"nearest": pictures.depths[0], "farthest": pictures.depths[1]}


def write_still(stem: Path, pictures: FrameRenderer, camera: Camera) -> None:
    """Write an image as PNG; for depths or normals, also the values as float32 TIFF.

    Args:
        stem: The path without the suffix.
        pictures: Renders the frame.
        camera: Its camera.

    Raises:
        MachineError: if it cannot be written.
    """
    values = pictures.values(camera)
    pixels = pictures.pixels(camera, values)
    try:
        _write(stem.with_name(f"{stem.name}.png"), pixels[:, :, ::-1])
        if values is not None:
            _write(stem.with_name(f"{stem.name}.tif"), values if values.ndim == 2 else values[:, :, ::-1])
    except OSError as error:
        raise MachineError(f"Cannot write {stem}: {error.strerror}.", hint="Check the free space.") from error


def _write(path: Path, array: np.ndarray) -> None:
    done, data = cv2.imencode(path.suffix, np.ascontiguousarray(array))
    assert done, path
    write_file(path, data.tobytes())


def _keyframe_file(path: str) -> Path:
    file = Path(path).expanduser()
    if not file.is_file():
        raise UsageError(f"There is no file {path[:200]}.", hint="--path takes cameras, orbit, or a keyframe file.")
    return file
