"""A photo as depths are found in it: grey, with where it counts, and how its pixels get to another photo."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera

WINDOW = 11  # pixels a side that are compared, as in the kernel
NOISE = 1.5  # grey values: contrast below it is not taken for likeness
TEXTURE = 3.0  # standard deviation in a window below which a pixel has no depth...
AT_HAND = 3  # ...nor where contrast is all further off than in a window of this side: sky beside a roof, say


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo to compare.

    Attributes:
        camera: In the photo's grid.
        grey: 0 to 255.
        counts: False where the photo is masked.
    """

    camera: Camera
    grey: UInt8[np.ndarray, "h w"]
    counts: Bool[np.ndarray, "h w"]

    def halved(self) -> Picture:
        """The same at half the size; a pixel counts where all below it do."""
        size = (max(1, self.camera.width // 2), max(1, self.camera.height // 2))
        grey = cv2.resize(self.grey, size, interpolation=cv2.INTER_AREA)
        masked = cv2.resize((~self.counts).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return Picture(self.camera.scaled(*size), np.asarray(grey, np.uint8), np.asarray(masked == 0.0))

    def textured(self) -> Bool[np.ndarray, "h w"]:
        """Where there is something to compare, at hand, and nothing masked in the window."""
        grey = self.grey.astype(np.float32)
        wide, narrow = (_variance(grey, side) for side in (WINDOW, AT_HAND))
        return np.asarray((wide > TEXTURE**2) & (narrow > NOISE**2) & self.whole())

    def whole(self) -> Bool[np.ndarray, "h w"]:
        """Where nothing is masked in the window, nor beyond the photo's border."""
        kernel = np.ones((WINDOW, WINDOW), np.uint8)
        whole = cv2.erode(self.counts.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(whole > 0)


def relative(camera: Camera, other: Camera) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """From a camera's pixels p to another's: at depth z they are turn @ p + shift / z, homogeneous.

    A point at depth z is z K⁻¹ p, for the other camera z (R K⁻¹ p + t / z).
    """
    other_from_camera = other.cam_from_world @ np.linalg.inv(camera.cam_from_world)
    turn = other.k() @ other_from_camera[:3, :3] @ np.linalg.inv(camera.k())
    return np.asarray(turn), np.asarray(other.k() @ other_from_camera[:3, 3])


def _variance(grey: np.ndarray, side: int) -> np.ndarray:
    mean = cv2.blur(grey, (side, side))
    return np.asarray(cv2.blur(np.square(grey), (side, side)) - np.square(mean))
