"""How alike two photos are around a pixel, the second one seen through a surface: zero-mean normalised correlation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from splatpipe.pipeline.geometry.camera import Camera

WINDOW = 7  # pixels a side
NOISE = 1.5 / 255.0  # of a photo's grey values: contrast below it is not taken for likeness
TEXTURE = 3.0 / 255.0  # standard deviation in a window below which a pixel has no depth...
AT_HAND = 3  # ...nor where contrast is all further off than in a window of this side: sky beside a roof, say
CENTRE_PX = 0.5  # of the first pixel; OpenCV's is at 0


@dataclass(frozen=True)
class Picture:
    """A photo to compare.

    Attributes:
        camera: In the photo's grid.
        grey: 0 to 1.
        counts: False where the photo is masked.
    """

    camera: Camera
    grey: Float32[np.ndarray, "h w"]
    counts: Bool[np.ndarray, "h w"]

    def halved(self) -> Picture:
        """The same at half the size; a pixel counts where all below it do."""
        size = (max(1, self.camera.width // 2), max(1, self.camera.height // 2))
        grey = cv2.resize(self.grey, size, interpolation=cv2.INTER_AREA)
        masked = cv2.resize((~self.counts).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return Picture(self.camera.scaled(*size), np.asarray(grey, np.float32), np.asarray(masked == 0.0))


class Likeness:
    """Correlation of a photo's windows with what its neighbours show there."""

    def __init__(self, photo: Picture) -> None:
        self.camera = photo.camera
        self._grey = photo.grey
        self._mean = _mean(photo.grey)
        variance = _mean(np.square(photo.grey)) - np.square(self._mean)
        at_hand = _mean(np.square(photo.grey), AT_HAND) - np.square(_mean(photo.grey, AT_HAND))
        self.textured = (variance > TEXTURE**2) & (at_hand > NOISE**2) & _whole(photo.counts)
        self._deviation = np.sqrt(np.maximum(variance, 0.0) + np.float32(NOISE**2))

    def by_plane(self, other: Picture, inverse_depth: float) -> Float32[np.ndarray, "h w"] | None:
        """Correlation by a plane parallel to the photo, 0 where the neighbour does not see it; None if everywhere.

        Args:
            other: The neighbour.
            inverse_depth: Of the plane, 1 / world units.
        """
        turn, shift = relative(self.camera, other.camera)
        matrix = turn + np.outer(shift, [0.0, 0.0, inverse_depth])
        if (matrix[2] @ corners(self.camera) <= 0.0).any():
            return None  # the neighbour stands in the plane or behind it
        to_centres = np.array([[1.0, 0.0, CENTRE_PX], [0.0, 1.0, CENTRE_PX], [0.0, 0.0, 1.0]])
        matrix = np.linalg.inv(to_centres) @ matrix @ to_centres
        size = (self.camera.width, self.camera.height)
        inside = cv2.warpPerspective(
            other.counts.astype(np.uint8), matrix, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        )
        if not inside.any():
            return None
        there = cv2.warpPerspective(other.grey, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        return self._correlation(np.asarray(there, np.float32), np.asarray(inside > 0))

    def by_surface(
        self, other: Picture, inverse_depth: Float32[np.ndarray, "h w"], rays: Float32[np.ndarray, "3 h w"]
    ) -> Float32[np.ndarray, "h w"]:
        """Correlation by a surface that has its own depth at each pixel.

        Args:
            other: The neighbour.
            inverse_depth: Of the surface, 1 / world units.
            rays: What ``turned`` has for this neighbour.
        """
        shift = relative(self.camera, other.camera)[1].astype(np.float32)
        x, y, z = (rays[row] + shift[row] * inverse_depth for row in range(3))
        z = np.where(z > 0.0, z, np.float32(np.nan))
        x, y = (np.nan_to_num(side / z - np.float32(CENTRE_PX), nan=-9.0) for side in (x, y))
        inside = cv2.remap(other.counts.astype(np.uint8), x, y, cv2.INTER_NEAREST)
        there = cv2.remap(other.grey, x, y, cv2.INTER_LINEAR)
        return self._correlation(np.asarray(there, np.float32), np.asarray(inside > 0))

    def turned(self, other: Picture) -> Float32[np.ndarray, "3 h w"]:
        """The photo's rays as the neighbour's homogeneous pixels, the part that does not depend on depth."""
        x, y = np.meshgrid(np.arange(self.camera.width) + CENTRE_PX, np.arange(self.camera.height) + CENTRE_PX)
        turn = relative(self.camera, other.camera)[0]
        return np.stack([row[0] * x + row[1] * y + row[2] for row in turn]).astype(np.float32)

    def _correlation(
        self, there: Float32[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]
    ) -> Float32[np.ndarray, "h w"]:
        mean = _mean(there)
        variance = np.maximum(_mean(np.square(there)) - np.square(mean), 0.0) + np.float32(NOISE**2)
        together = _mean(self._grey * there) - self._mean * mean
        together /= self._deviation * np.sqrt(variance)
        together[~_whole(inside)] = 0.0
        return np.asarray(together)


def relative(camera: Camera, other: Camera) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """From a camera's pixels p to another's: at depth z they are turn @ p + shift / z, homogeneous.

    A point at depth z is z K⁻¹ p, for the other camera z (R K⁻¹ p + t / z).
    """
    other_from_camera = other.cam_from_world @ np.linalg.inv(camera.cam_from_world)
    turn = other.k() @ other_from_camera[:3, :3] @ np.linalg.inv(camera.k())
    return np.asarray(turn), np.asarray(other.k() @ other_from_camera[:3, 3])


def corners(camera: Camera) -> Float64[np.ndarray, "3 4"]:
    """The picture's corners, homogeneous pixels."""
    w, h = camera.width, camera.height
    return np.array([[0.0, w, 0.0, w], [0.0, 0.0, h, h], [1.0, 1.0, 1.0, 1.0]])


def _mean(values: Float32[np.ndarray, "h w"], window: int = WINDOW) -> Float32[np.ndarray, "h w"]:
    return np.asarray(cv2.blur(values, (window, window)))


def _whole(counts: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where the whole window counts; beyond the border nothing does."""
    kernel = np.ones((WINDOW, WINDOW), np.uint8)
    kept = cv2.erode(counts.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(kept > 0)
