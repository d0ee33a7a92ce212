"""Options of the stages that make what is handed over besides the splat. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.ranges import NonNegativeFloat, PositiveInt
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


class FacadesConfig(StageConfig):
    enabled: bool = False
    """Draw elevations of walls into facades/: pictures to scale, depths about the wall's plane, DXF, SVG."""
    gsd_m: NonNegativeFloat = 0.0
    """Side of their pixels on the wall, metres; 0: as the photos."""
    lines: str = ""
    """Walls to draw, each `x1,y1,x2,y2`: its left and its right end as seen from before it, in the run's CRS; separated
    by semicolons. Empty: all walls that are found."""


class CloudConfig(StageConfig):
    enabled: bool = False
    """Make the dense cloud, cloud.laz."""
    spacing_m: NonNegativeFloat = 0.0
    """Its points are no closer, metres; 0: a pixel of the photos."""


class MeshConfig(StageConfig):
    enabled: bool = False
    """Make the mesh: mesh/mesh.glb and mesh/mesh.ply. It takes open3d: pip install "splatpipe[mesh]"."""
    triangles: PositiveInt = 1_000_000
    """At most so many."""
