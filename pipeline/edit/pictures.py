"""Before-and-after images of a splat, side by side, from a photo's viewpoint or else obliquely from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.edit.workpiece import MIDDLE_QUANTILES
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Pixels
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.scene import Scene, turn_of

WIDTH, HEIGHT = 960, 720  # pixels of one image
FIELD_DEG = 45.0  # vertical field of view of an oblique view
ELEVATION_DEG, HEADING_DEG = 35.0, 30.0  # its angle below the horizon, and its heading clockwise from north
MIN_VISIBLE_SHARE = 0.3  # least share of a splat's centres within an image for it to count as shown
NEARLY_MOST_SHARE = 0.95  # photos that show nearly the most centres; of these, the one with the largest splat is used
MAX_SIZE_RATIO = 3.0  # size of what an image covers over the splat's, at most: the splat is still recognisable
NEAR_SHARE = 0.005  # near plane as a share of the distance to the splat
BACKGROUND = (0.82, 0.84, 0.86)  # contrasts with both white walls and dark roofs
GAP_PX = 8
LABEL_PX = 28

Points = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class PictureCameras:
    """Cameras of the two images, in the frame, z up."""

    before: Camera
    after: Camera


def choose_views(cameras: Sequence[Camera], before: Points, after: Float64[np.ndarray, "m 3"]) -> PictureCameras:
    """Choose the viewpoints: one for both images if it shows both splats.

    Args:
        cameras: The run's cameras, in the frame; empty if unknown.
        before: Sampled centres before the edit, in the frame, z up.
        after: The same after the edit.
    """
    photo = _best_photo(cameras, after)
    if photo is not None:
        first = photo if _share(photo, before) >= MIN_VISIBLE_SHARE else _best_photo(cameras, before)
        return PictureCameras(first or oblique_view(_box(before)), photo)
    boxes = [_box(before), _box(after)]
    both = np.array([np.minimum(*[box[0] for box in boxes]), np.maximum(*[box[1] for box in boxes])])
    if _size(both) <= MAX_SIZE_RATIO * min(_size(box) for box in boxes):
        return PictureCameras(oblique_view(both), oblique_view(both))
    return PictureCameras(oblique_view(boxes[0]), oblique_view(boxes[1]))


def _best_photo(cameras: Sequence[Camera], points: Points) -> Camera | None:
    small = [_reduced(camera) for camera in cameras]
    shares = [_share(camera, points) for camera in small]
    most = max(shares, default=0.0)
    if most < MIN_VISIBLE_SHARE:
        return None
    good = [camera for camera, share in zip(small, shares, strict=True) if share >= NEARLY_MOST_SHARE * most]
    return max(good, key=lambda camera: _spread(camera, points))  # the first one wins ties


def _reduced(camera: Camera) -> Camera:
    by = min(WIDTH / camera.width, HEIGHT / camera.height)
    return camera.scaled(max(1, round(camera.width * by)), max(1, round(camera.height * by)))


def _seen(camera: Camera, points: Points) -> Float64[np.ndarray, "m 2"]:
    """Pixel coordinates of those points that lie in the image."""
    inside = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    inside = inside[inside[:, 2] > 0.0]
    plan = inside[:, :2] / inside[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return np.asarray(plan[((plan >= 0.0) & (plan <= [camera.width, camera.height])).all(axis=1)])


def _share(camera: Camera, points: Points) -> float:
    return len(_seen(camera, points)) / max(1, len(points))


def _spread(camera: Camera, points: Points) -> float:
    return float(np.prod(np.std(_seen(camera, points), axis=0) / [camera.width, camera.height]))


def oblique_view(box: Float64[np.ndarray, "2 3"]) -> Camera:
    """A camera that shows a whole box obliquely from above.

    Args:
        box: Minimum and maximum east, north, up.
    """
    pitch, heading = math.radians(ELEVATION_DEG), math.radians(HEADING_DEG)
    forward = np.array([math.sin(heading) * math.cos(pitch), math.cos(heading) * math.cos(pitch), -math.sin(pitch)])
    right = np.array([math.cos(heading), -math.sin(heading), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    distance = max(_size(box) / 2.0, 1e-9) / math.sin(math.radians(FIELD_DEG) / 2.0)
    pose[:3, 3] = -pose[:3, :3] @ (box.mean(axis=0) - distance * forward)
    focal = HEIGHT / 2.0 / math.tan(math.radians(FIELD_DEG) / 2.0)
    return Camera("oblique", WIDTH, HEIGHT, focal, focal, WIDTH / 2.0, HEIGHT / 2.0, pose)


def _box(points: Points) -> Float64[np.ndarray, "2 3"]:
    return np.asarray(np.quantile(points, MIDDLE_QUANTILES, axis=0))


def _size(box: Float64[np.ndarray, "2 3"]) -> float:
    return float(np.linalg.norm(box[1] - box[0]))


def picture(scene: Scene, camera: Camera, points: Points, label: str) -> Pixels:
    """Render a labelled image of a splat.

    Args:
        scene: The splat, in its own axes.
        camera: The viewpoint, in the frame, z up.
        points: Sampled centres, in the frame.
        label: Text to write above the image.

    Raises:
        SplatpipeError: if it covers more pixels than memory holds.
    """
    pose = camera.cam_from_world.copy()
    pose[:3, :3] = pose[:3, :3] @ turn_of("z up", scene.facts.axes).numpy()
    away = float(np.linalg.norm(np.median(points, axis=0) - camera.centre()))
    options = rasterizer.RenderOptions(
        sh_degree=scene.gaussians.sh_degree,
        background=BACKGROUND,
        antialias=scene.facts.antialias,
        near=max(NEAR_SHARE * away, 1e-9),
        depth=False,
    )
    with torch.no_grad():
        colour = rasterizer.render(scene.gaussians, replace(camera, cam_from_world=pose), options).colour
    pixels = (colour.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).numpy()
    canvas = np.full((HEIGHT + LABEL_PX, WIDTH, 3), 255, np.uint8)
    top, left = LABEL_PX + (HEIGHT - camera.height) // 2, (WIDTH - camera.width) // 2
    canvas[top : top + camera.height, left : left + camera.width] = pixels
    cv2.putText(canvas, label, (6, LABEL_PX - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (40, 40, 40), 1, cv2.LINE_AA)
    return canvas


def write_side_by_side(path: Path, left: Pixels, right: Pixels) -> None:
    """Write two images as one PNG.

    Raises:
        OSError: if it cannot be written.
    """
    gap = np.full((left.shape[0], GAP_PX, 3), 255, np.uint8)
    done, data = cv2.imencode(".png", np.concatenate([left, gap, right], axis=1)[:, :, ::-1])
    assert done, path
    write_durably(path, lambda file: file.write(data.tobytes()))
