"""The demo scene: a house and its surroundings, with survey targets on it, in local east-north-up metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatpipe.demo.site.house import EAVES, HALF_LENGTH, HALF_WIDTH, RIDGE, add_house
from splatpipe.demo.site.mesh import Array, Builder, Face, Plane, TexturedMesh, paint_faces
from splatpipe.demo.site.surroundings import add_foliage, add_surroundings
from splatpipe.demo.site.textures import Painter, target

SEED = 20261120
PLOT_YAW_DEG = 17.0  # the house is rotated against north, as most houses are


@dataclass(frozen=True)
class SurveyTarget:
    """A target whose position was surveyed.

    Attributes:
        name: GCP name.
        where: ``ground``, ``wall`` or ``roof``.
        xyz: East, north, up in metres.
        normal: Unit normal of its surface.
    """

    name: str
    where: str
    xyz: Array
    normal: Array


@dataclass(frozen=True)
class DemoScene:
    """Meshes with textures, ready to render, and the surveyed points. East, north, up in metres."""

    meshes: list[TexturedMesh]
    points: list[SurveyTarget]


def _target_planes() -> list[tuple[str, Plane, float]]:
    """Each target's kind, plane with its origin at the target's centre, and size, in plot coordinates."""
    flat = [
        (-9.0, -14.2),
        (1.3, -13.6),
        (12.9, -14.2),
        (13.6, 3.6),
        (9.9, 9.2),
        (-2.0, 12.2),
        (-14.2, 13.6),
        (-12.8, -5.2),
    ]
    planes = [("ground", Plane.make((x, y, 0.012), (1, 0, 0), (0, 1, 0)), 0.5) for x, y in flat]
    walls = [
        ((-2.9, -HALF_WIDTH, 2.75), (1, 0, 0)),
        ((2.3, -HALF_WIDTH, 3.6), (1, 0, 0)),
        ((-HALF_LENGTH, 0.3, 2.9), (0, -1, 0)),
        ((3.0, HALF_WIDTH, 2.85), (-1, 0, 0)),
        ((-2.6, HALF_WIDTH, 2.9), (-1, 0, 0)),
        ((HALF_LENGTH, 0.0, 5.0), (0, 1, 0)),
    ]
    for origin, u in walls:
        wall = Plane.make(origin, u, (0, 0, 1))
        planes.append(("wall", wall.at(0, 0, 0.012), 0.36))
    slope = (HALF_WIDTH, RIDGE - EAVES)
    south = Plane.make((0, -HALF_WIDTH, EAVES), (1, 0, 0), (0, *slope))
    north = Plane.make((0, HALF_WIDTH, EAVES), (-1, 0, 0), (0, -slope[0], slope[1]))
    for slope_plane, right, up in ((south, -5.2, 0.7), (south, 0.2, 4.3), (north, -5.0, 4.6), (north, 5.2, 0.8)):
        planes.append(("roof", slope_plane.at(right, up, 0.212), 0.5))
    return planes


def _turn(plot_yaw_deg: float) -> Array:
    angle = np.deg2rad(plot_yaw_deg)
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def turned(points: Array) -> Array:
    """Convert plot coordinates (..., 3) to east, north, up."""
    return np.asarray(points @ _turn(PLOT_YAW_DEG).T)


def build_scene(seed: int = SEED) -> DemoScene:
    """Build and paint the scene, in about 20 s."""
    builder = Builder()
    add_house(builder)
    add_surroundings(builder, seed)
    turn = _turn(PLOT_YAW_DEG)
    points = []
    for number, (where, plane, size) in enumerate(_target_planes(), 1):
        builder.rect(plane, (-size / 2, -size / 2), (size / 2, size / 2), target, texel_m=0.005)
        points.append(SurveyTarget(f"P{number:02d}", where, turn @ plane.origin, turn @ plane.n))
    meshes = []
    for mesh in paint_faces(builder.faces, seed):
        vertices, normals = ((a.astype(np.float64) @ turn.T).astype(np.float32) for a in (mesh.vertices, mesh.normals))
        meshes.append(TexturedMesh(vertices, normals, mesh.triangles, mesh.uv, mesh.texture, mesh.gloss))
    return DemoScene(meshes, points)


def building_corners(paint: Painter | None = None) -> Array:
    """The corners of the house's own triangles, (m, 3, 3), without painting it: the same as in the scene, to float32.

    Targets lie 12 mm in front of its walls and roofs and are not included.

    Args:
        paint: Only triangles with this painter; None for all.
    """
    builder = Builder()
    add_house(builder)
    return _corners_of([face for face in builder.faces if paint is None or face.paint is paint])


def foliage_corners() -> Array:
    """The corners of the triangles of hedges, bushes and trees, (m, 3, 3), as in the scene."""
    builder = Builder()
    add_foliage(builder)
    return _corners_of(builder.faces)


def _corners_of(faces: Sequence[Face]) -> Array:
    corners = np.concatenate([face.vertices[face.triangles] for face in faces])
    turned = corners.astype(np.float32).astype(np.float64) @ _turn(PLOT_YAW_DEG).T
    return np.asarray(turned.astype(np.float32), np.float64)


def surface_of(scene: DemoScene) -> tuple[Array, np.ndarray[tuple[int, int], np.dtype[np.int64]]]:
    """All triangles of the scene as one mesh: vertices (n, 3) and triangles (m, 3), equal vertices joined."""
    vertices, triangles, count = [], [], 0
    for mesh in scene.meshes:
        vertices.append(mesh.vertices)
        triangles.append(mesh.triangles.astype(np.int64) + count)
        count += len(mesh.vertices)
    joined, index = np.unique(np.vstack(vertices), axis=0, return_inverse=True)
    corners = index.reshape(-1)[np.vstack(triangles)]
    whole = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    return joined.astype(np.float64), corners[whole]
