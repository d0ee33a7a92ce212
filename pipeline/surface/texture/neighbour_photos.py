"""Photos of few triangles give way to those of their neighbours, which may not be among the triangles' best.

A photo's depths have holes, and each triangle knows only its best photos. So small parts remain whose neighbours show a
photo that sees them nearly as well. Here such a photo is asked: it is taken if it sees a triangle, or has no depth
there but much the same colour, and does not cost much more. Each border that goes saves seams, room and files' size.

A triangle that no photo is known to see takes a neighbour's photo unless that photo's depths say that something else is
there: the surface goes on a little where depths end.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, Int16, Int32, Int64

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.depths.photo_samples import load_pixels
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet
from splatpipe.pipeline.surface.texture.face_choice import Labels, same_label
from splatpipe.pipeline.surface.texture.face_graph import connected_parts
from splatpipe.pipeline.surface.texture.face_views import HIDDEN, NONE, FaceSamples, FaceViews, rate_rows

ROUNDS = 3  # in which triangles ask again, and so how many in a row go on from where depths end
MORE_COST = 600.0  # that a neighbour's photo may cost more: some pixels half as wide again, or 35 degrees more oblique
ALIKE = 20.0  # difference of colours, grey levels, up to which a photo without a depth there is believed

Rows = Int64[np.ndarray, " r"]


@dataclass(frozen=True, eq=False)
class FaceNeighbours:
    """The graph of a mesh's triangles.

    Attributes:
        beyond: From ``adjacent_faces``.
        areas: Areas of the triangles, square metres.
        least_m2: Parts of smaller areas are small.
    """

    beyond: Int32[np.ndarray, "m 3"]
    areas: Float64[np.ndarray, " m"]
    least_m2: float


@dataclass(frozen=True, eq=False)
class _Offers:
    """Photos that are offered to triangles of small parts."""

    rows: Rows
    photo: Int16[np.ndarray, " r"]


class NeighbourPhotos:
    """Asks neighbours' photos about triangles.

    Args:
        photos: Photos with depths and gains.
        faces: The triangles' samples.
        views: The photos that see each triangle; adopted ones are put into its lists in place.
        cell_m: Resolution that photos are to have on them, metres.
        threads: Photos in parallel.
    """

    def __init__(self, photos: PhotoSet, faces: FaceSamples, views: FaceViews, cell_m: float, threads: int) -> None:
        self._photos, self._faces, self._views = photos, faces, views
        self._cell_m, self._threads = cell_m, threads
        self._place = np.empty(len(faces.order), np.int64)  # of each triangle in the samples' order
        self._place[faces.order] = np.arange(len(faces.order))

    def join(self, label: Labels, graph: FaceNeighbours) -> None:
        """Give triangles of small parts, and without a photo, labels of their neighbours; changes them in place."""
        refused = np.zeros(0, np.int64)
        for _ in range(ROUNDS):
            offers = _offers(label, graph, refused)
            if not offers.rows.size:
                return
            taken = self._ask(offers, label)
            self._adopt(offers, taken, label)
            refused = np.union1d(refused, _keys(offers.rows[~taken], offers.photo[~taken]))

    def _ask(self, offers: _Offers, label: Labels) -> Bool[np.ndarray, " r"]:
        taken = np.zeros(len(offers.rows), np.bool_)
        numbers = np.unique(offers.photo).tolist()
        asked = [np.flatnonzero(offers.photo == number) for number in numbers]
        answer = partial(self._answer, offers, label)
        for which, found in zip(
            asked, ordered_map(answer, list(zip(numbers, asked, strict=True)), self._threads), strict=True
        ):
            taken[which] = found
        return taken

    def _answer(self, offers: _Offers, label: Labels, question: tuple[int, Rows]) -> Bool[np.ndarray, " k"]:
        """Whether a photo sees triangles nearly as well as their own photo does, if they have one."""
        number, which = question
        rows = offers.rows[which]
        bare = label[rows] == NONE
        own = self._views.photo[rows] == label[rows][:, None]
        at = own.argmax(axis=1)[:, None]
        cost = np.take_along_axis(self._views.cost[rows], at, axis=1)[:, 0]
        colour = np.take_along_axis(self._views.colour[rows], at[..., None], axis=1)[:, 0]
        place = self._place[rows]
        order = np.argsort(place, kind="stable")
        rating = rate_rows(self._photos, self._faces, self._cell_m, number, place[order])
        back = np.empty(len(order), np.int64)
        back[order] = np.arange(len(order))
        theirs, seen = rating.cost[back].astype(np.float64), rating.seen[back]
        cheap = (theirs < HIDDEN) & (theirs <= cost + MORE_COST)
        alike = cheap & ~seen & ~bare
        alike[alike] = (
            np.abs(self._colours(number, place[alike]) - colour[alike].astype(np.float64)).mean(axis=1) <= ALIKE
        )
        return np.asarray(cheap & (seen | alike | bare))

    def _colours(self, number: int, place: Rows) -> Float64[np.ndarray, "k 3"]:
        """Levelled mean colours of triangles in a photo."""
        if not place.size:
            return np.zeros((0, 3))
        source = self._photos.sources[number]
        pixels, _ = load_pixels(source)
        every = np.ones(len(place), np.bool_)
        total = np.zeros((len(place), 3))
        for points in self._faces.points:
            east, north, up = points[:, place]
            total += self._photos.levels.sample(number, (source, pixels), (east, north, up), every, self._cell_m)
        return total / len(self._faces.points)

    def _adopt(self, offers: _Offers, taken: Bool[np.ndarray, " r"], label: Labels) -> None:
        """Take photos over, in the lists in place of those that they replace."""
        rows, photo = offers.rows[taken], offers.photo[taken]
        known = (self._views.photo[rows] == photo[:, None]).any(axis=1)
        at = (self._views.photo[rows] == label[rows][:, None]).argmax(axis=1)
        self._views.photo[rows[~known], at[~known]] = photo[~known]
        label[rows] = photo


def _offers(label: Labels, graph: FaceNeighbours, refused: Int64[np.ndarray, " k"]) -> _Offers:
    """For each triangle of a small part the photo that most of the part's larger neighbours have.

    A triangle without a photo is a part of its own, smaller than all others.
    """
    bare = label == NONE
    count, part = connected_parts(graph.beyond, same_label(label, graph.beyond) & ~bare[:, None])
    size = np.bincount(part, np.where(bare, 0.0, graph.areas), count)
    small = (size < graph.least_m2)[part]
    face, edge = np.nonzero((graph.beyond >= 0) & small[:, None])
    near = graph.beyond[face, edge]
    outer = (part[near] != part[face]) & (label[near] != NONE) & (size[part[near]] > size[part[face]])
    face, near = face[outer], near[outer]
    fresh = ~np.isin(_keys(face, label[near]), refused)
    face, near = face[fresh], near[fresh]
    pairs, votes = np.unique(part[face].astype(np.int64) * (1 << 16) + label[near].astype(np.int64), return_counts=True)
    target = np.full(count, NONE, np.int16)
    order = np.argsort(votes, kind="stable")  # the last one wins: most votes
    target[pairs[order] >> 16] = (pairs[order] & 0xFFFF).astype(np.int16)
    rows = np.flatnonzero(small & (target[part] != NONE))
    rows = rows[~np.isin(_keys(rows, target[part[rows]]), refused)]
    return _Offers(rows, target[part[rows]])


def _keys(rows: Rows, photo: Int16[np.ndarray, " r"]) -> Int64[np.ndarray, " r"]:
    return np.asarray(rows.astype(np.int64) * (1 << 16) + photo.astype(np.int64))
