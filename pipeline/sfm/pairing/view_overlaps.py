"""Which of the points that one photo observes another photo should see, and which of them it does observe."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.sfm.model.structure import Structure
from splatpipe.pipeline.sfm.pairing.pairs import Pair

CELLS = 8  # across an image's longer side
MIN_VIEWS = 3  # photos of a point: fewer are not found again reliably
SAMPLE = 300  # points per photo
NEAREST = 24  # photos that each photo is compared with: those whose points lie nearest
ALIKE_DEG = 30.0  # angle between the two views: SIFT finds many points again
ANGLE_BINS = 6  # angle bins up to ALIKE_DEG: fewer points are found again from other directions
ALIKE_SCALE = 0.7  # ratio of the distances to a point: SIFT finds many points again
MIN_OCCLUSION_DEPTH_RATIO = 0.9  # depth of points seen beside a point, over its own, below which they hide it
# distance in the image, over the longer side, within which points are compared for occlusion
OCCLUSION_RADIUS_SHARE = 0.04
MAX_OCCLUDERS = 6  # points near a point in the image that may hide it
FAR = np.full(3, 1e12)  # where photos without points are
MARGIN = 0.02  # border of an image over its longer side: points in it may be outside


@dataclass(frozen=True)
class ViewOverlap:
    """A photo's points in another photo that should see them, by cells of its image.

    Attributes:
        pair: Rows of the two photos.
        bin: Of the mean angle between their views.
        hits: Points that the other observes.
        lacking: Points that it does not.
        own: Points that only the other observes.
        rows: (k, 2) the lacking points, and their cells.
    """

    pair: tuple[int, int]
    bin: int
    hits: Int64[np.ndarray, " cells"]
    lacking: Int64[np.ndarray, " cells"]
    own: Int64[np.ndarray, " cells"]
    rows: Int64[np.ndarray, "k 2"]


def compare_views(
    model: pycolmap.Reconstruction, structure: Structure, numbers: Int64[np.ndarray, " m"], tried: Collection[Pair]
) -> list[ViewOverlap]:
    """Compare each photo with those that show about the same place.

    Args:
        model: Its poses and lenses.
        structure: Its points.
        numbers: Placed photos, sorted.
        tried: (i, j), i < j, pairs that were matched: the others may lack common points for want of trying.
    """
    seen = _well_seen(structure, numbers)
    known = set(tried)
    centres = np.array([model.images[int(number)].projection_center() for number in numbers])
    middles = np.array([np.median(structure.points[rows], axis=0) if len(rows) else FAR for rows in seen])
    found = []
    for j, number in enumerate(numbers.tolist()):
        view = PhotoView(model, number, structure, seen[j], centres[j])
        apart = np.linalg.norm(middles - middles[j], axis=1)
        apart[j] = np.inf
        for i in np.argsort(apart, kind="stable")[:NEAREST].tolist():
            if i != j and (min(number, int(numbers[i])), max(number, int(numbers[i]))) in known:
                overlap = view.compare((i, j), structure.points, seen[i], centres[i])
                found += [overlap] if overlap is not None else []
    return found


class PhotoView:
    """A photo's points, and what lies in front of them."""

    def __init__(
        self,
        model: pycolmap.Reconstruction,
        number: int,
        structure: Structure,
        rows: Int64[np.ndarray, " k"],
        centre: Float64[np.ndarray, " 3"],
    ) -> None:
        self.camera = model.images[number].camera
        self.pose = model.images[number].cam_from_world().matrix()
        self.centre, self.rows = centre, rows
        self.longer = max(self.camera.width, self.camera.height)
        self.places, depths = project_through_lens(self.camera, self.pose, structure.points[rows])
        fine = np.isfinite(self.places).all(axis=1)
        self.rows, self.places, self.depths = rows[fine], self.places[fine], depths[fine]
        self.tree = cKDTree(self.places) if len(self.places) else None

    def compare(
        self,
        pair: tuple[int, int],
        points: Float64[np.ndarray, "n 3"],
        other: Int64[np.ndarray, " k"],
        centre: Float64[np.ndarray, " 3"],
    ) -> ViewOverlap | None:
        """Compare with the points that another photo observes; None if this one should see none of them."""
        if self.tree is None or not len(other):
            return None
        own = self._cells(self.places[~np.isin(self.rows, other, assume_unique=True)])
        other = other[:: max(1, -(-len(other) // SAMPLE))]
        shared = np.isin(other, self.rows, assume_unique=True)
        rows, places, angle = self._visible(points[other], centre, shared)
        if not len(rows):
            return None
        cells, size = self._cells(places), CELLS * CELLS
        lacking = ~shared[rows]
        return ViewOverlap(
            pair,
            min(int(ANGLE_BINS * angle / ALIKE_DEG), ANGLE_BINS - 1),
            np.bincount(cells[~lacking], minlength=size),
            np.bincount(cells[lacking], minlength=size),
            np.bincount(own, minlength=size),
            np.column_stack([other[rows[lacking]], cells[lacking]]),
        )

    def _visible(
        self, points: Float64[np.ndarray, "k 3"], centre: Float64[np.ndarray, " 3"], shared: np.ndarray
    ) -> tuple[np.ndarray, Float64[np.ndarray, "v 2"], float]:
        """Return the rows of the points that this photo should see from a similar view, where, and the mean angle."""
        places, depths = project_through_lens(self.camera, self.pose, points)
        edge = MARGIN * self.longer
        inside = (places >= edge).all(axis=1) & (places <= [self.camera.width - edge, self.camera.height - edge]).all(1)
        one, two = points - centre, points - self.centre
        lengths = np.linalg.norm(one, axis=1), np.linalg.norm(two, axis=1)
        cosines = np.einsum("ij,ij->i", one, two) / np.maximum(lengths[0] * lengths[1], 1e-12)
        angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
        alike = angles <= ALIKE_DEG
        alike &= np.minimum(*lengths) >= ALIKE_SCALE * np.maximum(*lengths)
        rows = np.flatnonzero(inside & alike & (depths > 0.0))
        if len(rows) and self.tree is not None:
            beside = min(MAX_OCCLUDERS, len(self.places))
            _, near = self.tree.query(places[rows], beside, distance_upper_bound=OCCLUSION_RADIUS_SHARE * self.longer)
            near = near.reshape(len(rows), -1)
            nearest = np.append(self.depths, np.inf)[near].min(axis=1)
            rows = rows[shared[rows] | (nearest >= MIN_OCCLUSION_DEPTH_RATIO * depths[rows])]
        return rows, places[rows], float(angles[rows].mean()) if len(rows) else 0.0

    def _cells(self, places: Float64[np.ndarray, "k 2"]) -> Int64[np.ndarray, " k"]:
        cells = np.clip((places * (CELLS / self.longer)).astype(np.int64), 0, CELLS - 1)
        return np.asarray(cells[:, 0] * CELLS + cells[:, 1])


def _well_seen(structure: Structure, numbers: Int64[np.ndarray, " m"]) -> list[Int64[np.ndarray, " _"]]:
    """Return the rows of the well observed points of each photo."""
    rows: dict[int, list[int]] = {int(number): [] for number in numbers}
    for row, track in enumerate(structure.tracks):
        photos = {photo for photo, _ in track}
        if len(photos) >= MIN_VIEWS:
            for photo in photos:
                rows[photo].append(row)
    return [np.array(found, np.int64) for found in rows.values()]
