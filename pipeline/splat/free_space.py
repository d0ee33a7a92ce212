"""Where nothing can be: the space between the photos and the points that they see, and what of a splat hangs there.

A sparse point that a photo observes says that the ray up to it is free: the idea of space carving and visibility
consistency (Kutulakos, Seitz: "A Theory of Shape by Space Carving", IJCV 2000), here with the rays of few points. Each
photo is divided into cells, and the least depth of the points that it observes in a cell and the eight around it bounds
the surface there. All choices keep real things rather than find every floater:

- A cell says nothing without two points of its own, nor beyond the outermost of the points around it: its neighbours
  lower its bound and do not give it one. So textureless things wider than a cell stay unjudged, and so does the ground
  before the foot of a wall: below the wall's last points it comes nearer by a third within one cell.
- The least depth, not a percentile: a wrong point that is too near costs a floater that stays, and no surface.
- A Gaussian is in front where its centre and one of its standard deviations along the view axis are nearer than the
  bound less a tenth: most of it is. A haze that three of them would let reach the wall is a floater all the same.
- Two photos have to say so, and a well-observed point right beside the Gaussian refutes them: a post in front of a
  wall is thinner than a cell, but has points of its own.

`tests/test_truth.py` holds this against the true surface of the demo capture.

Close to a camera there are hardly two photos, so one is enough: nearer than a fifth of the depth at which its points
begin, and than all of them, there is nothing but floaters.
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
from splatpipe.pipeline.splat.free_space_on_device import centres_before
from splatpipe.pipeline.splat.gaussians import Gaussians, multiply_quats

CELLS = 24  # along the longer side: some 30 pixels at half a megapixel, 4 % of the depth
OWN_POINTS = 2  # of a cell whose bound is defined: one alone may look past the edge of what is in front
POINTS_AROUND = 6  # with its eight neighbours
MARGIN = 0.1  # of the depth: sparse points of a tenth of a pixel are much better, surfaces between them curve
VIEWS = 2  # photos that have to see through a Gaussian: one may have a wrong point, or miss a thin thing
SUPPORT_TRACK = 3  # photos that observe a point which refutes: those of two are the ones that hang in free space
SUPPORT_SHARE = 0.04  # of the distance to the nearest camera, a cell: nearer to such a point is on its surface
NEAR_SHARE = 0.2  # of the depth where a photo's points begin
NEAR_PERCENTILE = 5  # of the depths of its points: where they begin
CHUNK = 65_536  # Gaussians at a time: a few megabytes


@dataclass(frozen=True, eq=False)
class PhotoBounds:
    """What a photo sees through, in square cells.

    Attributes:
        camera: The photo's.
        depth: No surface is nearer than that, world units along the view axis; 0 where that is not known.
        box: Left, top, right and bottom of the points that say so, pixels: beyond them they say nothing.
        near: Nothing is nearer to the camera than that, world units; 0 where that is not known.
    """

    camera: Camera
    depth: Float64[np.ndarray, "rows columns"]
    box: Float64[np.ndarray, "4 rows columns"]
    near: float


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """What the photos see through.

    Attributes:
        photos: Each one's part of it.
        support: Points observed by `SUPPORT_TRACK` photos or more, world units.
    """

    photos: tuple[PhotoBounds, ...]
    support: Float64[np.ndarray, "p 3"]

    @property
    def known(self) -> bool:
        """Whether there are photos enough, with points enough, to call anything free."""
        return sum(bool(photo.depth.any()) for photo in self.photos) >= VIEWS


def free_space(
    cameras: Sequence[Camera], xyz: Float64[np.ndarray, "n 3"], seen: Sequence[Int64[np.ndarray, " _"]]
) -> FreeSpace:
    """Bound the surface from the sparse points that each photo observes.

    Args:
        cameras: Those whose observations count; in training, its own.
        xyz: All sparse points, world units.
        seen: Rows of the points that each camera's photo observes.
    """
    finite = np.isfinite(xyz).all(axis=1)
    seen = [np.unique(rows[finite[rows]]) for rows in seen]
    photos = sum((np.bincount(rows, minlength=len(xyz)) for rows in seen), np.zeros(len(xyz), np.int64))
    bounds = (_bounds(camera, xyz[rows]) for camera, rows in zip(cameras, seen, strict=True))
    return FreeSpace(tuple(bounds), xyz[photos >= SUPPORT_TRACK])


def near_or_free(gaussians: Gaussians, space: FreeSpace, views: int = VIEWS) -> Bool[Tensor, " n"]:
    """Which Gaussians are floaters: in free space, or right before a camera.

    Args:
        gaussians: In the frame of the cameras; one that is not finite is in front of nothing.
        space: Of ``free_space``.
        views: Photos in which one has to hang in front of all that is observed there; beside a well-observed point none
            counts.
    """
    judge = _judge if gaussians.means.device.type == "cpu" else _judge_on_device
    through, near = judge(gaussians, space)
    return torch.from_numpy((through >= views) | near)


def share_of_opacity(gaussians: Gaussians, chosen: Bool[Tensor, " n"]) -> float:
    """The chosen Gaussians' part of the sum of all opacities, 0..1; 0 without any.

    Each Gaussian counts once, whatever its size: sizes differ by powers of ten, and by the world's size one sky of a
    few huge Gaussians would outweigh all else. What a floater covers is measured where it is seen, in renders.

    Args:
        gaussians: The model; Gaussians that are not finite do not count.
        chosen: Which.
    """
    opacity = torch.sigmoid(gaussians.opacity_logits.detach().to(torch.float64))
    opacities = torch.where(_usable(gaussians), opacity, 0.0).numpy(force=True)  # torch's sums depend on its threads
    total = float(opacities.sum())
    return float(opacities[chosen.numpy(force=True)].sum()) / total if total > 0.0 else 0.0


def _bounds(camera: Camera, points: Float64[np.ndarray, "n 3"]) -> PhotoBounds:
    """A photo's bounds from the points (finite) that it observes."""
    rows, columns = _grid(camera)
    own = np.zeros((rows, columns), np.int64)
    around = np.zeros((rows + 2, columns + 2), np.int64)  # a ring around, so that every cell has eight neighbours
    least = np.full((5, rows + 2, columns + 2), np.inf)  # of depth, x, y, -x, -y
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
    """Which points fall into a photo: their rows, their pixels, their cells (row, column), and their depths."""
    rows, pixels, depths = camera.in_view(points)
    cells = (pixels[:, ::-1] * (CELLS / max(camera.width, camera.height))).astype(np.int64)
    return rows, pixels, np.minimum(cells, np.array(_grid(camera)) - 1), depths


def _judge(gaussians: Gaussians, space: FreeSpace) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """In how many photos each Gaussian hangs in front of what they observe, and which are right before a camera."""
    through, near = np.zeros(len(gaussians), np.int64), np.zeros(len(gaussians), np.bool_)
    for chunk in _chunks(np.flatnonzero(_usable(gaussians).numpy(force=True))):
        means = gaussians.means[torch.from_numpy(chunk)].detach().cpu().numpy().astype(np.float64)
        for photo in space.photos:
            rows, pixels, cells, depths = _cells(photo.camera, means)
            front = np.flatnonzero(depths < (1.0 - MARGIN) * photo.depth[cells[:, 0], cells[:, 1]])
            front = front[_within(pixels[front], cells[front], photo)]  # few: only of them is the spread looked at
            spread = spread_along(gaussians, chunk[rows[front]], photo.camera.cam_from_world[2, :3])
            limits = (1.0 - MARGIN) * photo.depth[cells[front, 0], cells[front, 1]]
            through[chunk[rows[front[depths[front] + spread < limits]]]] += 1
            close = rows[depths < photo.near]
            distance = np.linalg.norm(means[close] - photo.camera.centre(), axis=1)
            near[chunk[close[distance < photo.near]]] = True
    through[_supported(gaussians, np.flatnonzero(through), space)] = 0
    return through, near


def _judge_on_device(gaussians: Gaussians, space: FreeSpace) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The same of Gaussians on a device."""
    through, near = np.zeros(len(gaussians), np.int64), np.zeros(len(gaussians), np.bool_)
    means, usable = gaussians.means.detach().to(torch.float64), _usable(gaussians)
    for photo in space.photos:
        before = centres_before(means, usable, photo, 1.0 - MARGIN, CELLS)
        spread = spread_along(gaussians, before.rows, photo.camera.cam_from_world[2, :3])
        through[before.rows[before.depths + spread < before.limits]] += 1
        near[before.close] = True
    through[_supported(gaussians, np.flatnonzero(through), space)] = 0
    return through, near


def _within(
    pixels: Float64[np.ndarray, "k 2"], cells: Int64[np.ndarray, "k 2"], photo: PhotoBounds
) -> Bool[np.ndarray, " k"]:
    """Which pixels lie among the points that bound their cell."""
    left, top, right, bottom = photo.box[:, cells[:, 0], cells[:, 1]]
    x, y = pixels.T
    return np.asarray((x >= left) & (x <= right) & (y >= top) & (y <= bottom))


def _usable(gaussians: Gaussians) -> Bool[Tensor, " n"]:
    """Which Gaussians have a finite place, size, turn and opacity; their colours, most of the memory, are not read."""
    tensors = (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits[:, None])
    return torch.stack([torch.isfinite(tensor.detach()).all(1) for tensor in tensors]).all(0)


def _chunks(rows: Int64[np.ndarray, " _"]) -> Iterator[Int64[np.ndarray, " _"]]:
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def spread_along(
    gaussians: Gaussians, rows: Int64[np.ndarray, " k"], axis: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, " k"]:
    """Standard deviation along an axis of the world, world units: |S Rᵀ axis|."""
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
    """Those of the rows that lie beside a well-observed point."""
    if rows.size == 0 or len(space.support) == 0:
        return rows[:0]
    trees = cKDTree(space.support), cKDTree(np.array([photo.camera.centre() for photo in space.photos]))
    found = []
    for chunk in _chunks(rows):
        means = gaussians.means[torch.from_numpy(chunk)].detach().cpu().numpy().astype(np.float64)
        to_point, to_camera = (tree.query(means)[0] for tree in trees)
        found.append(chunk[to_point <= to_camera * SUPPORT_SHARE])
    return np.concatenate(found)
