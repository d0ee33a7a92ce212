"""Renders of a run's scene for the library; apart, since it loads torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.film.filming import MAX_SIDE, MIN_SIDE, FrameRenderer, TrainedScene, What, depth_range
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.pixels.images import Pixels
from splatpipe.pipeline.raster.threads import same_bits


def require_renderable(camera: Camera, what: str) -> None:
    """Check what to render.

    Raises:
        UsageError: if the image would be too large or too small, a number is not finite, or the kind is unknown.
    """
    if what not in ("colour", "depth", "normals"):
        raise UsageError(f'"{what[:20]}" cannot be rendered.', hint="Choose colour, depth or normals.")
    if not all(MIN_SIDE <= side <= MAX_SIDE for side in (camera.width, camera.height)):
        raise UsageError(
            f"An image of {camera.width} × {camera.height} pixels cannot be rendered.",
            hint=f"Its sides must have {MIN_SIDE} to {MAX_SIDE} pixels; camera.scaled(width, height) changes them.",
        )
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    if not (np.isfinite(lens).all() and np.isfinite(camera.cam_from_world).all() and (lens[:2] > 0.0).all()):
        raise UsageError("The camera's lens or pose is not finite.", hint="Check its numbers.")


def render_view(
    scene: TrainedScene, world_from_model: Similarity, camera: Camera, what: What, threads: int
) -> tuple[Pixels, Float[np.ndarray, "h w *k"] | None]:
    """Render an image of a scene.

    Args:
        scene: The scene.
        world_from_model: From its frame to that of depths and normals.
        camera: In the scene's frame.
        what: What to show.
        threads: Of the rasterizer, at least 1.

    Returns:
        Pixels, and the values that they show; None for colours.
    """
    with same_bits(threads):
        pictures = FrameRenderer(scene, what, world_from_model.rotation, world_from_model.scale)
        if what == "depth":
            pictures = replace(pictures, depths=depth_range(pictures, [camera]))
        values = pictures.values(camera)
        return pictures.pixels(camera, values), values
