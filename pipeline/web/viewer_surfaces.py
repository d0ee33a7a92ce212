"""The mesh and the points that the viewer shows instead of the splat, reduced to a size that a page can carry."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.surface.levels.charted_mesh import ChartedMesh
from splatpipe.pipeline.surface.levels.mesh_quadtree import pixels_per_metre
from splatpipe.pipeline.surface.levels.mesh_simplification import simplified
from splatpipe.pipeline.surface.levels.mesh_texture import TexturePages, packed_texture
from splatpipe.pipeline.surface.levels.mesh_tiles import charted
from splatpipe.pipeline.surface.levels.thinned_cloud import thinned_cloud
from splatpipe.pipeline.surface.rasters.map_crs import open_map
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh
from splatpipe.pipeline.survey.crs.frames import Frame

# Together some 10 MB of page: points 9 bytes each, a mesh 20 bytes a triangle and its JPEG, a third more in base64.
MOST_POINTS = 250_000
MOST_TRIANGLES = 120_000
MOST_PIXELS = 12_000_000
STEPS = 65_535  # of coordinates across the scene's longest side: 1.5 mm at 100 m


def viewer_points(path: Path, frame: Frame) -> dict[str, Any] | None:
    """The points of a cloud for the page; None if it has none.

    Args:
        path: `cloud.laz` of the run.
        frame: The run's metric frame.

    Raises:
        SplatpipeError: if the cloud cannot be read.
    """
    cloud = thinned_cloud(path, MOST_POINTS)
    if not len(cloud.coordinates):
        return None
    crs = open_map(frame)
    places = crs.local_from_crs(cloud.coordinates)
    return {**_packed(places), "rgb": _base64(cloud.colours), "spacing": round(cloud.spacing * crs.unit_m, 6)}


def viewer_mesh(made: TexturedMesh, work: Path) -> dict[str, Any] | None:
    """The mesh for the page; None if it has no triangles.

    Args:
        made: The run's textured mesh.
        work: Folder for the decoded texture; it is emptied first and removed afterwards.

    Raises:
        SplatpipeError: if a page cannot be read.
        OSError: if the disk is full.
    """
    mesh, rects = charted(made)
    if not len(mesh):
        return None
    pixels, _ = pixels_per_metre(mesh)
    small, _ = simplified(mesh, np.zeros(len(mesh.vertices), np.bool_), MOST_TRIANGLES)
    pages = TexturePages(made.pages, work)
    try:
        texture = packed_texture(small, rects, pages, _factor(pixels))
    finally:
        pages.remove()
    first, indices = small.wedges()
    uv = np.rint(np.clip(texture.uv.reshape(-1, 2)[first], 0.0, 1.0) * STEPS)
    return {
        **_packed(_corner_places(small)[first]),
        "uv": _base64(uv.astype("<u2")),
        "indices": _base64(indices.astype("<u4")),
        "texture": f"data:image/jpeg;base64,{base64.b64encode(texture.jpeg).decode('ascii')}",
    }


def _factor(pixels: float) -> int:
    """Full pixels per pixel, a power of two, so that the budget is kept."""
    factor = 1
    while pixels / factor**2 > MOST_PIXELS:
        factor *= 2
    return factor


def _corner_places(mesh: ChartedMesh) -> Float64[np.ndarray, "k 3"]:
    return np.asarray(mesh.vertices[mesh.triangles.ravel()])


def _packed(places: Float64[np.ndarray, "n 3"]) -> dict[str, Any]:
    """Places as whole steps from a corner."""
    low = places.min(axis=0)
    step = max(float((places.max(axis=0) - low).max()) / STEPS, 1e-6)
    return {"low": low.tolist(), "step": step, "xyz": _base64(np.rint((places - low) / step).astype("<u2"))}


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
