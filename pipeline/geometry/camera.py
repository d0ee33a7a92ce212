"""Pinhole cameras, and the frames that the whole project uses.

Frames, stated once:

- Camera: as in OpenCV and COLMAP, x right, y down, z forward.
- Pixels: the centre of the first pixel is (0.5, 0.5), COLMAP's convention; OpenCV keypoints need half a pixel added.
- Rotations: quaternions are (w, x, y, z), Hamilton convention.
- Poses: ``cam_from_world``; names read right to left, ``x_cam = cam_from_world @ x_world``.
- World: before georeferencing, the normalised frame of the sparse model; afterwards local east, north, up in metres
  about an origin kept in float64.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.equality import equal_fields


@dataclass(frozen=True)
class Window:
    """Position of a crop within the full image that it was cut from.

    Attributes:
        left: Column of the full image where the crop starts, pixels.
        top: Row of the full image where the crop starts, pixels.
        whole_width: Width of the full image, pixels.
        whole_height: Height of the full image, pixels.
    """

    left: int
    top: int
    whole_width: int
    whole_height: int


@dataclass(frozen=True, eq=False)
class Camera:
    """A photo's pinhole camera and its pose.

    Attributes:
        name: The image's name in its dataset, POSIX form.
        width: Image width, pixels.
        height: Image height, pixels.
        fx: Focal length along x, pixels.
        fy: Focal length along y, pixels.
        cx: Principal point x, pixels; the middle of the image is ``width / 2``.
        cy: Principal point y, pixels.
        cam_from_world: Rigid transform, world units.
        window: Where this crop lies in its full image; None for a full image.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    cam_from_world: Float64[np.ndarray, "4 4"]
    window: Window | None = None

    def __eq__(self, other: object) -> bool:
        return equal_fields(self, other)

    __hash__ = None  # type: ignore[assignment]  # equal by their values, which include an array

    def centre(self) -> Float64[np.ndarray, " 3"]:
        """The projection centre in the world."""
        return np.asarray(-self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3])

    def k(self) -> Float64[np.ndarray, "3 3"]:
        """The intrinsic matrix, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, width: int, height: int) -> Camera:
        """The same view resampled to another size.

        Args:
            width: New width, pixels.
            height: New height, pixels.

        Raises:
            ValueError: for a crop, whose pixels would not coincide with those of the full image.
        """
        if self.window is not None:
            raise ValueError(f"{self.name}: a crop cannot be resampled: scale the full image, then crop it")
        by_x, by_y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * by_x,
            fy=self.fy * by_y,
            cx=self.cx * by_x,
            cy=self.cy * by_y,
        )

    def crop(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of a crop of the image, pixel for pixel the same view.

        Args:
            left: First column of the crop, in this image's pixels.
            top: First row.
            width: Number of columns, at least 1.
            height: Number of rows, at least 1.

        Returns:
            The crop's camera, with its window in the full image; this camera itself if the crop is all of it.

        Raises:
            ValueError: if the crop is not inside this image.
        """
        if min(left, top) < 0 or min(width, height) < 1 or left + width > self.width or top + height > self.height:
            raise ValueError(f"{width}×{height} from ({left}, {top}) is not inside {self.width}×{self.height} pixels")
        if (width, height) == (self.width, self.height):
            return self
        window = self.window or Window(0, 0, self.width, self.height)
        return replace(
            self,
            width=width,
            height=height,
            cx=self.cx - left,
            cy=self.cy - top,
            window=replace(window, left=window.left + left, top=window.top + top),
        )

    def uncropped(self) -> Camera:
        """The camera of the full image; this camera itself if it is not a crop."""
        window = self.window
        if window is None:
            return self
        return replace(
            self,
            width=window.whole_width,
            height=window.whole_height,
            cx=self.cx + window.left,
            cy=self.cy + window.top,
            window=None,
        )

    def depths(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Depths of world points along the optical axis, world units; negative behind the camera."""
        return np.asarray(points @ self.cam_from_world[2, :3] + self.cam_from_world[2, 3])

    def project(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Project world points to pixels.

        Args:
            points: World points; those at or behind the camera's plane have no meaningful projection.
        """
        in_camera = points @ self.cam_from_world[:3, :3].T
        in_camera += self.cam_from_world[:3, 3]
        pixels = np.empty((len(points), 2))
        for axis, (focal, centre) in enumerate(((self.fx, self.cx), (self.fy, self.cy))):
            column = pixels[:, axis]  # by columns: numpy takes three times as long for rows of two
            np.divide(in_camera[:, axis], in_camera[:, 2], out=column)
            column *= focal
            column += centre
        return pixels

    def pixels_of(self, rays: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Pixels of rays given as x / z and y / z in the camera frame."""
        return np.asarray(rays * [self.fx, self.fy] + [self.cx, self.cy])

    def in_view(
        self, points: Float64[np.ndarray, "n 3"]
    ) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 2"], Float64[np.ndarray, " k"]]:
        """World points in front of the camera and inside its image: their indices, pixels and depths (world units)."""
        depths = self.depths(points)
        rows = np.flatnonzero((depths > 0.0) & np.isfinite(depths))
        pixels = self.project(points[rows])
        x, y = pixels.T
        inside = (x >= 0.0) & (x < self.width) & (y >= 0.0) & (y < self.height)
        return rows[inside], pixels[inside], depths[rows[inside]]

    def unproject(
        self, pixels: Float64[np.ndarray, "n 2"], depths: Float64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n 3"]:
        """World points of pixels at depths along the optical axis (world units): the inverse of ``project``."""
        x, y = (pixels - [self.cx, self.cy]).T / np.array([[self.fx], [self.fy]])
        rays = np.stack([x, y, np.ones(len(pixels))], axis=1)
        return np.asarray((rays * depths[:, None] - self.cam_from_world[:3, 3]) @ self.cam_from_world[:3, :3])


def reduced_size(width: int, height: int, max_megapixels: float) -> tuple[int, int]:
    """The largest size with an image's aspect ratio within a limit; its own size if that is within the limit.

    Args:
        width: Pixels.
        height: Pixels.
        max_megapixels: Limit for the result, in 10⁶ pixels.

    Returns:
        Width and height, each rounded down so that the result is within the limit, and at least 1.
    """
    scale = min(1.0, math.sqrt(max_megapixels * 1e6 / (width * height)))
    if scale == 1.0:
        return width, height
    return max(1, int(width * scale)), max(1, int(height * scale))
