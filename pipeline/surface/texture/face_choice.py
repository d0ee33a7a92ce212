"""Which photo each triangle shows: the orthophoto's choice (``ortho.mosaic``), on triangles instead of cells.

A photo costs more where it differs from most others, e.g. for what moved; costs are averaged over the surroundings
(Hosni et al., "Fast Cost-Volume Filtering", 2013); the cheapest photo is chosen; then seams move to where both photos
look alike, by the seam cost of Kwatra et al. ("Graphcut Textures", 2003). At the end, photos of few triangles give way
to those around them: each border costs resolution and room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int16, Int32, Int64

from splatpipe.pipeline.surface.texture.face_graph import connected_parts, independent_groups
from splatpipe.pipeline.surface.texture.face_views import HIDDEN, NONE, FaceViews

# The orthophoto's, from native/surface/surface_mosaic*.cpp:
ODD_FREE = 15.0  # difference from the other photos, grey levels, that costs nothing,
ODD_COST = 15.0  # and the cost of each further one,
ODD_MOST = 60.0  # up to this
EVEN_COST = 64.0  # added to costs, so that the best photo does not outweigh the rest a hundredfold
SEAM, SEAM_STEP = 60.0, 12.0  # cost of a seam between two triangles, and of each grey level between the photos there
SWEEPS = 6  # passes that move seams

SOFT_ROUNDS = 2  # of averaging greys with the neighbours' before photos are compared
SMOOTH_ROUNDS = 12  # of averaging costs with the neighbours': some four triangles to each side
UNLIKE = 64.0  # difference, grey levels, where one of two photos at a seam does not see a triangle
JOIN_ROUNDS = 3  # passes in which photos of few triangles give way
BATCH = 1 << 17  # triangles at a time

Labels = Int16[np.ndarray, " m"]
Rows = Int64[np.ndarray, " r"]


@dataclass(frozen=True, eq=False)
class _Lists:
    """Each triangle's photos, and where they are in its neighbours' lists.

    Attributes:
        photo: Numbers of the photos, ``NONE`` for no more.
        beyond: Triangles beyond the edges, -1 for none.
        match: Places of the photos in the lists beyond each edge, -1 where they are not there.
    """

    photo: Int16[np.ndarray, "m k"]
    beyond: Int32[np.ndarray, "m 3"]
    match: Int8[np.ndarray, "m 3 k"]

    @staticmethod
    def of(photo: Int16[np.ndarray, "m k"], beyond: Int32[np.ndarray, "m 3"]) -> _Lists:
        match = np.empty((*beyond.shape, photo.shape[1]), np.int8)
        for start in range(0, len(photo), BATCH):
            part = np.s_[start : start + BATCH]
            own = photo[part]
            for edge in range(3):
                near = beyond[part, edge]
                same = (own[:, :, None] == photo[near][:, None, :]) & ((own != NONE) & (near >= 0)[:, None])[:, :, None]
                match[part, edge] = np.where(same.any(axis=2), same.argmax(axis=2), -1)
        return _Lists(photo, beyond, match)

    def average(
        self, value: Float32[np.ndarray, "m k"], rounds: int, instead: Float32[np.ndarray, " m"] | None
    ) -> Float32[np.ndarray, "m k"]:
        """Average values of photos with the neighbours', repeatedly.

        Args:
            value: A value of each photo.
            rounds: How often.
            instead: Value of a triangle in photos that are not in its list; None to leave them out.
        """
        for _ in range(rounds):
            mean = np.empty_like(value)
            for start in range(0, len(value), BATCH):
                part = np.s_[start : start + BATCH]
                total, weight = value[part].copy(), np.ones((len(value[part]), 1), np.float32)
                for edge in range(3):
                    near, place = self.beyond[part, edge], self.match[part, edge]
                    listed, exists = place >= 0, (near >= 0)[:, None]
                    theirs = value[near[:, None], place]
                    if instead is None:
                        total += np.where(listed, theirs, np.float32(0.0))
                        weight = weight + listed
                    else:
                        others = np.where(exists, instead[near][:, None], np.float32(0.0))
                        total += np.where(listed, theirs, others)
                        weight = weight + exists
                mean[part] = total / weight
            value = mean
        return value


@dataclass(frozen=True, eq=False)
class _Energy:
    """What labels cost: the averaged costs of photos, and seams.

    Attributes:
        lists: The photos to choose from.
        cost: Their costs, averaged.
        grey: Their grey levels.
    """

    lists: _Lists
    cost: Float32[np.ndarray, "m k"]
    grey: Float32[np.ndarray, "m k"]

    def of(self, rows: Rows, photo: Labels, label: Labels) -> Float32[np.ndarray, " r"]:
        """The energy of showing a photo on each of some triangles; infinite where it is not in its list."""
        total = self._value(self.cost, rows, photo, np.inf)
        own = self._value(self.grey, rows, photo, np.nan)
        for edge in range(3):
            near = self.lists.beyond[rows, edge]
            other = np.where(near >= 0, label[near], np.int16(NONE))
            seam = np.flatnonzero((other != NONE) & (other != photo))
            here, there = rows[seam], near[seam].astype(np.int64)
            apart = np.abs(own[seam] - self._value(self.grey, here, other[seam], np.nan))
            beside = self._value(self.grey, there, photo[seam], np.nan)
            beyond = np.abs(beside - self._value(self.grey, there, other[seam], np.nan))
            unlike = sum(np.where(np.isfinite(each), each, np.float32(UNLIKE)) for each in (apart, beyond))
            total[seam] += np.float32(SEAM) + np.float32(SEAM_STEP) * unlike
        return total

    def _value(self, values: Float32[np.ndarray, "m k"], rows: Rows, photo: Labels, missing: float) -> np.ndarray:
        same = self.lists.photo[rows] == photo[:, None]
        found = np.take_along_axis(values[rows], same.argmax(axis=1)[:, None], axis=1)[:, 0]
        return np.where(same.any(axis=1) & (photo != NONE), found, np.float32(missing))


def choose_photos(
    views: FaceViews, beyond: Int32[np.ndarray, "m 3"], areas: Float64[np.ndarray, " m"], least_m2: float
) -> Labels:
    """Choose a photo for each triangle, ``NONE`` where none sees it.

    Args:
        views: The photos that see each one.
        beyond: From ``adjacent_faces``.
        areas: Areas of the triangles, square metres.
        least_m2: Photos of smaller connected areas give way to those around them, if these see the triangles.
    """
    lists = _Lists.of(views.photo, beyond)
    none = views.photo == NONE
    grey = views.colour.mean(axis=2, dtype=np.float32)
    cost = views.cost + _odd_costs(views, lists.average(grey, SOFT_ROUNDS, None))
    cost = np.where(none, np.float32(HIDDEN), np.minimum(cost, np.float32(HIDDEN)))
    average = lists.average(cost, SMOOTH_ROUNDS, cost.max(axis=1))
    average = np.where(none, np.float32(np.inf), average)
    label = np.take_along_axis(views.photo, average.argmin(axis=1)[:, None], axis=1)[:, 0]
    energy = _Energy(lists, average, grey)
    _move_seams(energy, label, independent_groups(beyond))
    for _ in range(JOIN_ROUNDS):
        _join_small(lists, label, areas, least_m2)
    return label


def _odd_costs(views: FaceViews, soft: Float32[np.ndarray, "m k"]) -> Float32[np.ndarray, "m k"]:
    """Extra costs of photos that differ from most others."""
    known = views.photo != NONE
    weight = np.where(known, np.float32(1.0) / (views.cost + np.float32(EVEN_COST)), np.float32(0.0))
    apart = np.zeros_like(soft)
    for _ in range(2):
        odd = np.maximum(apart / np.float32(ODD_FREE), np.float32(1.0))
        weight = weight / (odd * odd)
        total, mean = np.full(len(soft), 1e-20, np.float32), np.zeros(len(soft), np.float32)
        for place in range(soft.shape[1]):  # in order: sums of the same bits everywhere
            total += weight[:, place]
            mean += weight[:, place] * soft[:, place]
        apart = np.abs(soft - (mean / total)[:, None])
    return np.float32(ODD_COST) * np.clip(apart - np.float32(ODD_FREE), 0.0, np.float32(ODD_MOST))


def _move_seams(energy: _Energy, label: Labels, groups: Sequence[Rows]) -> None:
    """Give triangles at seams the labels of neighbours where that is cheaper; changes the labels in place."""
    beyond = energy.lists.beyond
    for _ in range(SWEEPS):
        for group in groups:
            near = beyond[group]
            others = np.where(near >= 0, label[near], np.int16(NONE))
            own = label[group]
            active = ((others != own[:, None]) & (others != NONE)).any(axis=1) & (own != NONE)
            rows, others = group[active], others[active]
            best = label[rows].copy()
            least = energy.of(rows, best, label)
            for edge in range(3):
                other = others[:, edge]
                found = energy.of(rows, other, label)
                better = (other != NONE) & ((found < least) | ((found == least) & (other < best)))
                best, least = np.where(better, other, best), np.where(better, found, least)
            label[rows] = best


def same_label(label: Labels, beyond: Int32[np.ndarray, "m 3"]) -> Bool[np.ndarray, "m 3"]:
    """Edges beyond which a triangle has the same label."""
    return np.asarray((beyond >= 0) & (label[beyond] == label[:, None]))


def _join_small(lists: _Lists, label: Labels, areas: Float64[np.ndarray, " m"], least_m2: float) -> None:
    """Give triangles of small parts the label that most of their part's neighbours have; changes labels in place."""
    count, part = connected_parts(lists.beyond, same_label(label, lists.beyond))
    size = np.bincount(part, areas, count)
    small = size < least_m2
    face, edge = np.nonzero((lists.beyond >= 0) & (small[part] & (label != NONE))[:, None])
    near = lists.beyond[face, edge]
    outer = (part[near] != part[face]) & (label[near] != NONE) & (size[part[near]] > size[part[face]])
    face, near = face[outer], near[outer]
    pairs, votes = np.unique(part[face].astype(np.int64) * (1 << 16) + label[near].astype(np.int64), return_counts=True)
    target = np.full(count, NONE, np.int16)
    order = np.argsort(votes, kind="stable")  # the last one wins: most votes
    target[pairs[order] >> 16] = (pairs[order] & 0xFFFF).astype(np.int16)
    wanted = target[part]
    listed = (lists.photo == wanted[:, None]).any(axis=1) & (wanted != NONE)
    label[listed] = wanted[listed]
