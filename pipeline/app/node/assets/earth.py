"""A run's local metres in the CRS of its maps, which all of `all.zip` is in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.surface.rasters.map_crs import MapCrs, open_map
from splatpipe.pipeline.survey.crs.frames import Frame

STEP_M = 10.0  # of the differences that the directions of the grid's axes are taken from


@dataclass(frozen=True, eq=False)
class Earth:
    """Where a run lies.

    Attributes:
        frame: The frame of `georef`.
        crs: The CRS of its maps.
    """

    frame: Frame
    crs: MapCrs

    @property
    def is_georeferenced(self) -> bool:
        """Whether it has a place on the earth."""
        return self.frame.origin is not None

    @property
    def crs_name(self) -> str:
        """The CRS, by its EPSG code if it has one."""
        code = self.crs.horizontal.to_epsg()
        return self.crs.horizontal.name if code is None else f"EPSG:{code}"

    def lon_lat_alt(self, local: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """East, north, up (metres) to longitude, latitude (degrees, WGS 84) and height (metres, as in the maps).

        Raises:
            ValueError: if the run has no place on the earth.
        """
        if self.frame.origin is None:
            raise ValueError("an arbitrary frame lies nowhere")
        geodetic = self.frame.origin.geodetic_from_enu(local)
        heights = self.crs.crs_from_local(local)[:, 2] * self.crs.height_unit_m
        return np.stack([geodetic[:, 1], geodetic[:, 0], heights], axis=1)

    def grid_axes(self, place: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
        """The rotation from the CRS's axes to the local ones at a place: it turns grid north away from true north.

        Args:
            place: East, north, up, metres.
        """
        steps = place + STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
        there = self.crs.crs_from_local(steps)
        crs_from_local = (there[:3] - there[3:]).T / (2.0 * STEP_M)
        left, _, right = np.linalg.svd(crs_from_local * np.array([[self.crs.unit_m]] * 2 + [[self.crs.height_unit_m]]))
        return np.asarray((left @ right).T)


def open_earth(frame: Frame) -> Earth | None:
    """Where a run with this frame lies; None if it has no scale, so that no CRS can be used.

    Raises:
        SplatpipeError: if its CRS cannot be used.
    """
    return Earth(frame, open_map(frame)) if frame.in_metres else None
