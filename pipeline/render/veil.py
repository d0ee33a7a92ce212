"""What hangs before the points that held-out photos see: a verdict on floaters that training has no say in.

Training removes what hangs in the space that its own photos see through (``splat.free_space``): Gaussian by Gaussian,
by the least depth of a cell's points. Here rays decide, those of photos that were never trained on: from a held-out
photo's camera to each of the sparse points that it observes nothing is to stop the light. What does is a floater,
whether solid or a haze of many, and also where no cell of a training photo says that the air is free. Where no photo is
held out, training photos are all that there are to look from.
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
from splatpipe.pipeline.photos.images import reduced_camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.free_space import MARGIN, SUPPORT_TRACK, spread_along
from splatpipe.pipeline.splat.gaussians import Gaussians

LARGEST_MEGAPIXELS = 0.5  # of the renders: what floats is larger than their pixels
SLICES = 8  # of a photo's points by depth, each with a render of what is nearer than its first: 8 renders a photo
LEAST_POINTS = 20  # of a photo that counts: fewer lie in one corner of it
MOST_TRAINED = (
    64  # training photos, evenly over the capture, where none is held out: as many as a large capture holds out
)


def measure_veil(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    observed: tuple[Float64[np.ndarray, "p 3"], Sequence[Int64[np.ndarray, " _"]]],
    held_out: Container[str],
    options: rasterizer.RenderOptions,
) -> dict[str, Any]:
    """The figures of `floaters.veil` in metrics.json; None where no photo that is asked sees points enough.

    Args:
        gaussians: The model.
        cameras: Of all registered photos.
        observed: The sparse points, world units, and the rows of those that each camera's photo observes.
        held_out: Names of the photos that were not trained on; where no camera's is, training photos are asked.
        options: How the model is rendered.
    """
    asked = [place for place, camera in enumerate(cameras) if camera.name in held_out]
    of_held_out = bool(asked)
    if not of_held_out:
        asked = list(range(0, len(cameras), max(1, math.ceil(len(cameras) / MOST_TRAINED))))
    xyz, seen = observed
    photos = sum((np.bincount(np.unique(rows), minlength=len(xyz)) for rows in seen), np.zeros(len(xyz), np.int64))
    sure = (photos >= SUPPORT_TRACK) & np.isfinite(xyz).all(axis=1)  # a point of two rays may lie behind the surface
    veils: dict[str, float] = {}
    points = 0
    for place in asked:
        small, rows = reduced_camera(cameras[place], LARGEST_MEGAPIXELS), seen[place]
        stopped = light_stopped(gaussians, small, xyz[rows[sure[rows]]], options)
        if len(stopped) >= LEAST_POINTS:
            veils[small.name] = float(stopped.mean())
            points += len(stopped)
    worst = max(veils, key=lambda name: veils[name], default=None)
    return {
        "held_out": of_held_out,
        "mean": round(sum(veils.values()) / len(veils), 6) if veils else None,
        "worst": None if worst is None else round(veils[worst], 6),
        "worst_photo": worst,
        "photos": len(veils),
        "points": points,
    }


def light_stopped(
    gaussians: Gaussians, camera: Camera, xyz: Float64[np.ndarray, "n 3"], options: rasterizer.RenderOptions
) -> Float64[np.ndarray, " k"]:
    """The part of the light, 0 to 1, that is stopped on its way from points to a camera.

    A tenth of the way before a point does not count, nor what reaches into it with one of its standard deviations: that
    is the surface. Points come in slices of depth, each with what is nearer than its first, so it is a little more.

    Args:
        gaussians: The model.
        camera: The camera.
        xyz: The points, world units; those outside the picture are left out.
        options: How the model is rendered: what its near plane cuts off is in no picture, and stops nothing.

    Returns:
        The accumulated opacity of each point in the picture, in the order of their depths.
    """
    _, pixels, depths = camera.in_view(xyz)
    order = np.argsort(depths, kind="stable")
    pixels, depths = pixels[order], depths[order]
    reach = camera.depths(gaussians.means.numpy(force=True).astype(np.float64))
    reach += spread_along(gaussians, np.arange(len(gaussians)), camera.cam_from_world[2, :3])
    stopped = np.zeros(len(depths))
    options = replace(options, sh_degree=0, depth=False)  # alpha is all that counts
    for part in np.array_split(np.arange(len(depths)), SLICES):
        before = np.flatnonzero(reach < (1.0 - MARGIN) * depths[part[0]]) if len(part) else part
        if len(before):
            with torch.no_grad():
                rendered = rasterizer.render(gaussians.select(torch.from_numpy(before)), camera, options)
            columns, rows = pixels[part].astype(np.int64).T
            stopped[part] = rendered.alpha.numpy(force=True)[rows, columns]
    return stopped
