"""A grey photo with its mask for depth estimation, and the mapping of its pixels to another photo."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera

WINDOW = 11  # side of the matching window in pixels, as in the kernel
NOISE_GREY = 1.5  # contrast in grey values below which it counts as noise
MIN_TEXTURE_GREY = 3.0  # standard deviation in the matching window: below it, a pixel has no depth,
NARROW_WINDOW = 3  # and neither where a window of this side has no contrast, e.g. sky beside a roof


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo to match.

    Attributes:
        camera: The camera at the photo's resolution.
        grey: Grey values, 0 to 255.
        counts: False where the photo is masked.
    """

    camera: Camera
    grey: UInt8[np.ndarray, "h w"]
    counts: Bool[np.ndarray, "h w"]

    def halved(self) -> Picture:
        """The photo at half the size; a pixel counts if all pixels that it covers do."""
        size = (max(1, self.camera.width // 2), max(1, self.camera.height // 2))
        grey = cv2.resize(self.grey, size, interpolation=cv2.INTER_AREA)
        masked = cv2.resize((~self.counts).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return Picture(self.camera.scaled(*size), np.asarray(grey, np.uint8), np.asarray(masked == 0.0))

    def textured(self) -> Bool[np.ndarray, "h w"]:
        """Pixels with texture around them and nothing masked in the window."""
        grey = self.grey.astype(np.float32)
        wide, narrow = (_variance(grey, side) for side in (WINDOW, NARROW_WINDOW))
        return np.asarray((wide > MIN_TEXTURE_GREY**2) & (narrow > NOISE_GREY**2) & self.whole())

    def whole(self) -> Bool[np.ndarray, "h w"]:
        """Pixels whose window holds nothing masked and lies inside the photo."""
        kernel = np.ones((WINDOW, WINDOW), np.uint8)
        whole = cv2.erode(self.counts.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(whole > 0)


def relative(camera: Camera, other: Camera) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """``turn`` and ``shift`` that map a camera's pixels p at depth z to another's: turn @ p + shift / z, homogeneous.

    A point at depth z is z K⁻¹ p; in the other camera it is z (R K⁻¹ p + t / z).
    """
    other_from_camera = other.cam_from_world @ np.linalg.inv(camera.cam_from_world)
    turn = other.k() @ other_from_camera[:3, :3] @ np.linalg.inv(camera.k())
    return np.asarray(turn), np.asarray(other.k() @ other_from_camera[:3, 3])


def _variance(grey: np.ndarray, side: int) -> np.ndarray:
    mean = cv2.blur(grey, (side, side))
    return np.asarray(cv2.blur(np.square(grey), (side, side)) - np.square(mean))
