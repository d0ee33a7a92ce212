"""Free space between the cameras and the points that they observe, and the floaters of a splat in it.

A sparse point that a photo observes means that the ray up to it is free: the idea of space carving and visibility
consistency (Kutulakos, Seitz: "A Theory of Shape by Space Carving", IJCV 2000), here with the rays of few points. Each
photo is divided into cells, and the least depth of the points observed in a cell and its eight neighbours bounds the
surface there. All choices favour keeping real objects over finding every floater:

- A cell has a bound only with at least two points of its own, and only within the extent of the points around it: its
  neighbours may lower its bound but never provide one. So textureless objects wider than a cell are not judged, nor is
  the ground in front of a wall: below the wall's last points it comes nearer by a third within one cell.
- The least depth, not a percentile: a wrong point that is too near keeps a floater but removes no surface.
- A Gaussian is in front where its centre plus one standard deviation along the optical axis is nearer than the bound
  less a tenth: most of it is. Haze whose three sigmas would reach the wall still counts as a floater.
- Two photos have to agree, and a well-observed point right beside the Gaussian overrules them: a post in front of a
  wall is thinner than a cell, but has points of its own.

`tests/slow/truth/test_truth.py` checks this against the true surface of the demo capture.

Close to a camera two photos rarely overlap, so one is enough: anything nearer than a fifth of the depth at which its
points begin, and nearer than all of them, is a floater.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.model.gaussians import Gaussians, multiply_quats

CELLS = 24  # along the longer side: about 30 pixels at half a megapixel, 4 % of the depth
OWN_POINTS = 2  # points that a cell needs for a bound: a single one may lie past the edge of a foreground object
POINTS_AROUND = 6  # points needed in a cell and its eight neighbours
MARGIN = 0.1  # share of the depth kept free before a surface: it curves between points accurate to a tenth of a pixel
MIN_VIEWS = 2  # photos that have to see through a Gaussian: one may have a wrong point, or miss a thin object
SUPPORT_TRACK = 3  # least track length of a point that overrules: two-view points themselves hang in free space
SUPPORT_SHARE = 0.04  # distance to a point over that to the nearest camera (one cell): nearer is on its surface
NEAR_SHARE = 0.2  # nearest depth tested over the depth where a photo's points begin
NEAR_PERCENTILE = 5  # percentile of its points' depths where they begin
CHUNK = 65_536  # Gaussians at a time: a few megabytes


@dataclass(frozen=True, eq=False)
class PhotoBounds:
    """A photo's lower bounds on surface depth, in square cells.

    Attributes:
        camera: The photo's camera.
        depth: Depth nearer than which there is no surface, world units along the optical axis; 0 where unknown.
        box: Left, top, right and bottom of the points behind each bound, pixels; it does not apply outside of them.
        near: Distance from the camera within which there is nothing, world units; 0 where unknown.
    """

    camera: Camera
    depth: Float64[np.ndarray, "rows columns"]
    box: Float64[np.ndarray, "4 rows columns"]
    near: float


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The free space of all photos.

    Attributes:
        photos: Bounds of each photo.
        support: Points observed by at least `SUPPORT_TRACK` photos, world units.
    """

    photos: tuple[PhotoBounds, ...]
    support: Float64[np.ndarray, "p 3"]

    @property
    def known(self) -> bool:
        """Whether enough photos have enough points to identify free space."""
        return sum(bool(photo.depth.any()) for photo in self.photos) >= MIN_VIEWS


def free_space(
    cameras: Sequence[Camera], xyz: Float64[np.ndarray, "n 3"], seen: Sequence[Int64[np.ndarray, " _"]]
) -> FreeSpace:
    """Bound the surface from the sparse points that each photo observes.

    Args:
        cameras: Cameras whose observations count; in training, the training views.
        xyz: All sparse points, world units.
        seen: Rows of the points that each camera's photo observes.
    """
    finite = np.isfinite(xyz).all(axis=1)
    seen = [np.unique(rows[finite[rows]]) for rows in seen]
    photos = sum((np.bincount(rows, minlength=len(xyz)) for rows in seen), np.zeros(len(xyz), np.int64))
    bounds = (_bounds(camera, xyz[rows]) for camera, rows in zip(cameras, seen, strict=True))
    return FreeSpace(tuple(bounds), xyz[photos >= SUPPORT_TRACK])


def near_or_free(gaussians: Gaussians, space: FreeSpace, views: int = MIN_VIEWS) -> Bool[Tensor, " n"]:
    """Which Gaussians are floaters: in free space, or right in front of a camera.

    Args:
        gaussians: In the frame of the cameras; non-finite ones are not floaters.
        space: Result of ``free_space``.
        views: Photos in which a Gaussian has to lie in front of all that is observed there; none count beside a
            well-observed point.
    """
    judge = _judge if gaussians.means.device.type == "cpu" else _judge_on_device
    through, near = judge(gaussians, space)
    return torch.from_numpy((through >= views) | near)


def share_of_opacity(gaussians: Gaussians, chosen: Bool[Tensor, " n"]) -> float:
    """The chosen Gaussians' share of the sum of all opacities, 0..1; 0 if there are none.

    Each Gaussian counts once, whatever its size: sizes differ by powers of ten, and weighted by size in the world, a
    sky of a few huge Gaussians would outweigh all else. The area that floaters cover is measured in renders.

    Args:
        gaussians: The model; non-finite Gaussians do not count.
        chosen: Mask of the chosen Gaussians.
    """
    opacity = torch.sigmoid(gaussians.opacity_logits.detach().to(torch.float64))
    opacities = torch.where(_usable(gaussians), opacity, 0.0).numpy(force=True)  # torch's sums depend on its threads
    total = float(opacities.sum())
    return float(opacities[chosen.numpy(force=True)].sum()) / total if total > 0.0 else 0.0


def _bounds(camera: Camera, points: Float64[np.ndarray, "n 3"]) -> PhotoBounds:
    """A photo's bounds from the (finite) points that it observes."""
    rows, columns = _grid(camera)
    own = np.zeros((rows, columns), np.int64)
    around = np.zeros((rows + 2, columns + 2), np.int64)  # padded, so that every cell has eight neighbours
    least = np.full((5, rows + 2, columns + 2), np.inf)  # minima by cell: depth, x, y, -x, -y
    _, pixels, cells, depths = _cells(camera, points)
    values = np.stack((depths, pixels[:, 0], pixels[:, 1], -pixels[:, 0], -pixels[:, 1]))
    np.add.at(own, (cells[:, 0], cells[:, 1]), 1)
    for down in (0, 1, 2):
        for right in (0, 1, 2):
            place = (cells[:, 0] + down, cells[:, 1] + right)
            np.add.at(around, place, 1)
            for lowest, value in zip(least, values, strict=True):
                np.minimum.at(lowest, place, value)
    least = least[:, 1:-1, 1:-1]
    defined = (own >= OWN_POINTS) & (around[1:-1, 1:-1] >= POINTS_AROUND)
    near = 0.0
    if depths.size >= POINTS_AROUND:
        begins = NEAR_SHARE * float(np.percentile(depths, NEAR_PERCENTILE))
        near = min(begins, (1.0 - MARGIN) * float(depths.min()))
    box = np.stack((least[1], least[2], -least[3], -least[4]))
    return PhotoBounds(camera, np.where(defined, least[0], 0.0), box, near)


def _grid(camera: Camera) -> tuple[int, int]:
    """Rows and columns of a photo's cells."""
    side = max(camera.width, camera.height) / CELLS
    return math.ceil(camera.height / side), math.ceil(camera.width / side)


def _cells(
    camera: Camera, points: Float64[np.ndarray, "n 3"]
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 2"], Int64[np.ndarray, "k 2"], Float64[np.ndarray, " k"]]:
    """Points inside a photo: their indices, pixels, cells (row, column) and depths."""
    rows, pixels, depths = camera.in_view(points)
    cells = (pixels[:, ::-1] * (CELLS / max(camera.width, camera.height))).astype(np.int64)
    return rows, pixels, np.minimum(cells, np.array(_grid(camera)) - 1), depths


def _judge(gaussians: Gaussians, space: FreeSpace) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """In how many photos each Gaussian lies in front of the observed points, and which are right before a camera."""
    through, near = np.zeros(len(gaussians), np.int64), np.zeros(len(gaussians), np.bool_)
    for chunk in _chunks(np.flatnonzero(_usable(gaussians).numpy(force=True))):
        means = gaussians.means[torch.from_numpy(chunk)].detach().cpu().numpy().astype(np.float64)
        for photo in space.photos:
            rows, pixels, cells, depths = _cells(photo.camera, means)
            front = np.flatnonzero(depths < (1.0 - MARGIN) * photo.depth[cells[:, 0], cells[:, 1]])
            front = front[_within(pixels[front], cells[front], photo)]  # few, so the spread is only computed for these
            spread = spread_along(gaussians, chunk[rows[front]], photo.camera.cam_from_world[2, :3])
            limits = (1.0 - MARGIN) * photo.depth[cells[front, 0], cells[front, 1]]
            through[chunk[rows[front[depths[front] + spread < limits]]]] += 1
            close = rows[depths < photo.near]
            distance = np.linalg.norm(means[close] - photo.camera.centre(), axis=1)
            near[chunk[close[distance < photo.near]]] = True
    through[_supported(gaussians, np.flatnonzero(through), space)] = 0
    return through, near


def _judge_on_device(gaussians: Gaussians, space: FreeSpace) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The same for Gaussians on a device."""
    through, near = np.zeros(len(gaussians), np.int64), np.zeros(len(gaussians), np.bool_)
    means, usable = gaussians.means.detach().to(torch.float64), _usable(gaussians)
    for photo in space.photos:
        before = _centres_before(means, usable, photo, 1.0 - MARGIN, CELLS)
        spread = spread_along(gaussians, before.rows, photo.camera.cam_from_world[2, :3])
        through[before.rows[before.depths + spread < before.limits]] += 1
        near[before.close] = True
    through[_supported(gaussians, np.flatnonzero(through), space)] = 0
    return through, near


def _within(
    pixels: Float64[np.ndarray, "k 2"], cells: Int64[np.ndarray, "k 2"], photo: PhotoBounds
) -> Bool[np.ndarray, " k"]:
    """Which pixels lie within the box of the points that bound their cell."""
    left, top, right, bottom = photo.box[:, cells[:, 0], cells[:, 1]]
    x, y = pixels.T
    return np.asarray((x >= left) & (x <= right) & (y >= top) & (y <= bottom))


def _usable(gaussians: Gaussians) -> Bool[Tensor, " n"]:
    """Which Gaussians have finite means, scales, rotations and opacities; SH, most of the memory, is not read."""
    tensors = (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits[:, None])
    return torch.stack([torch.isfinite(tensor.detach()).all(1) for tensor in tensors]).all(0)


def _chunks(rows: Int64[np.ndarray, " _"]) -> Iterator[Int64[np.ndarray, " _"]]:
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def spread_along(
    gaussians: Gaussians, rows: Int64[np.ndarray, " k"], axis: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, " k"]:
    """Standard deviation of the given Gaussians along a world axis, world units: |S Rᵀ axis|."""
    index = torch.from_numpy(rows)
    quats = gaussians.quats[index].detach().cpu().to(torch.float64)
    length = torch.linalg.vector_norm(quats, dim=1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    quats = torch.where(length > 0.0, quats / length.clamp(min=1e-300), identity)
    along = torch.from_numpy(np.concatenate(([0.0], axis))).expand(len(rows), 4)
    conjugate = quats * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=torch.float64)
    turned = multiply_quats(conjugate, multiply_quats(along, quats))[:, 1:]
    scales = torch.exp(gaussians.log_scales[index].detach().cpu().to(torch.float64))
    return np.asarray(torch.linalg.vector_norm(scales * turned, dim=1).numpy())


def _supported(gaussians: Gaussians, rows: Int64[np.ndarray, " k"], space: FreeSpace) -> Int64[np.ndarray, " _"]:
    """The rows whose Gaussians lie beside a well-observed point."""
    if rows.size == 0 or len(space.support) == 0:
        return rows[:0]
    trees = cKDTree(space.support), cKDTree(np.array([photo.camera.centre() for photo in space.photos]))
    found = []
    for chunk in _chunks(rows):
        means = gaussians.means[torch.from_numpy(chunk)].detach().cpu().numpy().astype(np.float64)
        to_point, to_camera = (tree.query(means)[0] for tree in trees)
        found.append(chunk[to_point <= to_camera * SUPPORT_SHARE])
    return np.concatenate(found)


@dataclass(frozen=True, eq=False)
class _GaussiansInFront:
    """Gaussians whose centres lie in front of a photo's bounds.

    Attributes:
        rows: Their rows.
        depths: Depths of their centres, world units.
        limits: Depths nearer than which they are in front of the surface, world units.
        close: Rows of the Gaussians right in front of the camera.
    """

    rows: Int64[np.ndarray, " k"]
    depths: Float64[np.ndarray, " k"]
    limits: Float64[np.ndarray, " k"]
    close: Int64[np.ndarray, " c"]


def _centres_before(
    means: Float64[Tensor, "n 3"], usable: Bool[Tensor, " n"], photo: PhotoBounds, share: float, cells_a_side: int
) -> _GaussiansInFront:
    """Find centres in front of a photo's bounds, as ``_judge`` does on the CPU; copy only a few to the host.

    Args:
        means: Centres on the device.
        usable: Mask of the finite Gaussians.
        photo: The photo's bounds.
        share: Share of a bound's depth up to which a point is certainly in front.
        cells_a_side: Number of cells along the photo's longer side.
    """
    camera = photo.camera
    x, y, z = (_along(means, camera.cam_from_world[axis]) for axis in range(3))
    u, v = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
    inside = usable & (z > 0.0) & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
    rows = torch.nonzero(inside).flatten()  # synchronizes: the count comes from the device
    u, v, z = u[rows], v[rows], z[rows]
    side = cells_a_side / max(camera.width, camera.height)
    grid_rows, grid_columns = photo.depth.shape
    cell = (v * side).long().clamp(max=grid_rows - 1) * grid_columns + (u * side).long().clamp(max=grid_columns - 1)
    limits = share * _on(photo.depth, means.device)[cell]
    left, top, right, bottom = (_on(edge, means.device)[cell] for edge in photo.box)
    front = (z < limits) & (u >= left) & (u <= right) & (v >= top) & (v <= bottom)
    away = (means[rows] - torch.from_numpy(camera.centre()).to(means.device)).square().sum(dim=1).sqrt()
    close = (z < photo.near) & (away < photo.near)
    found = (rows[front], z[front], limits[front], rows[close])
    return _GaussiansInFront(*(part.cpu().numpy() for part in found))


def _along(means: Float64[Tensor, "n 3"], row: Float64[np.ndarray, " 4"]) -> Float64[Tensor, " n"]:
    """A row of a pose times each point, one product after another, with scalars from the host."""
    a, b, c, d = (float(value) for value in row)
    return means[:, 0] * a + means[:, 1] * b + means[:, 2] * c + d


def _on(values: np.ndarray, device: torch.device) -> Float64[Tensor, " cells"]:
    return torch.from_numpy(np.ascontiguousarray(values).ravel()).to(device)
