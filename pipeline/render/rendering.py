"""Rendering a model as it was trained: colours over its sky, depths and normals."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Pixels
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.device import Device
from splatpipe.pipeline.raster.reference import project
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.splat.sky.panorama import STEP_PX, Panorama, composite_over

Model = tuple[Gaussians, Panorama | None]
MIN_SURFACE_ALPHA = 0.5  # minimum alpha of a pixel that shows a surface, as for the median depth
MAX_MEAN_OFFSET_PX = 2.0  # maximum distance of a mean depth from the median, in GSD: beyond it the mean follows haze
STRIP_PIXELS = 1 << 21  # rendered at once: an image of 100 megapixels takes no more memory than one of two


@dataclass(frozen=True)
class Rendering:
    """How a model is to be rendered, known before it is trained.

    Attributes:
        antialias: Whether opacities compensate for the screen-space blur.
        background: Background colour: red, green, blue, 0..1.
        near: Near plane, world units.
        megapixels: Photos are reduced to at most this size; None keeps the dataset's size.
    """

    antialias: bool
    background: tuple[float, float, float]
    near: float
    megapixels: float | None

    def to_json(self) -> str:
        """The text of `rendering.json`."""
        return json.dumps(asdict(self), indent=1) + "\n"

    def options(self, gaussians: Gaussians) -> rasterizer.RenderOptions:
        """The rasterizer's options for a model."""
        return rasterizer.RenderOptions(
            sh_degree=gaussians.sh_degree,
            background=self.background,
            antialias=self.antialias,
            near=self.near,
            depth=False,
        )


def load_rendering(path: Path) -> Rendering:
    """Read the output `rendering.json` of `train`.

    Raises:
        StageError: if it is not such a file.
    """
    try:
        fields = read_json(path)
        red, green, blue = map(float, fields["background"])
        megapixels = None if fields["megapixels"] is None else float(fields["megapixels"])
        return Rendering(bool(fields["antialias"]), (red, green, blue), float(fields["near"]), megapixels)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun-from train.") from error


def as_trained(rendering: Path, gaussians: Gaussians) -> tuple[rasterizer.RenderOptions, float | None]:
    """How the model was trained to be rendered, and the megapixels that photos were reduced to.

    Args:
        rendering: Path of `train.rendering`.
        gaussians: The model.

    Raises:
        StageError: if the file is broken.
    """
    found = load_rendering(rendering)
    return found.options(gaussians), found.megapixels


def placed(model: Model, device: Device) -> Model:
    """The model on the rendering device."""
    gaussians, sky = model
    return gaussians.to(device.tensors), None if sky is None else sky.to(device.tensors)


def strips(camera: Camera) -> list[Camera]:
    """Strips of an image from top to bottom, of at most ``STRIP_PIXELS``, with borders on the sky's nodes."""
    rows = camera.height
    if camera.width * rows > STRIP_PIXELS:
        rows = max(STEP_PX, STRIP_PIXELS // camera.width // STEP_PX * STEP_PX)
    tops = range(0, camera.height, rows)
    return [camera.crop(0, top, camera.width, min(rows, camera.height - top)) for top in tops]


def _by_strips(camera: Camera, made: Callable[[Camera], np.ndarray]) -> np.ndarray:
    """An image made strip by strip, into a single array."""
    first, *rest = strips(camera)
    part = made(first)
    if not rest:
        return part
    picture = np.empty((camera.height, *part.shape[1:]), part.dtype)
    picture[: first.height], done = part, first.height
    for strip in rest:
        picture[done : done + strip.height] = made(strip)
        done += strip.height
    return picture


def render_pixels(model: Model, camera: Camera, options: rasterizer.RenderOptions) -> Pixels:
    """Render a camera's view, with the sky if there is one, to 8 bits, (h, w, 3) RGB, rounded to the nearest step."""
    with torch.no_grad():
        return _by_strips(camera, lambda strip: _pixels(model, strip, options))


def _pixels(model: Model, camera: Camera, options: rasterizer.RenderOptions) -> Pixels:
    gaussians, sky = model
    rendered = rasterizer.render(gaussians, camera, options)
    colour = rendered.colour
    if sky is not None:
        behind = sky.behind(camera, options.background)
        colour = composite_over(colour, rendered.alpha, options.background, behind)
    return np.asarray((colour.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).cpu().numpy())


def render_depth(gaussians: Gaussians, camera: Camera, options: rasterizer.RenderOptions) -> Float[np.ndarray, "h w"]:
    """A camera's median depth, world units along the view axis; 0 where the model has none."""
    with torch.no_grad():
        return _by_strips(camera, lambda strip: _depths(gaussians, strip, options.for_depths()))


def _depths(gaussians: Gaussians, camera: Camera, options: rasterizer.RenderOptions) -> Float[np.ndarray, "h w"]:
    return np.asarray(rasterizer.render(gaussians, camera, options).median_depth.cpu().numpy())


def render_mean_depth(
    gaussians: Gaussians, camera: Camera, options: rasterizer.RenderOptions
) -> Float[np.ndarray, "h w"]:
    """A camera's mean depth along each ray, weighted by contribution; units as for ``render_depth``.

    Clamped to ``MAX_MEAN_OFFSET_PX`` GSD around the median, which distant background shining through does not
    pull behind the surface. For a flattened model the mean is the more accurate of the two.
    """
    with torch.no_grad():
        return _by_strips(camera, lambda strip: _mean_depths(gaussians, strip, options.for_depths()))


def _mean_depths(gaussians: Gaussians, camera: Camera, options: rasterizer.RenderOptions) -> Float[np.ndarray, "h w"]:
    rendered = rasterizer.render(gaussians, camera, options)
    median = rendered.median_depth
    seen = (rendered.alpha >= MIN_SURFACE_ALPHA) & (median > 0.0)
    off = torch.where(seen, rendered.depth_sum, 0.0) / torch.where(seen, rendered.alpha, 1.0) - median
    most = MAX_MEAN_OFFSET_PX / camera.fx * median
    return np.asarray(torch.where(seen, median + torch.clamp(off, -most, most), 0.0).cpu().numpy())


def render_normals(
    gaussians: Gaussians, camera: Camera, options: rasterizer.RenderOptions
) -> Float[np.ndarray, "h w 3"]:
    """Surface normals in a camera's view: unit vectors in the model's frame, towards the camera; 0 without a surface.

    Each Gaussian is rendered with its normal as colour: that of the plane on which rays peak in it (the one that depths
    come from: Zhang et al., "RaDe-GS: Rasterizing Depth in Gaussian Splatting", 2024). The gradient of the median depth
    would have a step wherever one Gaussian takes over from the next.
    """
    with torch.no_grad():
        splats = project(gaussians, camera, options)
        slopes = splats.depth_slopes * splats.means.new_tensor([camera.fx, camera.fy]) / splats.depths[:, None]
        rays = (splats.means - splats.means.new_tensor([camera.cx, camera.cy])) / splats.means.new_tensor(
            [camera.fx, camera.fy]
        )
        normals = torch.cat([slopes, -1.0 - (slopes * rays).sum(1, keepdim=True)], dim=1)
        normals = normals / torch.linalg.vector_norm(normals, dim=1, keepdim=True)
        normals = normals @ normals.new_tensor(camera.cam_from_world[:3, :3])
        coloured = replace(
            gaussians, sh=rgb_to_dc(0.5 + 0.5 * torch.where(splats.usable[:, None], normals, 0.0))[:, None]
        )
        plain = replace(options.for_depths(), depth=False)
        return _by_strips(camera, lambda strip: _directions(coloured, strip, plain))


def _directions(coloured: Gaussians, camera: Camera, options: rasterizer.RenderOptions) -> Float[np.ndarray, "h w 3"]:
    """Unit vectors from Gaussians whose colours encode them, as 0.5 + 0.5 n."""
    rendered = rasterizer.render(coloured, camera, options)
    alpha = rendered.alpha[..., None]
    summed = 2.0 * rendered.colour - alpha
    length = torch.linalg.vector_norm(summed, dim=2, keepdim=True)
    seen = (alpha >= MIN_SURFACE_ALPHA) & (length > 0.0)
    return np.asarray(torch.where(seen, summed / length.clamp_min(1e-12), 0.0).cpu().numpy())
