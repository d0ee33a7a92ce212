"""Photos of a textured plain with blocks under a sky, by ray tracing: the sky's pixels are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tiny_scene

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.sky.sky_mask import SkyPhoto, directions

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0
EYE = 2.0  # world units above the plain
BLUE = ((0.35, 0.55, 0.9), (0.8, 0.88, 0.97))  # at the zenith, at the horizon
OVERCAST = ((0.86, 0.87, 0.88), (0.93, 0.93, 0.93))
UP = np.array([0.0, 0.0, 1.0])
POINTS = 1500


@dataclass(frozen=True)
class Block:
    """A wall that faces the camera's side: x from, x to, y, height; its texture's contrast and colour."""

    left: float
    right: float
    y: float
    height: float
    contrast: float = 0.25
    colour: tuple[float, float, float] = (0.45, 0.4, 0.35)


HOUSES = (Block(-9.0, -2.0, 20.0, 5.0), Block(1.0, 6.0, 16.0, 3.0), Block(6.0, 15.0, 30.0, 8.0))


def aimed_camera(heading_deg: float = 0.0, pitch_deg: float = 5.0, roll_deg: float = 0.0, x: float = 0.0) -> Camera:
    """Return a camera on the plain; heading 0 looks along +y."""
    heading, pitch, roll = np.radians([heading_deg, pitch_deg, roll_deg])
    forward = np.array([np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)])
    level = np.array([np.cos(heading), -np.sin(heading), 0.0])
    down = np.cross(forward, level)
    right = np.cos(roll) * level + np.sin(roll) * down
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.array([x, 0.0, EYE])
    return Camera(f"{heading_deg}_{x}", WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def trace(
    camera: Camera, blocks: Sequence[Block] = HOUSES, sky: tuple[tuple[float, ...], tuple[float, ...]] = BLUE
) -> tuple[SkyPhoto, np.ndarray]:
    """Return the photo, and a mask of the rays that hit nothing."""
    rays, origin = directions(camera), camera.centre()
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    zenith, horizon = np.array(sky)
    share = np.clip(rays[:, :, 2:], 0.0, 1.0) ** 0.5
    colour = (1.0 - share) * horizon + share * zenith
    nearest = np.full(rays.shape[:2], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[:, :, 2] < 0.0, -origin[2] / rays[:, :, 2], np.inf)
        _paint(colour, nearest, ground, rays, origin, ((0.35, 0.42, 0.25), 0.25))
        for block in blocks:
            distance = (block.y - origin[1]) / rays[:, :, 1]
            hit = origin + distance[:, :, None] * rays
            inside = (hit[:, :, 0] > block.left) & (hit[:, :, 0] < block.right) & (distance > 0.0)
            inside &= (hit[:, :, 2] > 0.0) & (hit[:, :, 2] < block.height)
            _paint(colour, nearest, np.where(inside, distance, np.inf), rays, origin, (block.colour, block.contrast))
    noise = np.random.default_rng(1).normal(scale=0.006, size=colour.shape)
    pixels = (np.clip(colour + noise, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return SkyPhoto(camera, pixels), np.isinf(nearest)


def _paint(colour, nearest, distance, rays, origin, appearance):  # type: ignore[no-untyped-def]
    base, contrast = appearance
    seen = distance < nearest
    grain = np.random.default_rng(2).uniform(-1.0, 1.0, (HEIGHT // 4, WIDTH // 4)).astype(np.float32)
    grain = cv2.resize(grain, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    colour[seen] = (np.array(base) + contrast * grain[:, :, None])[seen]
    nearest[seen] = distance[seen]


def points_on(blocks: Sequence[Block] = HOUSES) -> np.ndarray:
    """Return triangulated points on the plain, and on the textured blocks."""
    random = np.random.default_rng(3)
    ground = random.uniform([-15.0, 4.0, 0.0], [15.0, 40.0, 0.0], (POINTS, 3))
    walls = [
        random.uniform([block.left, block.y, 0.0], [block.right, block.y, block.height], (POINTS // 2, 3))
        for block in blocks
        if block.contrast > 0.0
    ]
    return np.concatenate([ground, *walls])


def overlap(found: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union."""
    return float((found & truth).sum() / max(1, (found | truth).sum()))


HEADINGS = (-24.0, -15.0, -6.0, 4.0, 13.0, 22.0)


def write_dataset(folder: Path, pitch_deg: float = 5.0) -> Path:
    """Write a dataset of photos of the blocks, in `undistort`'s format; every camera sees the ground's points."""
    cameras = [
        replace(aimed_camera(heading, pitch_deg, x=0.1 * heading), name=f"{i}.png")
        for i, heading in enumerate(HEADINGS)
    ]
    for camera in cameras:
        path = folder / "images" / camera.name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), trace(camera)[0].pixels[:, :, ::-1])
    points = points_on()
    tiny_scene.write_model(folder / "sparse/0", cameras, points, np.full((len(points), 3), 120, np.uint8))
    return folder
