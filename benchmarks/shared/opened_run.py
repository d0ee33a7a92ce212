"""A run's OUT opened for inspection: its splat with its render options, its photos, and which were held out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float32

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.runs.store import Part
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View, load_split, load_views
from splatpipe.pipeline.photos.pixels.images import Pixels, reduced_camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.render.rendering import Model, as_trained, render_pixels
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.sky.panorama import read_panorama
from splatpipe.stages.line import CLEAN, EXPORT, LINE, TRAIN


@dataclass(frozen=True, eq=False)
class OpenedRun:
    """Content of a finished run.

    Attributes:
        out: Its OUT.
        photos_dir: The user's photos.
        parts: The stages' artifacts, by name.
        model: The splat and its sky, if it has one.
        options: Render options that it was trained for.
        megapixels: Limit on the training size; None for the dataset's.
        views: All registered photos.
        held_out: Names of the held-out photos.
    """

    out: Path
    photos_dir: Path
    parts: dict[str, Part]
    model: Model = field(repr=False)
    options: rasterizer.RenderOptions
    megapixels: float | None
    views: list[View]
    held_out: tuple[str, ...]

    def camera(self, view: View) -> Camera:
        """Return a view's camera at training size."""
        return reduced_camera(view.camera, self.megapixels)

    def picture(self, camera: Camera) -> Pixels:
        """Render as `evaluate` does, (h, w, 3) RGB, 8 bits."""
        return render_pixels(self.model, camera, self.options)

    def median_depth(self, camera: Camera) -> Float32[np.ndarray, "h w"]:
        """Render median depths, (h, w) float32, world units along the viewing axis; 0 where there is no surface."""
        with torch.no_grad():
            return np.asarray(rasterizer.render(self.model[0], camera, self.options.for_depths()).median_depth.numpy())


def open_run(out: Path) -> OpenedRun:
    """Open a run that got at least as far as training.

    Raises:
        UsageError: if it did not.
    """
    folder = open_run_folder(out, LINE)
    photos_dir, _ = folder.settings()
    parts = folder.lineage(EXPORT, CLEAN, TRAIN)
    if "train.model" not in parts:
        raise UsageError(f"{out} has no trained splat.", hint="Run to the end of training.")
    parts.setdefault(
        "clean.model", parts["train.model"]
    )  # runs from before cleaning existed, or that ended with training
    gaussians = read_splat(parts["clean.model"].path)
    options, megapixels = as_trained(parts["train.rendering"].path, gaussians)
    views = load_views(parts["undistort.dataset"].path)
    held_out = load_split(parts["split.views"].path).held_out
    sky = read_panorama(parts["train.sky"].path) if "train.sky" in parts else None  # runs from before skies existed
    return OpenedRun(out, photos_dir, parts, (gaussians, sky), options, megapixels, views, held_out)


def write_png(path: Path, pixels: Pixels) -> None:
    """Write an RGB PNG, 8 bits."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels[:, :, ::-1]))
    assert done, path
    path.write_bytes(data.tobytes())
