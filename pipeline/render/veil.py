"""What hangs before the points that held-out photos see: a verdict on floaters that training has no say in.

Training removes what hangs in the space that its own photos see through (``splat.free_space``): Gaussian by Gaussian,
by the least depth of a cell's points. Here rays decide, those of photos that were never trained on: from a held-out
photo's camera to each of the sparse points that it observes nothing is to stop the light. What does is a floater,
whether solid or a haze of many, and also where no cell of a training photo says that the air is free.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
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


def measure_veil(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    observed: tuple[Float64[np.ndarray, "p 3"], Sequence[Int64[np.ndarray, " _"]]],
    held_out: Container[str],
) -> dict[str, Any]:
    """The figures of `floaters.veil` in metrics.json; None where no held-out photo sees points enough.

    Args:
        gaussians: The model.
        cameras: Of all registered photos.
        observed: The sparse points, world units, and the rows of those that each camera's photo observes.
        held_out: Names of the photos that were not trained on.
    """
    xyz, seen = observed
    photos = sum((np.bincount(np.unique(rows), minlength=len(xyz)) for rows in seen), np.zeros(len(xyz), np.int64))
    sure = (photos >= SUPPORT_TRACK) & np.isfinite(xyz).all(axis=1)  # a point of two rays may lie behind the surface
    veils: dict[str, float] = {}
    points = 0
    for camera, rows in zip(cameras, seen, strict=True):
        if camera.name in held_out:
            stopped = light_stopped(gaussians, reduced_camera(camera, LARGEST_MEGAPIXELS), xyz[rows[sure[rows]]])
            if len(stopped) >= LEAST_POINTS:
                veils[camera.name] = float(stopped.mean())
                points += len(stopped)
    worst = max(veils, key=lambda name: veils[name], default=None)
    return {
        "mean": round(sum(veils.values()) / len(veils), 6) if veils else None,
        "worst": None if worst is None else round(veils[worst], 6),
        "worst_photo": worst,
        "photos": len(veils),
        "points": points,
    }


def light_stopped(gaussians: Gaussians, camera: Camera, xyz: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " k"]:
    """The part of the light, 0 to 1, that is stopped on its way from points to a camera.

    A tenth of the way before a point does not count, nor what reaches into it with one of its standard deviations: that
    is the surface. Points come in slices of depth, each with what is nearer than its first, so it is a little more.

    Args:
        gaussians: The model.
        camera: The camera.
        xyz: The points, world units; those outside the picture are left out.

    Returns:
        The accumulated opacity of each point in the picture, in the order of their depths.
    """
    _, pixels, depths = camera.in_view(xyz)
    order = np.argsort(depths, kind="stable")
    pixels, depths = pixels[order], depths[order]
    reach = camera.depths(gaussians.means.detach().numpy().astype(np.float64))
    reach += spread_along(gaussians, np.arange(len(gaussians)), camera.cam_from_world[2, :3])
    stopped = np.zeros(len(depths))
    options = rasterizer.RenderOptions(sh_degree=0, depth=False)
    for part in np.array_split(np.arange(len(depths)), SLICES):
        before = np.flatnonzero(reach < (1.0 - MARGIN) * depths[part[0]]) if len(part) else part
        if len(before):
            with torch.no_grad():
                alpha = rasterizer.render(gaussians.select(torch.from_numpy(before)), camera, options).alpha.numpy()
            columns, rows = pixels[part].astype(np.int64).T
            stopped[part] = alpha[rows, columns]
    return stopped
