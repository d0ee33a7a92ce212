"""Options of the stages that make what is handed over besides the splat. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.ranges import NonNegativeFloat
from splatpipe.pipeline.engine.stage import StageConfig


class DsmConfig(StageConfig):
    enabled: bool = True
    """Make the surface model: dsm.tif, its confidence, contours."""
    cell_m: NonNegativeFloat = 0.0
    """Side of its cells on the ground, metres; 0: two pixels of the photos, or one of their depths where that is
    larger."""


class OrthoConfig(StageConfig):
    enabled: bool = True
    """Make the orthophoto, ortho.tif; it needs the surface model."""
    gsd_m: NonNegativeFloat = 0.0
    """Side of its pixels on the ground, metres; 0: as the photos."""
