"""An orthographic view of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatpipe.demo.site.mesh import Array


@dataclass(frozen=True, eq=False)
class ParallelView:
    """An orthographic view: an image by parallel rays.

    Attributes:
        name: Name of its files.
        origin: Of the first pixel's first corner, from where rays start; east, north, up in metres.
        right: Unit vector along the rows.
        down: Unit vector along the columns.
        pixel_m: A pixel's side.
        width: Pixels.
        height: Pixels.
    """

    name: str
    origin: Array
    right: Array
    down: Array
    pixel_m: float
    width: int
    height: int

    @property
    def ahead(self) -> Array:
        """Direction of the rays, a unit vector."""
        return np.asarray(np.cross(self.right, self.down))

    def to_grid(self, points: Array) -> Array:
        """World points (..., 3) to column, row (pixels; the first pixel's centre is (0.5, 0.5)) and metres ahead."""
        axes = np.stack([self.right / self.pixel_m, self.down / self.pixel_m, self.ahead])
        return np.asarray((points - self.origin) @ axes.T)

    def from_grid(self, places: Array) -> Array:
        """Column, row and metres ahead (..., 3) to world points."""
        axes = np.stack([self.right * self.pixel_m, self.down * self.pixel_m, self.ahead])
        return np.asarray(places @ axes + self.origin)

    def resampled(self, pixel_m: float) -> ParallelView:
        """This view with another pixel size."""
        width, height = (round(count * self.pixel_m / pixel_m) for count in (self.width, self.height))
        return replace(self, pixel_m=pixel_m, width=width, height=height)
