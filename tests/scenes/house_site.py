"""A house with a gabled roof, a tree and a lawn, without noise: depths and colours by rays, analytic heights."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatpipe.pipeline.geometry.camera import Camera

Array = NDArray[np.float64]

EAVES_M, RIDGE_M = 3.0, 5.0  # heights
ROOF = (-4.5, 4.5, -3.5, 3.5)  # west, east, south, north of the eaves; the ridge runs east
WALLS = (-4.0, 4.0, -3.0, 3.0)
TREE = ((8.0, 5.0, 2.0), 1.5)  # centre and radius
NOTHING, GROUND, WALL, ROOF_SIDE, LEAVES = range(5)
STRIPE_M = 1.2


@dataclass(frozen=True, eq=False)
class ExactDepths:
    """Depth maps in `mvs`'s form, without errors."""

    camera: Camera
    depth: NDArray[np.float32]
    confidence: NDArray[np.uint8]


def photo_camera(name: str, eye: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    """Return a small camera at a place, looking at another; north is up if it looks straight down."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    up = (0.0, 1.0, 0.0) if abs(forward[2]) > 0.99 else (0.0, 0.0, 1.0)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ np.array(eye)
    return Camera(name, 240, 180, 200.0, 200.0, 120.0, 90.0, pose)


def cameras() -> list[Camera]:
    """Return nine nadir cameras, and eight around the house that look at it."""
    above = [(e, n, 20.0) for n in (-6.0, 0.0, 6.0) for e in (-7.0, 0.0, 7.0)]
    around = [(15.0 * np.cos(a), 15.0 * np.sin(a), 12.0) for a in np.arange(8) * np.pi / 4 + 0.2]
    down = [photo_camera(f"d{i}", place, (place[0], place[1], 0.0)) for i, place in enumerate(above)]
    return down + [photo_camera(f"o{i}", place, (0.0, 0.0, 1.5)) for i, place in enumerate(around)]


def roof_height(north: Array) -> Array:
    """Return the height of the roof's plane at a place."""
    return RIDGE_M - (RIDGE_M - EAVES_M) * np.abs(north) / ROOF[3]


def true_height(east: Array, north: Array) -> Array:
    """Return the height of the topmost surface."""
    height = np.zeros(np.shape(east))
    (tree_e, tree_n, tree_up), radius = TREE
    inside = radius**2 - (east - tree_e) ** 2 - (north - tree_n) ** 2
    height = np.where(inside > 0.0, tree_up + np.sqrt(np.maximum(inside, 0.0)), height)
    return np.where(_within(ROOF, east, north), roof_height(north), height)


def edge_distance(east: Array, north: Array) -> Array:
    """Return a place's distance from the nearest step in height: eaves or the tree's rim."""
    west, far, south, top = ROOF
    across = np.maximum(np.abs(east - (west + far) / 2) - (far - west) / 2, -np.inf)
    along = np.abs(north - (south + top) / 2) - (top - south) / 2
    outside = np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0))
    inside = np.minimum(np.maximum(across, along), 0.0)
    tree = np.abs(np.hypot(east - TREE[0][0], north - TREE[0][1]) - TREE[1])
    return np.minimum(np.abs(outside + inside), tree)


def _within(box: tuple[float, float, float, float], east: Array, north: Array) -> NDArray[np.bool_]:
    return (east > box[0]) & (east < box[1]) & (north > box[2]) & (north < box[3])


def trace(origin: Array, ray: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the distance to the first surface in lengths of the ray, infinite in the sky, and which surface it is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = [(np.where(ray[2] < 0.0, -origin[2] / ray[2], np.inf), GROUND), *_walls(origin, ray)]
        slope = (RIDGE_M - EAVES_M) / ROOF[3]
        for side in (-1.0, 1.0):  # up = ridge - slope * side * north
            t = (RIDGE_M - slope * side * origin[1] - origin[2]) / (ray[2] + slope * side * ray[1])
            e, n = origin[0] + t * ray[0], origin[1] + t * ray[1]
            hits.append((np.where(_within(ROOF, e, n) & (n * side >= 0.0) & (t > 0.0), t, np.inf), ROOF_SIDE))
        centre, radius = np.array(TREE[0]), TREE[1]
        off = origin - centre
        a, b, c = (ray**2).sum(axis=0), np.tensordot(off, ray, 1), off @ off - radius**2
        t = (-b - np.sqrt(b * b - a * c)) / a
        hits.append((np.where(t > 0.0, t, np.inf), LEAVES))
    distance = np.stack([np.where(np.isnan(t), np.inf, t) for t, _ in hits])
    first = np.argmin(distance, axis=0)
    nearest = np.take_along_axis(distance, first[None], 0)[0]
    return nearest, np.where(np.isinf(nearest), NOTHING, np.array([kind for _, kind in hits])[first])


def _walls(origin: Array, ray: Array) -> list[tuple[Array, int]]:
    hits = []
    for axis, value in ((0, WALLS[0]), (0, WALLS[1]), (1, WALLS[2]), (1, WALLS[3])):
        t = (value - origin[axis]) / ray[axis]
        other = origin[1 - axis] + t * ray[1 - axis]
        up = origin[2] + t * ray[2]
        low, high = WALLS[2:] if axis == 0 else WALLS[:2]
        top = roof_height(other if axis == 0 else np.full_like(other, value))
        there = (t > 0.0) & (other > low) & (other < high) & (up > 0.0) & (up < top)
        hits.append((np.where(there, t, np.inf), WALL))
    return hits


def _rays(camera: Camera, parts: int) -> Array:
    x = ((np.arange(camera.width * parts) + 0.5) / parts - camera.cx) / camera.fx
    y = ((np.arange(camera.height * parts) + 0.5) / parts - camera.cy) / camera.fy
    grid = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))])
    return np.tensordot(camera.cam_from_world[:3, :3].T, grid, 1)


def depths_of(camera: Camera) -> ExactDepths:
    """Return true depths, 0 in the sky; each confirmed by four."""
    depth, _ = trace(camera.centre(), _rays(camera, 1))
    known = np.isfinite(depth)
    return ExactDepths(camera, np.where(known, depth, 0.0).astype(np.float32), np.where(known, 4, 0).astype(np.uint8))


def colours(kind: NDArray[np.int64], east: Array, north: Array) -> Array:
    """Return the surfaces' colours, (..., 3) from 0 to 255: only walls are red; the others have stripes."""
    stripe = 0.5 + 0.5 * np.sin(2 * np.pi * (east + 0.6 * north) / STRIPE_M)
    bases = {
        NOTHING: (200.0, 220.0, 255.0),
        GROUND: (60.0, 150.0, 60.0),
        WALL: (230.0, 20.0, 20.0),
        ROOF_SIDE: (90.0, 90.0, 160.0),
        LEAVES: (20.0, 90.0, 20.0),
    }
    colour = np.array([bases[i] for i in range(5)])[kind]
    return colour + np.where((kind == GROUND) | (kind == ROOF_SIDE), stripe * 50.0, 0.0)[..., None]


def photo_of(camera: Camera, parts: int = 2) -> NDArray[np.uint8]:
    """Return what the camera sees, each pixel the mean of several samples."""
    origin, ray = camera.centre(), _rays(camera, parts)
    depth, kind = trace(origin, ray)
    safe = np.where(np.isfinite(depth), depth, 0.0)
    sampled = colours(kind, origin[0] + safe * ray[0], origin[1] + safe * ray[1])
    mean = sampled.reshape(camera.height, parts, camera.width, parts, 3).mean(axis=(1, 3))
    return np.clip(mean, 0, 255).round().astype(np.uint8)


def true_orthophoto(east: Array, north: Array) -> Array:
    """Return the colours of the topmost surfaces."""
    inside_tree = (east - TREE[0][0]) ** 2 + (north - TREE[0][1]) ** 2 < TREE[1] ** 2
    kind = np.where(_within(ROOF, east, north), ROOF_SIDE, np.where(inside_tree, LEAVES, GROUND))
    return colours(kind, east, north)
