"""A short video of a moving texture."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from splatpipe.pipeline.film.video import VideoWriter

WIDTH, HEIGHT = 322, 182  # even, and nothing that codecs like better


def frames(count: int, width: int = WIDTH, height: int = HEIGHT) -> Iterator[np.ndarray]:
    """A moving coloured texture; red, green and blue are distinguishable."""
    noise = np.random.default_rng(0).integers(0, 255, (height + count, width + 2 * count, 3), dtype=np.uint8)
    texture = cv2.GaussianBlur(noise, (0, 0), 4.0).astype(np.float32)
    texture = (texture - texture.mean()) * 3.0 + np.array([190.0, 120.0, 60.0], np.float32)
    texture = np.clip(texture, 0, 255).astype(np.uint8)
    for k in range(count):
        yield np.ascontiguousarray(texture[k : k + height, 2 * k : 2 * k + width])


def write(path: Path, count: int = 20, fps: int = 25, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    with VideoWriter(path, size, fps) as film:
        for frame in frames(count, *size):
            film.write(frame)
    return path
