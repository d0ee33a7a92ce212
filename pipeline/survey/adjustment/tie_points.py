"""The block of a sparse model: its photos, lenses and well-spread tie points, in world metres."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.meeting_rays import ray_equations
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.sfm.lenses.lens_model import NAMES, is_known, narrow, set_lens, widen
from splatpipe.pipeline.sfm.mapping.retriangulation import MAX_ERROR_PX
from splatpipe.pipeline.survey.adjustment.block import Block, settle_points
from splatpipe.pipeline.survey.adjustment.block_distances import NO_DISTANCES
from splatpipe.pipeline.survey.adjustment.block_lens import Lens

PER_PHOTO = 150  # tie points of a photo: errors within one are not independent, and more add cost, not accuracy
PER_CELL = 2
MIN_VIEWS = 2
MIN_SIGMA_PX = 1.0  # least sigma of tie points: the errors of a lens and of matching are shared by neighbours
CELLS = 5  # a side, of the grid in which a photo's errors are averaged
TRIANGULATION_ROUNDS = 6  # rounds for points that start from where their rays meet
MIN_EIGENVALUE_RATIO = 1e-7  # least ratio of the eigenvalues of a point's rays


@dataclass(frozen=True)
class TieTable:
    """All observations of a model's points, point after point.

    Attributes:
        numbers: COLMAP ids of the photos.
        cameras: COLMAP ids of their cameras.
        ids: COLMAP ids of the points.
        points: Their positions, model frame.
        photo: Index of each observation's photo.
        point: Index of each observation's point, ascending.
        pixels: Of each observation.
    """

    numbers: tuple[int, ...]
    cameras: tuple[int, ...]
    ids: Int64[np.ndarray, " p"]
    points: Float64[np.ndarray, "p 3"]
    photo: Int64[np.ndarray, " m"]
    point: Int64[np.ndarray, " m"]
    pixels: Float64[np.ndarray, "m 2"]

    def only(self, chosen: Bool[np.ndarray, " p"]) -> TieTable:
        """The table of some of the points."""
        rows = chosen[self.point]
        place = np.cumsum(chosen) - 1
        return TieTable(
            self.numbers,
            self.cameras,
            self.ids[chosen],
            self.points[chosen],
            self.photo[rows],
            place[self.point[rows]],
            self.pixels[rows],
        )


def tie_table(reconstruction: pycolmap.Reconstruction, numbers: Sequence[int]) -> TieTable:
    """Read the observations of some photos; points that fewer than two of them see are left out."""
    photo, point, pixels = [], [], []
    for place, number in enumerate(numbers):
        for keypoint in reconstruction.images[number].points2D:
            if keypoint.has_point3D():
                photo.append(place)
                point.append(keypoint.point3D_id)
                pixels.append(keypoint.xy)
    ids, index, counts = np.unique(np.array(point, dtype=np.int64), return_inverse=True, return_counts=True)
    order = np.lexsort((np.array(photo, dtype=np.int64), index))
    xyz = np.array([reconstruction.points3D[number].xyz for number in ids.tolist()], dtype=np.float64).reshape(-1, 3)
    table = TieTable(
        tuple(numbers),
        tuple(reconstruction.images[number].camera_id for number in numbers),
        ids,
        xyz,
        np.array(photo, dtype=np.int64)[order],
        index[order],
        np.array(pixels, dtype=np.float64).reshape(-1, 2)[order],
    )
    return table.only((counts >= MIN_VIEWS) & np.isfinite(xyz).all(axis=1))


def block_of(
    table: TieTable,
    reconstruction: pycolmap.Reconstruction,
    world_from_model: Similarity,
    lens_of: Callable[[pycolmap.Camera], Lens],
    sigma_px: float,
) -> Block:
    """Build a block.

    Args:
        table: Its observations.
        reconstruction: The model.
        world_from_model: Its similarity to the world, metres.
        lens_of: Returns the lens of a camera, which has been converted to its wide model.
        sigma_px: Standard deviation of an observation.
    """
    used = sorted(set(table.cameras))
    lenses = []
    for number in used:
        camera = pycolmap.Camera(reconstruction.cameras[number].todict())
        if is_known(camera.model_name):
            widen(camera)
        lenses.append(lens_of(camera))
    poses = np.stack([reconstruction.images[number].cam_from_world().matrix() for number in table.numbers])
    centres = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])
    place = world_from_model.apply(table.points)
    return Block(
        poses[:, :, :3] @ world_from_model.rotation.T,
        world_from_model.apply(centres),
        np.array([used.index(number) for number in table.cameras], dtype=np.int64),
        tuple(lenses),
        place,
        table.photo,
        table.point,
        table.pixels,
        np.full(len(table.photo), sigma_px),
        place,
        np.zeros_like(place),
    )


def spread_points(
    table: TieTable, sizes: Sequence[tuple[int, int]], per_photo: int = PER_PHOTO
) -> Bool[np.ndarray, " p"]:
    """Choose tie points: the longest tracks first, as many as every photo needs in each cell of a grid.

    Args:
        table: All observations.
        sizes: Width and height of each photo.
        per_photo: Points wanted in each.
    """
    across = max(1, round((per_photo / PER_CELL) ** 0.5))
    extent = np.array(sizes, dtype=np.float64)[table.photo]
    cell = np.clip((across * table.pixels / extent).astype(np.int64), 0, across - 1)
    place = (table.photo * across + cell[:, 1]) * across + cell[:, 0]
    full = np.zeros(len(table.numbers) * across**2, dtype=np.int64)
    ends = np.searchsorted(table.point, np.arange(len(table.ids) + 1))
    taken = np.zeros(len(table.ids), dtype=bool)
    for point in np.argsort(-np.diff(ends), kind="stable").tolist():
        seen = place[ends[point] : ends[point + 1]]
        if (full[seen] < PER_CELL).any():
            taken[point] = True
            full[seen] += 1
    return taken


def sizes_of(table: TieTable, reconstruction: pycolmap.Reconstruction) -> list[tuple[int, int]]:
    """Width and height of each photo of a table, in the model's pixels."""
    return [(reconstruction.cameras[c].width, reconstruction.cameras[c].height) for c in table.cameras]


def intersected(block: Block) -> Block:
    """Place all tie points where their rays meet, for the cameras as they are.

    A point whose rays are nearly parallel stays where it is.
    """
    rays = np.ones((len(block.photo), 3))
    for number, lens in enumerate(block.lenses):
        rows = np.flatnonzero(block.lens_of[block.photo] == number)
        rays[rows, :2] = np.asarray(lens.camera.cam_from_img(block.pixels[rows]), np.float64).reshape(-1, 2)
    sound = np.asarray(np.isfinite(rays).all(axis=1))
    rays = np.where(sound[:, None], rays, 1.0)
    ways = np.einsum("mji,mj->mi", block.rotations[block.photo], rays)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    equations = ray_equations(
        block.point, len(block.points), block.centres[block.photo], ways, sound.astype(np.float64)
    )
    points, meet = equations.solved(MIN_EIGENVALUE_RATIO)
    points[~meet] = block.points[~meet]
    return settle_points(replace(block, points=points), TRIANGULATION_ROUNDS)


def image_errors(block: Block) -> Float64[np.ndarray, "m 2"]:
    """Projected less observed, pixels."""
    return np.asarray(block.residuals() * block.sigmas[:, None])


def tie_sigma(block: Block) -> float:
    """Standard deviation of a tie point's observation, pixels: at least one, wider where neighbours share errors.

    Where the errors of a photo's cells do not average out as independent ones would, each observation is worth less.
    """
    errors = image_errors(block)
    sound = np.isfinite(errors).all(axis=1)
    unknowns = 3 * len(block.points) + block.unknowns
    degrees = max(2 * int(sound.sum()) - unknowns, 1)
    own = float((errors[sound] ** 2).sum()) / degrees
    size = np.array([[lens.camera.width, lens.camera.height] for lens in block.lenses])[block.lens_of[block.photo]]
    cell = np.clip((CELLS * block.pixels / size).astype(np.int64), 0, CELLS - 1)
    place = ((block.photo * CELLS + cell[:, 1]) * CELLS + cell[:, 0])[sound]
    count = np.bincount(place)
    sums = np.stack([np.bincount(place, weights=errors[sound, axis]) for axis in range(2)])
    full = count >= 2
    shared = float((sums[:, full] ** 2 / count[full]).sum()) / max(2 * int(full.sum()), 1)
    return max(MIN_SIGMA_PX, math.sqrt(max(own, shared)))


def observing(table: TieTable, block: Block, world_from_model: Similarity) -> Block:
    """A block's photos with other tie points."""
    place = world_from_model.apply(table.points)
    return replace(
        block,
        points=place,
        photo=table.photo,
        point=table.point,
        pixels=table.pixels,
        sigmas=np.ones(len(table.photo)),
        stated=place,
        weights=np.zeros_like(place),
        distances=NO_DISTANCES,
    )


def whole_model(
    reconstruction: pycolmap.Reconstruction, table: TieTable, block: Block, world_from_model: Similarity
) -> pycolmap.Reconstruction:
    """Return the whole model with a block's photos and lenses and all points placed anew, in the model's own frame."""
    every = settle_points(intersected(observing(table, block, world_from_model)))
    back = world_from_model.inverse()
    result = pycolmap.Reconstruction(reconstruction)
    used = sorted(set(table.cameras))
    for number, lens in zip(used, block.lenses, strict=True):
        camera = result.cameras[number]
        if is_known(lens.camera.model_name):
            names = NAMES[lens.camera.model_name]
            set_lens(camera, lens.camera.model_name, dict(zip(names, map(float, lens.camera.params), strict=True)))
            narrow(camera)
    centres = back.apply(block.centres)
    for place, number in enumerate(table.numbers):
        rotation = block.rotations[place] @ world_from_model.rotation
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centres[place])
        result.images[number].frame.set_cam_from_world(result.images[number].camera_id, pose)
    for number, xyz in zip(table.ids.tolist(), back.apply(every.points), strict=True):
        if np.isfinite(xyz).all():
            result.points3D[number].xyz = xyz
    pycolmap.ObservationManager(result).filter_all_points3D(MAX_ERROR_PX, 0.0)
    result.update_point_3d_errors()
    return result
