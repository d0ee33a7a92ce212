"""Each photo's say about the heights in a cell, and which of them is the top surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.sources import DepthMap, PhotoWindow, Relief
from splatpipe.pipeline.surface.surfels import splats, surfels
from splatpipe.pipeline.surface.tiles import Tile

STEP_M = 1e-4  # heights are counted in steps of it: sums of whole numbers are the same in any order
# A key is one whole number, to be sorted: the cell, the height, how much of the cell is covered, and the confidence.
CONFIDENCE_BITS = 3
COVER_BITS = 8
HEIGHT_BITS = 27  # 13 km, of which half stays free, so that a step down from a height stays in its cell
MOST_CONFIDENT = (1 << CONFIDENCE_BITS) - 1
COVER_UNIT = 128.0  # parts of a cell that covers are counted in
SIGMA_PX = 0.7  # of a height that one photo's depths give, in pixels at a right angle to the ray
LEAST_SINE = 0.2  # of a ray's angle against the ground: flatter ones count as if they were not
SPAN = 3.0  # heights within so many of their deviations from each other are one surface
LEAST_VOTES = 2  # photos that have to agree,
LEAST_SHARE = 0.25  # and of the weight of the cell's best surface
HALF = 0.5  # of a cell that its surface covers, where there is another one below: else edges would grow outwards
LAYERS = 3  # surfaces above each other in a cell that are looked at
WEIGHT_UNIT = 256.0  # weights are whole numbers of its parts


@dataclass(frozen=True)
class Votes:
    """Heights that photos found in cells, by cell and height: a photo has one for each surface it sees there.

    Attributes:
        cell: Number of the tile's cell.
        height: Local metres.
        sigma: Its expected deviation, metres.
        weight: Whole numbers: how much it counts.
        confirmed: By how many other photos, at most.
        cover: How much of the cell it covers, in parts of ``COVER_UNIT``.
    """

    cell: Int64[np.ndarray, " n"]
    height: Float64[np.ndarray, " n"]
    sigma: Float64[np.ndarray, " n"]
    weight: Int64[np.ndarray, " n"]
    confirmed: Int64[np.ndarray, " n"]
    cover: Int64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.cell)


def photo_votes(found: DepthMap, window: PhotoWindow, lattice: Lattice, tile: Tile, relief: Relief) -> Votes:
    """What one photo's depths say about a tile's cells.

    Raises:
        ValueError: if the relief is higher than keys have room for.
    """
    if (relief.high_m - relief.low_m) / STEP_M >= 1 << (HEIGHT_BITS - 1):
        raise ValueError(f"heights from {relief.low_m} to {relief.high_m} m are too far apart")
    keys = []
    for part in splats(surfels(found, window, lattice, tile, relief), lattice, tile):
        kept = (part.height >= relief.low_m) & (part.height < relief.high_m)
        key = (part.cell[kept] << HEIGHT_BITS) | ((part.height[kept] - relief.low_m) / STEP_M).astype(np.int64)
        cover = np.clip(part.cover[kept] * COVER_UNIT, 1, (1 << COVER_BITS) - 1).astype(np.int64)
        sure = np.minimum(part.confidence[kept].astype(np.int64), MOST_CONFIDENT)
        keys.append((((key << COVER_BITS) | cover) << CONFIDENCE_BITS) | sure)
    key = np.sort(np.concatenate([np.zeros(0, np.int64), *keys]))
    return _layers(key, found.camera, lattice, tile, relief) if key.size else _none()


def _none() -> Votes:
    whole, real = np.zeros(0, np.int64), np.zeros(0)
    return Votes(whole, real, real, whole, whole, whole)


def _layers(key: Int64[np.ndarray, " n"], camera: Camera, lattice: Lattice, tile: Tile, relief: Relief) -> Votes:
    """One vote for each run of heights in a cell that no gap divides."""
    known = key & MOST_CONFIDENT
    covered = (key >> CONFIDENCE_BITS) & ((1 << COVER_BITS) - 1)
    steps = (key >> (CONFIDENCE_BITS + COVER_BITS)) & ((1 << HEIGHT_BITS) - 1)
    cell = key >> (CONFIDENCE_BITS + COVER_BITS + HEIGHT_BITS)
    place = lattice.centres(tile).reshape(-1, 2)
    sigma = _sigma(camera, place[cell], relief.low_m + steps * STEP_M)
    gap = SPAN * sigma / STEP_M
    new = np.ones(len(key), np.bool_)
    new[1:] = (cell[1:] != cell[:-1]) | (steps[1:] - steps[:-1] > gap[1:])
    first = np.flatnonzero(new)
    count = np.diff(np.append(first, len(key)))
    height = relief.low_m + (np.add.reduceat(steps, first) / count + 0.5) * STEP_M
    sure = np.maximum.reduceat(known, first)
    own = _sigma(camera, place[cell[first]], height)
    weight = np.round(WEIGHT_UNIT * (1 + np.minimum(sure, 4)) * (lattice.cell_m / own) ** 2).astype(np.int64)
    return Votes(cell[first], height, own, np.maximum(weight, 1), sure, np.add.reduceat(covered, first))


def _sigma(
    camera: Camera, place: Float64[np.ndarray, "n 2"], height: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Expected deviation of a height: of a pixel on the ground, which is longer where the ray is flat."""
    east, north, up = camera.centre()
    across = np.hypot(place[:, 0] - east, place[:, 1] - north)
    away = np.hypot(across, up - height)
    sine = np.maximum((up - height) / np.maximum(away, STEP_M), LEAST_SINE)
    return np.asarray(SIGMA_PX * away / max(camera.fx, camera.fy) / sine)


def joined(parts: Sequence[Votes], relief: Relief) -> Votes:
    """All photos' votes by cell and height."""
    columns = [
        np.concatenate([getattr(part, name) for part in (_none(), *parts)])
        for name in ("cell", "height", "sigma", "weight", "confirmed", "cover")
    ]
    order = np.argsort(_keys(columns[0], columns[1], relief), kind="stable")
    return Votes(*(column[order] for column in columns))


def _keys(cell: Int64[np.ndarray, " n"], height: Float64[np.ndarray, " n"], relief: Relief) -> Int64[np.ndarray, " n"]:
    steps = np.clip((height - relief.low_m) / STEP_M, 0, (1 << (HEIGHT_BITS - 1)) - 1).astype(np.int64) + (
        1 << (HEIGHT_BITS - 1)
    )
    return np.asarray((cell << HEIGHT_BITS) + steps)


@dataclass(frozen=True)
class Layer:
    """A surface that some cells may have, one row a cell.

    Attributes:
        height: Of its middle vote, local metres; nan where a cell has none.
        count: How many votes: photos.
        cover: How much of the cell it covers, by the mean of its votes.
    """

    height: Float64[np.ndarray, " c"]
    count: Int64[np.ndarray, " c"]
    cover: Float64[np.ndarray, " c"]


def layers(votes: Votes, cells: int, relief: Relief) -> list[Layer]:
    """The surfaces that enough photos agree on in each cell, from the top.

    Args:
        votes: By cell and height.
        cells: Of the tile.
        relief: As for the votes.
    """
    keys = _keys(votes.cell, votes.height, relief)
    reach = (SPAN * np.sqrt(2.0) * votes.sigma / STEP_M).astype(np.int64)
    numbers = np.arange(len(votes))
    bottom = np.searchsorted(keys, keys - reach, "left")
    weights, covers = (np.concatenate([[0], np.cumsum(part)]) for part in (votes.weight, votes.cover))
    support = weights[numbers + 1] - weights[bottom]
    best = np.zeros(cells, np.int64)
    np.maximum.at(best, votes.cell, support)
    enough = (numbers + 1 - bottom >= LEAST_VOTES) | (votes.confirmed >= LEAST_VOTES)
    enough &= support >= LEAST_SHARE * best[votes.cell]
    found = []
    for _ in range(LAYERS):
        top = np.full(cells, -1, np.int64)
        np.maximum.at(top, votes.cell[enough], numbers[enough])
        if (top < 0).all():
            break
        found.append(_layer(votes, top, bottom, covers))
        low = np.where(top >= 0, bottom[top], -1)
        enough &= numbers < low[votes.cell]
    return found


def _layer(
    votes: Votes,
    top: Int64[np.ndarray, " c"],
    bottom: Int64[np.ndarray, " n"],
    covers: Int64[np.ndarray, " m"],
) -> Layer:
    there = top >= 0
    first, last = np.where(there, bottom[top], 0), np.where(there, top + 1, 0)
    height = np.where(there, votes.height[np.where(there, (first + last - 1) // 2, 0)], np.nan)
    cover = (covers[last] - covers[first]) / (np.maximum(last - first, 1) * COVER_UNIT)
    return Layer(height, last - first, cover)


@dataclass(frozen=True)
class Fit:
    """Heights of cells from all votes near them.

    Attributes:
        height: Local metres; nan where there is none.
        sigma: Its expected deviation, metres.
        photos: How many agree: votes, or photos that confirm one where those are more.
    """

    height: Float64[np.ndarray, " c"]
    sigma: Float64[np.ndarray, " c"]
    photos: Int64[np.ndarray, " c"]


ROUNDS = 3  # of the robust mean: it stands still after two
BIWEIGHT = 2.5  # deviations beyond which a vote counts nothing


def fitted(votes: Votes, start: Float64[np.ndarray, " c"]) -> Fit:
    """The robust mean of each cell's votes about a height (Tukey's biweight; Beaton and Tukey 1974).

    Args:
        votes: By cell and height.
        start: A height that most votes of the surface lie near; nan where there is none.
    """
    cells, height = len(start), start.copy()
    weight = np.zeros(len(votes))
    for _ in range(ROUNDS):
        off = (votes.height - height[votes.cell]) / (BIWEIGHT * votes.sigma)
        near = np.abs(off) < 1.0  # False for nan
        weight = np.where(near, votes.weight * np.square(1.0 - np.square(np.where(near, off, 0.0))), 0.0)
        total = np.bincount(votes.cell, weight, cells)
        mean = np.bincount(votes.cell, weight * votes.height, cells)
        height = np.divide(mean, total, out=np.full(cells, np.nan), where=total > 0.0)
    share = weight / np.where(total > 0.0, total, 1.0)[votes.cell]
    off = np.where(weight > 0.0, votes.height - height[votes.cell], 0.0)
    scatter = np.bincount(votes.cell, share * np.square(off), cells)
    expected = np.bincount(votes.cell, share * np.square(votes.sigma), cells)
    effective = 1.0 / np.maximum(np.bincount(votes.cell, np.square(share), cells), 1e-9)
    sigma = np.sqrt(np.maximum(scatter, expected) / np.maximum(effective, 1.0))
    photos = np.bincount(votes.cell, weight > 0.0, cells).astype(np.int64)
    used = weight > 0.0
    np.maximum.at(photos, votes.cell[used], 1 + votes.confirmed[used])
    return Fit(height, np.where(np.isfinite(height), sigma, np.nan), photos)


def undecided(found: Sequence[Layer], least: int) -> Bool[np.ndarray, " c"]:
    """Cells with several surfaces, or with one that few photos saw: photos that look through it are to be asked."""
    first = found[0]
    few = (first.count < least) & np.isfinite(first.height)
    several = np.isfinite(found[1].height) if len(found) > 1 else np.zeros(len(few), np.bool_)
    return np.asarray(few | several)
