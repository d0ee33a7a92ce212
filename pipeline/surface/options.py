"""Options of the stages that make the surface products. Light to import."""

from __future__ import annotations

from typing import Literal

from splatpipe.pipeline.engine.ranges import NonNegativeFloat, PositiveFloat, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig


class DsmConfig(StageConfig):
    enabled: bool = True
    """Make the surface model (DSM): dsm.tif and its confidence."""
    cell_m: NonNegativeFloat = 0.0
    """Cell size on the ground, metres; 0: two pixels of the photos, or one of the depth maps if that is larger."""


class DtmConfig(StageConfig):
    enabled: bool = True
    """Make the terrain model (DTM), without buildings and trees: dtm.tif, its confidence, heights over the ground
    (chm.tif), contours; requires the surface model."""
    contours: Literal["dtm", "dsm"] = "dtm"
    """Draw contours of the ground (`dtm`), or of the topmost surface (`dsm`)."""


class OrthoConfig(StageConfig):
    enabled: bool = True
    """Make the true orthophoto, ortho.tif; requires the surface model."""
    gsd_m: NonNegativeFloat = 0.0
    """Pixel size on the ground, metres; 0: the GSD of the photos."""


class FacadesConfig(StageConfig):
    enabled: bool = False
    """Draw wall elevations into facades/: images to scale, depths relative to the plane of the wall, DXF, SVG."""
    gsd_m: NonNegativeFloat = 0.0
    """Pixel size on the wall, metres; 0: the GSD of the photos."""
    lines: str = ""
    """Walls to draw, each as `x1,y1,x2,y2`: the left and right ends seen from in front of it, in the run's CRS;
    separated by semicolons. Empty: all walls that are detected."""


class CloudConfig(StageConfig):
    enabled: bool = False
    """Make the dense point cloud, cloud.laz."""
    spacing_m: NonNegativeFloat = 0.0
    """Minimum spacing of its points, metres; 0: the GSD of the photos."""


class MeshConfig(StageConfig):
    enabled: bool = False
    """Make the mesh with the photos on it: mesh/mesh.glb, .obj and .ply. Requires open3d: pip install
    "splatpipe[mesh]"."""
    triangles: PositiveInt = 1_000_000
    """Maximum number of triangles."""
    texture_megapixels: PositiveFloat = 256.0
    """Maximum size of all its textures; beyond it, they are coarser than the photos."""
