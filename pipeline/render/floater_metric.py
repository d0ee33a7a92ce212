"""Floater metrics: veil in front of held-out photos, share of the splat in free space, depth consistency."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks
from splatpipe.pipeline.photos.pixels.images import reduced_camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.render.blocked_light import measure_blocked_light
from splatpipe.pipeline.render.consistency import depth_differences, depth_disagreement, neighbouring_pairs
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.splat.quality.free_space import free_space, near_or_free, share_of_opacity

MAX_MEGAPIXELS = 0.5  # size of the depth maps: floaters are larger than their pixels, and results of all sizes compare


def measure_floaters(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    held_out: Container[str],
    dataset: Path,
    options: rasterizer.RenderOptions,
    area: PlanArea | None = None,
) -> dict[str, Any]:
    """The figures of `floaters` in metrics.json; None where the sparse model gives no answer.

    Free space is determined from all registered photos. Training uses the same criterion with its own photos, so only
    the veil in front of held-out photos, which is measured differently, is an independent check.

    Args:
        gaussians: The model.
        cameras: Cameras of all registered photos, at the evaluation size.
        held_out: Names of the photos that were not trained on.
        dataset: Their dataset, with the sparse points.
        options: How the model is rendered.
        area: Area of interest, in the model's frame; None for everything.
    """
    points, tracks = load_points_and_tracks(dataset)
    seen = [tracks[camera.name] for camera in cameras]
    space = free_space(cameras, points.xyz, seen)
    chosen = near_or_free(gaussians, space)
    floating, inside_seen = share_of_opacity(gaussians, chosen), seen
    if area is not None:
        inside, counts = _inside(area, gaussians), area.contains(points.xyz)
        floating, chosen = share_of_opacity(gaussians.select(inside), chosen[inside]), chosen & inside
        inside_seen = [rows[counts[rows]] for rows in seen]
    pairs = neighbouring_pairs(seen)
    places = sorted({place for pair in pairs for place in pair})
    small = {place: reduced_camera(cameras[place], MAX_MEGAPIXELS) for place in places}
    flagged, depths, light = _flagged(gaussians, chosen), {}, np.zeros(2)
    for place in places:
        depths[place], of_view = _depth_and_light(flagged, small[place], options)
        light += of_view
    both = [direction for a, b in pairs for direction in ((a, b), (b, a))]
    apart = depth_disagreement([depth_differences(small[a], depths[a], small[b], depths[b]) for a, b in both])
    return {
        "veil": measure_blocked_light(gaussians, cameras, (points.xyz, inside_seen), held_out, options),
        "free_space_opacity": _rounded(floating) if space.known else None,
        "free_space_gaussians": int(chosen.sum()) if space.known else None,
        "free_space_rendered": _rounded(light[0] / light[1]) if space.known and light[1] > 0.0 else None,
        "depth_disagreement": {
            "median": _rounded(apart.median),
            "share_above_5_percent": _rounded(apart.share),
            "pairs": len(pairs),
            "pixels": apart.pixels,
        },
    }


def _inside(area: PlanArea, gaussians: Gaussians) -> Bool[Tensor, " n"]:
    return torch.from_numpy(area.contains(gaussians.means.double().numpy(force=True)))


def _flagged(gaussians: Gaussians, chosen: Bool[Tensor, " n"]) -> Gaussians:
    """The same Gaussians, the chosen ones white and the others black: a render shows their share of light."""
    colours = rgb_to_dc(chosen.to(gaussians.sh)[:, None].expand(-1, 3))
    return replace(gaussians, sh=colours[:, None].contiguous())


def _depth_and_light(
    flagged: Gaussians, camera: Camera, options: rasterizer.RenderOptions
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, " 2"]]:
    """A view's median depth, and the total light that it gets from the chosen Gaussians and from all."""
    with torch.no_grad():
        rendered = rasterizer.render(flagged, camera, options.for_depths())
    light = [part.numpy(force=True).sum(dtype=np.float64) for part in (rendered.colour[..., 0], rendered.alpha)]
    return rendered.median_depth.numpy(force=True), np.array(light)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 6)
