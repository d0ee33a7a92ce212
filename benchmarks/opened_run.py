"""A run's OUT opened for looking: its splat as it was trained to be rendered, its photos, and which were held out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float32

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.run_folder import open_run_folder
from splatpipe.pipeline.engine.store import Part
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import View, load_split, load_views
from splatpipe.pipeline.photos.images import Pixels, reduced_camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.render.rendering import Model, as_trained, render_pixels
from splatpipe.pipeline.splat.panorama import read_panorama
from splatpipe.pipeline.splat.ply import read_splat
from splatpipe.stages.line import CLEAN, EXPORT, LINE, TRAIN


@dataclass(frozen=True, eq=False)
class OpenedRun:
    """What a run left.

    Attributes:
        out: Its OUT.
        photos_dir: The user's photos.
        parts: The stages' named parts.
        model: The splat and its sky, if it has one.
        options: How it was trained to be rendered.
        megapixels: Limit of the size that it was trained at; None for the dataset's.
        views: All registered photos.
        held_out: Names of those that it was not trained on.
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
        """A view's, at the size of training."""
        return reduced_camera(view.camera, self.megapixels)

    def picture(self, camera: Camera) -> Pixels:
        """A render as `evaluate` makes it, (h, w, 3) RGB, 8 bits."""
        return render_pixels(self.model, camera, self.options)

    def median_depth(self, camera: Camera) -> Float32[np.ndarray, "h w"]:
        """Of a render, (h, w) float32, world units along the view axis; 0 where there is no surface."""
        with torch.no_grad():
            return np.asarray(rasterizer.render(self.model[0], camera, self.options.for_depths()).median_depth.numpy())


def open_run(out: Path) -> OpenedRun:
    """Read what a run left, up to training at least.

    Raises:
        UsageError: if it is not there.
    """
    folder = open_run_folder(out, LINE)
    photos_dir, _ = folder.settings()
    parts = folder.lineage(EXPORT, CLEAN, TRAIN)
    if "train.model" not in parts:
        raise UsageError(f"{out} has no trained splat.", hint="Run to the end of training.")
    parts.setdefault("clean.model", parts["train.model"])  # runs of before there was cleaning, or up to training alone
    gaussians = read_splat(parts["clean.model"].path)
    options, megapixels = as_trained(parts["train.rendering"].path, gaussians)
    views = load_views(parts["undistort.dataset"].path)
    held_out = load_split(parts["split.views"].path).held_out
    sky = read_panorama(parts["train.sky"].path) if "train.sky" in parts else None  # runs of before there were skies
    return OpenedRun(out, photos_dir, parts, (gaussians, sky), options, megapixels, views, held_out)


def write_png(path: Path, pixels: Pixels) -> None:
    """RGB, 8 bits."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels[:, :, ::-1]))
    assert done, path
    path.write_bytes(data.tobytes())
