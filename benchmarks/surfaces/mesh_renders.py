"""Draw a triangle mesh, with its photos or its vertex colours, as a camera or from straight above; with open3d's rays.

Each pixel is the mean of four rays; textures are interpolated linearly, as viewers do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from PIL import Image

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh, TriangleMesh
from splatpipe.pipeline.surface.shapes.tsdf import open3d
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh

SIDE = 2  # rays to each side of a pixel
ROWS = 256  # rows of a picture at a time
NEAR_MIN_SIDES = 32767  # what cv2.remap can address

Rays = Float32[np.ndarray, "h w 6"]
Shade = Callable[[Int64[np.ndarray, " n"], Float32[np.ndarray, "n 3"]], Float32[np.ndarray, "n 3"]]


@dataclass(frozen=True, eq=False)
class MeshView:
    """A picture of a mesh.

    Attributes:
        picture: Colours, black where there is no mesh.
        there: Pixels that the mesh fills.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    there: Bool[np.ndarray, "h w"]


class MeshScene:
    """A mesh prepared for rays.

    Args:
        mesh: The mesh, local metres.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        o3d = open3d()
        self._core = o3d.core
        self._low = mesh.vertices.min(axis=0)  # float32 is finer near zero
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        vertices = (mesh.vertices - self._low).astype(np.float32)
        self._scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))

    def camera_view(self, camera: Camera, shade: Shade) -> MeshView:
        """Draw the mesh as a camera sees it."""
        turn, centre = camera.cam_from_world[:3, :3], camera.centre() - self._low

        def rays(column: Float64[np.ndarray, "h w"], row: Float64[np.ndarray, "h w"]) -> Rays:
            x, y = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
            ways = np.stack([x, y, np.ones_like(x)], axis=-1) @ turn
            return np.concatenate([np.broadcast_to(centre, ways.shape), ways], axis=-1).astype(np.float32)

        return self._draw(camera.width, camera.height, rays, shade)

    def parallel_view(
        self,
        origins: Callable[[np.ndarray, np.ndarray], np.ndarray],
        way: np.ndarray,
        size: tuple[int, int],
        shade: Shade,
    ) -> MeshView:
        """Draw the mesh by parallel rays.

        Args:
            origins: Starts of the rays, local metres, of columns and rows.
            way: Their direction.
            size: Width and height.
            shade: Colours of places on triangles.
        """

        def rays(column: Float64[np.ndarray, "h w"], row: Float64[np.ndarray, "h w"]) -> Rays:
            starts = origins(column, row) - self._low
            return np.concatenate([starts, np.broadcast_to(way, starts.shape)], axis=-1).astype(np.float32)

        return self._draw(*size, rays, shade)

    def _draw(self, width: int, height: int, rays: Callable[[np.ndarray, np.ndarray], Rays], shade: Shade) -> MeshView:
        picture, there = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.bool_)
        for top in range(0, height, ROWS):
            rows = min(ROWS, height - top)
            row, column = np.mgrid[top * SIDE : (top + rows) * SIDE, 0 : width * SIDE]
            hit = self._scene.cast_rays(self._core.Tensor(rays((column + 0.5) / SIDE, (row + 0.5) / SIDE)))
            face = hit["primitive_ids"].numpy().astype(np.int64).ravel()
            uv = hit["primitive_uvs"].numpy().reshape(-1, 2)
            met = np.isfinite(hit["t_hit"].numpy().ravel())
            colour = np.zeros((len(face), 3), np.float32)
            weight = np.stack([1.0 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], axis=1)
            colour[met] = shade(face[met], weight[met])
            blocks = (rows, SIDE, width, SIDE)
            count = met.reshape(blocks).sum(axis=(1, 3))
            total = colour.reshape(*blocks, 3).sum(axis=(1, 3)) / np.maximum(count, 1)[..., None]
            picture[top : top + rows] = np.clip(np.round(total), 0, 255)
            there[top : top + rows] = count == SIDE * SIDE
        return MeshView(picture, there)


def vertex_shade(made: ColouredMesh) -> Shade:
    """Colours interpolated between vertices."""

    def shade(face: Int64[np.ndarray, " n"], weight: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        corners = made.colours[made.mesh.triangles[face]].astype(np.float32)
        return np.asarray(np.einsum("nk,nkc->nc", weight, corners), np.float32)

    return shade


def texture_shade(made: TexturedMesh) -> Shade:
    """Colours of the pages."""
    Image.MAX_IMAGE_PIXELS = None
    pages = [np.asarray(Image.open(page).convert("RGB")) for page in made.pages]
    page_of = made.atlas.page()

    def shade(face: Int64[np.ndarray, " n"], weight: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        place = np.einsum("nk,nkc->nc", weight, made.atlas.corners[face]) - 0.5
        found = np.zeros((len(face), 3), np.float32)
        for number, page in enumerate(pages):
            rows = np.flatnonzero(page_of[face] == number)
            for start in range(0, len(rows), NEAR_MIN_SIDES - 1):
                part = rows[start : start + NEAR_MIN_SIDES - 1]
                column, row = (np.ascontiguousarray(place[part, k], np.float32)[None] for k in (0, 1))
                found[part] = cv2.remap(page, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
        return found

    return shade
