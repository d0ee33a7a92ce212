"""Lengths in a run's CRS as metres on the ground.

A map's grid stretches lengths: by 0.04 % in the middle of a UTM zone, which are 0.08 % of a volume; Web Mercator's by
half in Europe. What is built and paid for is on the ground.
"""

from __future__ import annotations

from splatpipe.pipeline.surface.map_crs import MapCrs


def ground_metres(crs: MapCrs) -> float:
    """Metres on the ground in a unit of the CRS's plan, at the run's origin."""
    scale = None if crs.world is None else crs.world.grid_scale()
    return crs.unit_m if scale is None else crs.unit_m / scale.ground
