"""Attributes the change in photometric error to suspected Gaussians: how much closer renders with them are to photos.

Many are suspected at once, and what hides a surface shares its pixels with what lies behind it. So the difference
between the squared errors with and without all of them is attributed by Aumann-Shapley values (A. E. Aumann and L. S.
Shapley, "Values of Non-Atomic Games", 1974): each gets the integral of the derivative with respect to its own opacity
along the path from none of them to all. For a single Gaussian a pixel's colour is linear in its opacity, the squared
error is quadratic, and the derivative at the midpoint equals the difference; so all suspected ones are rendered at half
their opacity, and one backward pass gives all values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from splatpipe.pipeline.edit.floaters.visibility import TrainingPhotos
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.pulled_back import pulled_back
from splatpipe.pipeline.raster.sky import SkyLayer, laid_over_nodes
from splatpipe.pipeline.splat.model.gaussians import Gaussians

Picture = Float32[np.ndarray, "h w 3"]
FITTED_PIXELS = 4  # the colour map is fitted to every fourth pixel in both directions
HALFWAY = 0.5
LEVELS = np.arange(256, dtype=np.float32) / np.float32(255.0)  # of 8 bits, as renders have them


@dataclass(frozen=True, eq=False)
class PhotoErrorChange:
    """Changes of the squared error with each Gaussian (pixels 0..1, three channels), summed over the photos compared.

    Attributes:
        better: Total decrease, over the photos in which the error decreases.
        worse: Total increase, over the others.
    """

    better: Float32[np.ndarray, " n"]
    worse: Float32[np.ndarray, " n"]


def error_change_in_photos(
    gaussians: Gaussians, asked: Bool[np.ndarray, " n"], photos: TrainingPhotos, on_progress: Callable[[int], None]
) -> PhotoErrorChange:
    """Compute how much each Gaussian decreases and increases the photos' error.

    Exposure differences between photos are compensated: a colour map is fitted to each, as in ``metrics.psnr_cc``.

    Args:
        gaussians: All Gaussians, finite, on the device that renders them.
        asked: Which Gaussians to evaluate.
        photos: The training photos, with images.
        on_progress: Called with the number of photos done.

    Returns:
        The changes; 0 for Gaussians not asked for or not seen.
    """
    assert photos.picture is not None
    options = replace(photos.options, depth=False, magnitudes=False)
    wanted = torch.from_numpy(asked).to(gaussians.means.device)
    opacity = torch.sigmoid(gaussians.opacity_logits.detach())
    halved_opacity = torch.where(wanted, HALFWAY * opacity, opacity)
    logits = torch.logit(halved_opacity).requires_grad_()
    halfway = replace(gaussians.detach(), opacity_logits=logits)
    per_logit = torch.where(
        wanted, opacity / (halved_opacity * (1.0 - halved_opacity)), torch.zeros(()).to(opacity)
    ).numpy(force=True)
    better, worse = np.zeros(len(gaussians), np.float32), np.zeros(len(gaussians), np.float32)
    for done, index in enumerate(photos.compared_photos, start=1):
        colour = _rendered(halfway, photos.cameras[index], photos, options)
        downhill = _error_slope(colour, *photos.picture(index))
        paid = pulled_back(colour, downhill, logits).numpy(force=True) * per_logit
        better -= np.minimum(paid, 0.0)
        worse += np.maximum(paid, 0.0)
        on_progress(done)
    return PhotoErrorChange(better, worse)


def _rendered(model: Gaussians, camera: Camera, photos: TrainingPhotos, options: rasterizer.RenderOptions) -> Tensor:
    rendered = rasterizer.render(model, camera, options)
    if photos.sky is None:
        return rendered.colour
    nodes = photos.sky.view_from(camera).at_nodes(photos.sky.colours, options.background)
    return laid_over_nodes(rendered.colour, rendered.alpha, nodes, SkyLayer(options.background))


def _error_slope(colour: Tensor, photo: Pixels, mask: Mask | None) -> Tensor:
    """Gradient of a render's squared error with respect to its pixels; 0 where the photo is masked."""
    picture = np.asarray(colour.detach().clamp(0.0, 1.0).numpy(force=True))
    target = np.asarray(cv2.LUT(photo, LEVELS))
    colours = _colour_map(picture, target, mask)
    error = np.asarray(cv2.transform(picture, colours.T))
    np.clip(error, 0.0, 1.0, out=error)
    error -= target
    if mask is not None:
        error[~mask] = 0.0
    return torch.from_numpy(np.asarray(cv2.transform(error, 2.0 * colours[:3]))).to(colour)


def _colour_map(picture: Picture, target: Picture, mask: Mask | None) -> Float64[np.ndarray, "4 3"]:
    """The least-squares affine colour map from one image to another."""
    some = slice(FITTED_PIXELS // 2, None, FITTED_PIXELS)
    counts = np.ones(picture[some, some].shape[:2], np.bool_) if mask is None else mask[some, some]
    source = picture[some, some][counts].astype(np.float64)
    ones = np.ones((len(source), 1))
    return np.asarray(np.linalg.lstsq(np.hstack([source, ones]), target[some, some][counts], rcond=None)[0])
