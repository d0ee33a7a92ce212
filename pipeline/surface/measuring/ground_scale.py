"""Ground lengths from lengths in a run's CRS.

A map grid distorts lengths: by 0.04 % in the middle of a UTM zone, i.e. 0.08 % of a volume; Web Mercator by half in
Europe. What is built and paid for is on the ground.
"""

from __future__ import annotations

from splatpipe.pipeline.surface.rasters.map_crs import MapCrs


def ground_metres(crs: MapCrs) -> float:
    """Ground metres per horizontal unit of the CRS, at the run's origin."""
    scale = None if crs.world is None else crs.world.grid_scale()
    return crs.unit_m if scale is None else crs.unit_m / scale.ground
