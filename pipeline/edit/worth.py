"""What suspected Gaussians are worth to the photos: whether these are more like renders with them, or without.

Two renders of a photo's view, with all Gaussians and without the suspected ones, differ from the photo; how much better
the one with them is, is a picture, and its mean by a Gaussian's weights (``sightings.weights_of``) is that one's part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64

from splatpipe.pipeline.edit.sightings import Photos, grey_of, weights_of
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.images import Mask, Pixels
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.panorama import laid_over

Picture = Float32[np.ndarray, "h w 3"]
FITTED_PIXELS = 4  # every so manieth pixel along both sides is enough for a colour map


def worth_in_photos(
    gaussians: Gaussians, asked: Bool[np.ndarray, " n"], photos: Photos, told: Callable[[int], None]
) -> Float32[np.ndarray, " n"]:
    """How much smaller the squared errors of the photos' pixels are with the Gaussians than without, in sum.

    Exposure differs between photos and is forgiven: a colour map is fitted to each, as ``metrics.psnr_cc`` does.

    Args:
        gaussians: Where they are rendered, all of them; finite.
        asked: Those whose worth is wanted; they are left out together.
        photos: With pictures.
        told: Called with the number of photos that were looked through.

    Returns:
        Positive where photos are better with one; 0 of those that nobody asked for, and of the unseen.
    """
    assert photos.picture is not None
    kept = gaussians.select(torch.from_numpy(~asked).to(gaussians.means.device))
    grey, worth = grey_of(gaussians), np.zeros(len(gaussians), np.float32)
    plain = replace(photos.options, depth=False, magnitudes=False)
    for index, camera in enumerate(photos.cameras):
        photo, mask = photos.picture(index)
        with_them, without = (_rendered(model, camera, photos, plain) for model in (gaussians, kept))
        better = _better(with_them, without, photo, mask)
        picture = np.repeat(better[:, :, None], 3, axis=2)
        rendered = rasterizer.render(grey, camera, replace(plain, sh_degree=0))
        worth += weights_of(rendered, grey, picture)[:, 0]
        told(index + 1)
    worth[~asked] = 0.0
    return worth


def _rendered(model: Gaussians, camera: Camera, photos: Photos, options: rasterizer.RenderOptions) -> Picture:
    with torch.no_grad():
        rendered = rasterizer.render(model, camera, options)
        colour = rendered.colour
        if photos.sky is not None:
            behind = photos.sky.behind(camera, options.background)
            colour = laid_over(colour, rendered.alpha, options.background, behind)
    return np.asarray(colour.clamp(0.0, 1.0).numpy(force=True))


def _better(with_them: Picture, without: Picture, photo: Pixels, mask: Mask | None) -> Float32[np.ndarray, "h w"]:
    """By how much a pixel's squared error is smaller with them."""
    target = photo.astype(np.float32) / np.float32(255.0)
    colours = _colour_map(without, target, mask)
    errors = [((_mapped(picture, colours) - target) ** 2).sum(axis=2) for picture in (without, with_them)]
    better = np.asarray(errors[0] - errors[1], np.float32)
    if mask is not None:
        better[~mask] = 0.0
    return better


def _colour_map(picture: Picture, target: Picture, mask: Mask | None) -> Float64[np.ndarray, "4 3"]:
    """The affine map of colours that fits a picture to another best."""
    some = slice(FITTED_PIXELS // 2, None, FITTED_PIXELS)
    counts = np.ones(picture[some, some].shape[:2], np.bool_) if mask is None else mask[some, some]
    source = picture[some, some][counts].astype(np.float64)
    ones = np.ones((len(source), 1))
    return np.asarray(np.linalg.lstsq(np.hstack([source, ones]), target[some, some][counts], rcond=None)[0])


def _mapped(picture: Picture, colours: Float64[np.ndarray, "4 3"]) -> Picture:
    return np.asarray((picture @ colours[:3] + colours[3]).clip(0.0, 1.0), np.float32)
