"""Radiometric gains by which photos' light is multiplied so that they agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource, sample_colours, tone_curve
from splatpipe.pipeline.surface.depths.point_visibility import Points, project_points

SHADING_TERMS = 5  # terms of a photo's shading
GAMMA = 2.4  # exponent of sRGB above its darkest values: (value + offset) ** gamma is proportional to light
OFFSET = 0.055 * 255.0


@dataclass(frozen=True, eq=False)
class PhotoGains:
    """Gains of all photos.

    Attributes:
        gain: Gain of each photo's light per channel.
        shading: Coefficients of ``shading_terms`` per photo; the weighted sum is the logarithm of the gain across the
            photo. Per channel, because leaves are shaded differently from sand.
    """

    gain: Float64[np.ndarray, "n 3"]
    shading: Float64[np.ndarray, "n k 3"]

    @staticmethod
    def plain(photos: int) -> PhotoGains:
        """Gains that leave photos unchanged."""
        return PhotoGains(np.ones((photos, 3)), np.zeros((photos, SHADING_TERMS, 3)))

    def of(self, numbers: list[int]) -> PhotoGains:
        """Gains of some photos."""
        return PhotoGains(self.gain[numbers], self.shading[numbers])

    def sample(
        self,
        number: int,
        photo: tuple[PhotoSource, UInt8[np.ndarray, "h w 3"]],
        points: Points,
        seen: Bool[np.ndarray, " *n"],
        cell_m: float,
    ) -> UInt8[np.ndarray, " *n 3"]:
        """Levelled colours of points in a photo, sampled by ``photo_samples.sample_colours``.

        Args:
            number: Index of the photo.
            photo: The photo with its pixels.
            points: East, north, up.
            seen: Whether it sees them.
            cell_m: Size of the points' cells, metres.

        Raises:
            ValueError: if the pixels do not have the photo's size.
        """
        source, pixels = photo
        colour = sample_colours(source, pixels, points, seen, cell_m, tone_curve(self.gain[number]))
        if not self.shading[number].any():
            return colour
        east, north, up = (axis[seen] for axis in points)
        place = project_points(source.camera, east, north, up)
        terms = shading_terms(source.camera, place.column, place.row).astype(np.float32)
        factors = (self.shading[number] / GAMMA).astype(np.float32)
        for channel in range(3):
            shade = terms[0] * factors[0, channel]
            for term, factor in zip(
                terms[1:], factors[1:, channel], strict=True
            ):  # no matrix product: its bits would vary
                shade += term * factor
            value = (colour[seen, channel] + np.float32(OFFSET)) * np.exp(shade) - np.float32(OFFSET)
            colour[seen, channel] = np.clip(np.round(value), 0, 255).astype(np.uint8)
        return colour


def shading_terms(
    camera: Camera, column: Float64[np.ndarray, " n"], row: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "k n"]:
    """Terms of smooth shading across a photo: quadratic, with mean zero."""
    x = np.clip(2.0 * column / camera.width - 1.0, -1.0, 1.0)
    y = np.clip(2.0 * row / camera.height - 1.0, -1.0, 1.0)
    return np.stack([x, y, x * x - 1.0 / 3.0, x * y, y * y - 1.0 / 3.0])
