"""Textured faces: tools to build a scene out of planar polygons, boxes and displaced spheres."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatpipe.demo.site.textures import Image, Painter, TextureTile

Array = NDArray[np.float64]
Numbers = Sequence[Any] | NDArray[Any] | float | int  # what np.asarray takes; ArrayLike is more than beartype can check
MARGIN = 3  # texels painted beyond a face, so that bilinear lookups at its border never hit a neighbour in the atlas
FAR_TEXEL_M = 0.05  # lumps with texels of this size are far away and get no fine leaves
ATLAS_WIDTH = 4096
ATLAS_HEIGHT = 8192


@dataclass(frozen=True)
class Face:
    """Triangles that share one texture tile.

    Attributes:
        vertices: (n, 3), metres.
        triangles: (m, 3), counter-clockwise seen from outside.
        uv_m: (n, 2), metres from the tile's lower left corner.
        paint: Its painter.
        texel_m: Texel size.
        gloss: Whether it is glazed or lacquered.
        given_normals: (n, 3), unit; for smooth shading across its border.
    """

    vertices: Array
    triangles: NDArray[np.int64]
    uv_m: Array
    paint: Painter
    texel_m: float
    gloss: bool = False
    given_normals: Array | None = None

    def normals(self) -> Array:
        """Unit normals at the vertices, (n, 3): as given, or the area-weighted mean of the triangles' normals."""
        if self.given_normals is not None:
            return self.given_normals
        corners = self.vertices[self.triangles]
        weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        total = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(total, self.triangles[:, k], weighted)
        return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))


@dataclass(frozen=True)
class Plane:
    """A rectangular coordinate system: ``point(a, b, c) = origin + a u + b v + c n``."""

    origin: Array
    u: Array
    v: Array

    @classmethod
    def make(cls, origin: Numbers, u: Numbers, v: Numbers) -> Plane:
        axes = [np.asarray(a, float) for a in (u, v)]
        return cls(np.asarray(origin, float), *(a / np.linalg.norm(a) for a in axes))

    @property
    def n(self) -> Array:
        return np.cross(self.u, self.v)

    def point(self, a: Numbers, b: Numbers, c: Numbers = 0.0) -> Array:
        """Points of shape (..., 3)."""
        a, b, c = (np.asarray(x, float)[..., None] for x in (a, b, c))
        return np.asarray(self.origin + a * self.u + b * self.v + c * self.n)

    def at(self, a: float | int, b: float | int, c: float | int = 0.0) -> Plane:
        """A plane with the same axes and another origin."""
        return Plane(self.point(a, b, c), self.u, self.v)


WORLD = Plane.make((0, 0, 0), (1, 0, 0), (0, 1, 0))


@dataclass
class Builder:
    """Collects faces in plot coordinates."""

    texel_m: float = 0.0125
    faces: list[Face] = field(default_factory=list)

    def polygon(
        self, plane: Plane, outline: Numbers, paint: Painter, gloss: bool = False, texel_m: float = 0.0
    ) -> None:
        """Add a polygon, star-shaped about its mean; ``outline`` (n, 2) counter-clockwise in the plane."""
        corners = np.asarray(outline, float)
        low = corners.min(axis=0)
        points = np.vstack([corners, corners.mean(axis=0)]) if len(corners) > 4 else corners
        n = len(corners)
        if n > 4:
            triangles = np.array([(i, (i + 1) % n, n) for i in range(n)])
        else:
            triangles = np.array([(0, i, i + 1) for i in range(1, n - 1)])
        self.add(Face(plane.point(*points.T), triangles, points - low, paint, texel_m or self.texel_m, gloss))

    def rect(
        self,
        plane: Plane,
        low: Sequence[float | int],
        high: Sequence[float | int],
        paint: Painter,
        gloss: bool = False,
        texel_m: float = 0.0,
    ) -> None:
        """Add the rectangle between two corners."""
        (a, b), (c, d) = low, high
        self.polygon(plane, [(a, b), (c, b), (c, d), (a, d)], paint, gloss, texel_m)

    def box(
        self,
        plane: Plane,
        low: Sequence[float | int],
        high: Sequence[float | int],
        paint: Painter,
        gloss: bool = False,
        top: Painter | None = None,
    ) -> None:
        """Add a box between two corners in plane coordinates; ``top``, if given, paints the face of greatest c."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        u, v, n = plane.u, plane.v, plane.n
        self.rect(plane.at(0, 0, z1), (x0, y0), (x1, y1), top or paint, gloss)
        self.rect(Plane(plane.point(0, 0, z0), v, u), (y0, x0), (y1, x1), paint, gloss)
        self.rect(Plane(plane.point(0, y0, 0), u, n), (x0, z0), (x1, z1), paint, gloss)
        self.rect(Plane(plane.point(0, y1, 0), -u, n), (-x1, z0), (-x0, z1), paint, gloss)
        self.rect(Plane(plane.point(x1, 0, 0), v, n), (y0, z0), (y1, z1), paint, gloss)
        self.rect(Plane(plane.point(x0, 0, 0), -v, n), (-y1, z0), (-y0, z1), paint, gloss)

    def prism(
        self, plane: Plane, outline: Numbers, depth: float, sides: Painter, caps: Painter, gloss: bool = False
    ) -> None:
        """Add a polygon extruded by ``depth`` along the plane's normal."""
        corners = np.asarray(outline, float)
        self.polygon(plane.at(0, 0, depth), corners, caps, gloss)
        self.polygon(Plane(plane.origin, -plane.u, plane.v), (corners * (-1, 1))[::-1], caps, gloss)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            side = Plane.make(plane.point(*start), plane.point(*end) - plane.point(*start), plane.n)
            self.rect(side, (0, 0), (float(np.linalg.norm(end - start)), depth), sides, gloss)

    def wall(self, plane: Plane, outline: Numbers, holes: Iterable[Sequence[float]], paint: Painter) -> None:
        """Add a convex polygon with rectangular holes (u0, v0, u1, v1); its sides may slope only above the holes."""
        corners = np.asarray(outline, float)
        holes = list(holes)
        low, high = corners.min(axis=0), corners.max(axis=0)
        shoulder = min((v for _, v in corners if v > low[1] + 1e-9), default=high[1])
        cuts_u = np.unique([low[0], high[0], *(h[i] for h in holes for i in (0, 2))])
        cuts_v = np.unique([low[1], shoulder, *(h[i] for h in holes for i in (1, 3))])
        grid = np.array([(a, b) for b in cuts_v for a in cuts_u])
        columns = len(cuts_u)
        triangles = []
        for j in range(len(cuts_v) - 1):
            for i in range(columns - 1):
                centre = (cuts_u[i] + cuts_u[i + 1]) / 2, (cuts_v[j] + cuts_v[j + 1]) / 2
                if not any(h[0] < centre[0] < h[2] and h[1] < centre[1] < h[3] for h in holes):
                    first = j * columns + i
                    triangles += [
                        (first, first + 1, first + columns + 1),
                        (first, first + columns + 1, first + columns),
                    ]
        gable = corners[corners[:, 1] > shoulder - 1e-9]
        offset = len(grid)
        triangles += [(offset, offset + i, offset + i + 1) for i in range(1, len(gable) - 1)]
        points = np.vstack([grid, gable])
        self.add(Face(plane.point(*points.T), np.array(triangles), points - low, paint, self.texel_m))

    def add(self, face: Face) -> None:
        self.faces.append(face)


def lattice_noise(xyz: Array, wavelength_m: float, seed: int) -> Image:
    """Smooth random field in space, of about unit variance, for points of shape (..., 3)."""
    scaled = xyz / wavelength_m + 100.0
    cell = np.floor(scaled).astype(np.int64).astype(np.uint32)
    t = scaled - np.floor(scaled)
    t = t * t * (3 - 2 * t)
    total = np.zeros(xyz.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner) == 1, t, 1 - t), axis=-1)
        total += weight * _hash(cell + np.array(corner, np.uint32), seed)
    return np.asarray(total * 2.6, np.float32)


def _hash(cell: NDArray[np.uint32], seed: int) -> Array:
    """Hash lattice points (..., 3) to numbers in [-1, 1]: the finaliser of MurmurHash3 over mixed coordinates."""
    x = (
        cell[..., 0] * np.uint32(0x9E3779B1)
        ^ cell[..., 1] * np.uint32(0x85EBCA77)
        ^ cell[..., 2] * np.uint32(0xC2B2AE3D)
    )
    x = x + np.uint32(seed * 0x27D4EB2F & 0xFFFFFFFF)
    x = (x ^ (x >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    x = (x ^ (x >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    x = x ^ (x >> np.uint32(16))
    return np.asarray(x / 2.0**31 - 1.0)


@dataclass(frozen=True)
class Superellipsoid:
    """A rounded solid: trees, hedges, bushes.

    Attributes:
        centre, radii: (3,), metres.
        seed: Of its shape and leaves.
        cells: Grid cells along the edge of each of its six sides.
        squareness: Exponent of the superellipsoid: 2 is an ellipsoid, more is boxier.
        palette: Dark to light.
    """

    centre: Array
    radii: Array
    seed: int
    cells: int = 8
    squareness: float = 2.0
    palette: tuple[Image, ...] = ()
    texel_m: float = 0.03

    def surface(self, side: int, a: Array, b: Array) -> Array:
        """Points of one side of a cube, (a, b) in [-1, 1], pushed out to the lumpy surface; shape (..., 3)."""
        tangent = np.tan(np.pi / 4 * np.stack([a, b], -1))
        axis, sign = side // 2, 1.0 if side % 2 == 0 else -1.0
        direction = np.empty((*a.shape, 3))
        direction[..., axis] = sign
        direction[..., (axis + 1) % 3] = tangent[..., 0] * sign
        direction[..., (axis + 2) % 3] = tangent[..., 1]
        direction /= (np.abs(direction) ** self.squareness).sum(-1, keepdims=True) ** (1 / self.squareness)
        base = direction * self.radii
        size = float(self.radii.min())
        bulge = 0.10 * lattice_noise(base, 0.9 * size, self.seed) + 0.055 * lattice_noise(
            base, 0.45 * size, self.seed + 1
        )
        return np.asarray(self.centre + base * (1 + bulge)[..., None])

    def faces(self) -> Iterable[Face]:
        """The six sides."""
        n = self.cells
        span = np.linspace(-1, 1, n + 1)
        b, a = np.meshgrid(span, span, indexing="ij")
        first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
        triangles = np.vstack([np.c_[first, first + 1, first + n + 2], np.c_[first, first + n + 2, first + n + 1]])
        edge = 1.6 * float(np.median(self.radii))
        uv = np.c_[(a.ravel() + 1) / 2, (b.ravel() + 1) / 2] * edge
        for side in range(6):
            step = 1e-3
            along_a = self.surface(side, a + step, b) - self.surface(side, a - step, b)
            along_b = self.surface(side, a, b + step) - self.surface(side, a, b - step)
            normals = np.cross(along_a, along_b).reshape(-1, 3)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            vertices = self.surface(side, a, b).reshape(-1, 3)
            yield Face(vertices, triangles, uv, self._painter(side, edge), self.texel_m, given_normals=normals)

    def _painter(self, side: int, edge: float) -> Painter:
        def paint(tile: TextureTile) -> Image:
            b, a = np.meshgrid(tile.v / edge * 2 - 1, tile.u / edge * 2 - 1, indexing="ij")
            xyz = self.surface(side, a, b)
            tone = sum(
                gain * lattice_noise(xyz, wave, self.seed + 10 + k)
                for k, (wave, gain) in enumerate(
                    [(1.3, 0.5), (0.6, 0.55), (0.3, 0.5), (0.15, 0.3)][: 4 if self.texel_m < FAR_TEXEL_M else 2]
                )
            )
            level = np.clip((np.asarray(tone) * 0.30 + 0.5) * (len(self.palette) - 1), 0, len(self.palette) - 1.001)
            below = level.astype(np.int64)
            colours = np.stack(self.palette)
            return np.asarray(
                colours[below] + (colours[below + 1] - colours[below]) * (level - below)[..., None], np.float32
            )

        return paint


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh to render, with one texture.

    Attributes:
        vertices: (n, 3) float32, metres.
        normals: (n, 3) float32, unit; shared by the triangles of a face, for smooth shading of lumps and hills.
        triangles: (m, 3) uint32.
        uv: (n, 2) float32; v grows with the texture's row.
        texture: (h, w, 3) uint8, sRGB.
        gloss: Whether it is glazed or lacquered.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    uv: NDArray[np.float32]
    texture: NDArray[np.uint8]
    gloss: bool


def paint_faces(faces: Sequence[Face], seed: int) -> list[TexturedMesh]:
    """Paint every face into atlases and join the faces of each atlas; matt and glossy faces are kept apart.

    Args:
        faces: In scene order, which decides each face's random numbers.
        seed: Seed of the whole scene.
    """
    meshes = []
    for gloss in (False, True):
        numbered = [(i, f) for i, f in enumerate(faces) if f.gloss == gloss]
        sizes = [tuple(np.ceil(f.uv_m.max(axis=0) / f.texel_m).astype(int) + 2 * MARGIN) for _, f in numbered]
        order = sorted(range(len(numbered)), key=lambda k: (-sizes[k][1], k))
        page: list[tuple[int, Face, int, int]] = []
        x = y = shelf = 0
        for k in order:
            width, height = sizes[k]
            if x + width > ATLAS_WIDTH:
                x, y, shelf = 0, y + shelf, 0
            if y + height > ATLAS_HEIGHT:
                meshes.append(_join(page, seed, gloss))
                page, x, y, shelf = [], 0, 0, 0
            page.append((*numbered[k], x, y))
            x, shelf = x + width, max(shelf, height)
        if page:
            meshes.append(_join(page, seed, gloss))
    return meshes


def _join(page: Sequence[tuple[int, Face, int, int]], seed: int, gloss: bool) -> TexturedMesh:
    images = [_paint(face, np.random.default_rng((seed, number))) for number, face, _, _ in page]
    height = max(y + image.shape[0] for (*_, y), image in zip(page, images, strict=True))
    width = max(x + image.shape[1] for (*_, x, _), image in zip(page, images, strict=True))
    atlas = np.zeros((height, width, 3), np.uint8)
    vertices, normals, triangles, uvs, count = [], [], [], [], 0
    for (_, face, x, y), image in zip(page, images, strict=True):
        atlas[y : y + image.shape[0], x : x + image.shape[1]] = image
        uvs.append((face.uv_m / face.texel_m + MARGIN + (x, y)) / (width, height))
        vertices.append(face.vertices)
        normals.append(face.normals())
        triangles.append(face.triangles + count)
        count += len(face.vertices)
    return TexturedMesh(
        np.vstack(vertices).astype(np.float32),
        np.vstack(normals).astype(np.float32),
        np.vstack(triangles).astype(np.uint32),
        np.vstack(uvs).astype(np.float32),
        atlas,
        gloss,
    )


def _paint(face: Face, rng: np.random.Generator) -> NDArray[np.uint8]:
    width, height = np.ceil(face.uv_m.max(axis=0) / face.texel_m).astype(int) + 2 * MARGIN
    u, v = ((np.arange(n) - MARGIN + 0.5) * face.texel_m for n in (width, height))
    image = face.paint(TextureTile(u.astype(np.float32), v.astype(np.float32), face.texel_m, rng))
    return np.asarray(np.clip(image, 0.02, 0.95) * 255 + 0.5, np.uint8)
