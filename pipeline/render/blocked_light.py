"""The veil in front of points that held-out photos see: a floater metric independent of training.

Training removes Gaussians in the free space of its own photos (``splat.quality.free_space``), one by one, by the
smallest depth of a cell's points. Here the rays of photos that were never trained on decide: nothing should stop the
light between a held-out photo's camera and each sparse point that it observes. Whatever does is a floater, solid or a
haze of many, even where no cell of a training photo shows free space. If no photo is held out, training photos are
used.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import reduced_camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality.free_space import MARGIN, SUPPORT_TRACK, spread_along

MAX_MEGAPIXELS = 0.5  # size of the renders: floaters are larger than their pixels
SLICES = 8  # parts of a photo's points by depth; each is judged by a render of everything nearer than its first point
MIN_POINTS = 20  # points a photo needs to be measured: fewer lie in one corner of it
MAX_TRAINED = (
    64  # training photos, evenly over the capture, where none is held out: as many as a large capture holds out
)


def measure_blocked_light(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    observed: tuple[Float64[np.ndarray, "p 3"], Sequence[Int64[np.ndarray, " _"]]],
    held_out: Container[str],
    options: rasterizer.RenderOptions,
) -> dict[str, Any]:
    """The figures of `floaters.veil` in metrics.json; None if no photo used sees enough points.

    Args:
        gaussians: The model.
        cameras: Cameras of all registered photos.
        observed: The sparse points, world units, and the rows of those that each camera's photo observes.
        held_out: Names of the held-out photos; if there are none among the cameras, training photos are used.
        options: How the model is rendered.
    """
    asked = [place for place, camera in enumerate(cameras) if camera.name in held_out]
    of_held_out = bool(asked)
    if not of_held_out:
        asked = list(range(0, len(cameras), max(1, math.ceil(len(cameras) / MAX_TRAINED))))
    xyz, seen = observed
    photos = sum((np.bincount(np.unique(rows), minlength=len(xyz)) for rows in seen), np.zeros(len(xyz), np.int64))
    sure = (photos >= SUPPORT_TRACK) & np.isfinite(xyz).all(axis=1)  # a two-ray point may lie behind the surface
    shares: dict[str, float] = {}
    points = 0
    for place in asked:
        small, rows = reduced_camera(cameras[place], MAX_MEGAPIXELS), seen[place]
        stopped = blocked_shares(gaussians, small, xyz[rows[sure[rows]]], options)
        if len(stopped) >= MIN_POINTS:
            shares[small.name] = float(stopped.mean())
            points += len(stopped)
    worst = max(shares, key=lambda name: shares[name], default=None)
    return {
        "held_out": of_held_out,
        "mean": round(sum(shares.values()) / len(shares), 6) if shares else None,
        "worst": None if worst is None else round(shares[worst], 6),
        "worst_photo": worst,
        "photos": len(shares),
        "points": points,
    }


def blocked_shares(
    gaussians: Gaussians, camera: Camera, xyz: Float64[np.ndarray, "n 3"], options: rasterizer.RenderOptions
) -> Float64[np.ndarray, " k"]:
    """The share of light, 0 to 1, that is stopped on its way from points to a camera.

    The last tenth of the way to a point does not count, nor Gaussians that reach into it within one standard deviation:
    that is the surface. Points are processed in depth slices, each with everything nearer than its first point, so the
    margin is slightly larger for the others.

    Args:
        gaussians: The model.
        camera: The camera.
        xyz: The points, world units; those outside the image are left out.
        options: How the model is rendered; Gaussians before its near plane stop nothing.

    Returns:
        The accumulated opacity in front of each point in the image, in order of depth.
    """
    _, pixels, depths = camera.in_view(xyz)
    order = np.argsort(depths, kind="stable")
    pixels, depths = pixels[order], depths[order]
    reach = camera.depths(gaussians.means.numpy(force=True).astype(np.float64))
    reach += spread_along(gaussians, np.arange(len(gaussians)), camera.cam_from_world[2, :3])
    stopped = np.zeros(len(depths))
    options = replace(options, sh_degree=0, depth=False)  # only alpha is used
    gaussians = replace(gaussians, sh=gaussians.sh[:, :1])  # most of what would be copied
    for part in np.array_split(np.arange(len(depths)), SLICES):
        before = np.flatnonzero(reach < (1.0 - MARGIN) * depths[part[0]]) if len(part) else part
        if len(before):
            with torch.no_grad():
                rendered = rasterizer.render(gaussians.select(torch.from_numpy(before)), camera, options)
            columns, rows = pixels[part].astype(np.int64).T
            stopped[part] = rendered.alpha.numpy(force=True)[rows, columns]
    return stopped
