"""Pair selection: pure functions of what is known about the photos before matching."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.sfm.pairing.footprints import StatedPoses, overlaps

Pair = tuple[int, int]
Costs = Callable[[int], Float64[np.ndarray, " n"]]
"""Costs of all photos as partners of photo i, lower for likelier overlap; infinite where nothing is known."""

LOCATED_SHARE = 0.8  # share of the photos that must have positions for spatial pairing
SPREAD_OVER_SIGMA = 2.0  # positions that spread less than this times their sigma say nothing about neighbours
SAME_PLACE_M = 0.1
MIN_FACING = 0.01  # minimum of cos² of half the angle between views, by which distances are divided
SEQUENCE_LENGTH = 8  # photos per folder; shorter folders do not count as sequences
MIN_OVERLAP = 0.01  # shared part of two photos' footprints; pairs with less yield one point in several hundred
MIN_PARTNERS = 6  # nearest photos that are always partners, since the stated angles may be wrong
# up component of the viewing direction: 60° down; views of walls diverge more and need more partners
OBLIQUE_UP = -0.87
OBLIQUE_PARTNER_FACTOR = 1.5  # times the partners of a nadir photo
CANDIDATES_OVER_PARTNERS = 6  # candidates per partner, nearest first: on an orbit nearer photos may look elsewhere
LOOP_SHARE = 4  # one of this many neighbours in a sequence is used for loop closure


@dataclass(frozen=True)
class Layout:
    """What is known about the photos before matching.

    Attributes:
        names: Their names, sorted.
        times: Capture times, seconds since any epoch; NaN if unknown.
        positions_m: (n, 3) east, north, up relative to any origin; NaN if unknown.
        sigmas_m: Standard deviation of each position; NaN if unknown.
        directions: (n, 3) unit viewing directions in the same axes; NaN if unknown.
        views: Stated poses, if most photos have one; otherwise None.
    """

    names: Sequence[str]
    times: Float64[np.ndarray, " n"]
    positions_m: Float64[np.ndarray, "n 3"]
    sigmas_m: Float64[np.ndarray, " n"]
    directions: Float64[np.ndarray, "n 3"]
    views: StatedPoses | None = None

    def __len__(self) -> int:
        return len(self.names)

    def located(self) -> np.ndarray:
        """Return (n,) whether each position is known."""
        return np.asarray(np.isfinite(self.positions_m).all(axis=1))


def choose_pairing(layout: Layout, exhaustive_up_to: int) -> str:
    """Resolve `auto` for these photos: ``exhaustive``, ``spatial``, ``sequential`` or ``retrieval``."""
    informative = has_informative_positions(layout)
    overlap_is_known = layout.views is not None and bool(layout.views.known().all())
    if len(layout) <= exhaustive_up_to and not (informative and overlap_is_known):
        return "exhaustive"
    if informative:
        return "spatial"
    return "sequential" if sequences(layout) else "retrieval"


def has_informative_positions(layout: Layout) -> bool:
    """Whether most photos have positions that spread wider than their noise."""
    located = layout.located()
    if np.count_nonzero(located) < LOCATED_SHARE * len(layout):
        return False
    positions = layout.positions_m[located]
    places = len(np.unique(np.round(positions / SAME_PLACE_M), axis=0))
    spread = float(np.sqrt(positions[:, :2].var(axis=0).sum()))
    return places >= len(positions) / 2 and spread > SPREAD_OVER_SIGMA * float(np.nanmedian(layout.sigmas_m[located]))


def sequences(layout: Layout) -> list[list[int]]:
    """Return each folder's photos in name order if all folders were captured in that order; otherwise nothing.

    Names are sorted naturally: ``2`` before ``10``.
    """
    folders: dict[str, list[int]] = {}
    for number, name in enumerate(layout.names):
        folders.setdefault(str(PurePosixPath(name).parent), []).append(number)
    ordered = [sorted(members, key=lambda i: _natural(layout.names[i])) for members in folders.values()]
    if any(len(members) < SEQUENCE_LENGTH for members in ordered):
        return []
    for members in ordered:
        times = layout.times[members]
        if not np.isfinite(times).all() or (np.diff(times) < 0).any() or len(np.unique(times)) < len(times) / 2:
            return []
    return ordered


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that compares runs of digits as numbers."""
    pieces = re.findall(r"([0-9]{1,18})|([^0-9]+|[0-9]+)", name)
    return [(0, int(digits), "") if digits else (1, 0, other) for digits, other in pieces]


def select_pairs(layout: Layout, pairing: str, neighbours: int, look_alike: Callable[[], Costs]) -> list[Pair]:
    """Choose the pairs to match, so that they connect all photos.

    Args:
        layout: What is known about the photos.
        pairing: ``exhaustive``, ``spatial``, ``sequential`` or ``retrieval``.
        neighbours: Partners chosen for each photo.
        look_alike: Computes costs from the photos' content; called only if needed.

    Returns:
        Sorted pairs (i, j), i < j, each once.

    Raises:
        SplatpipeError: If the pairing is ``spatial`` and the photos have no positions.
    """
    count = len(layout)
    if pairing == "exhaustive":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    if pairing == "spatial":
        return _spatial(layout, neighbours, look_alike)
    costs = look_alike()
    if pairing == "retrieval":
        return connect(nearest(range(count), costs, neighbours), count, costs)
    ordered = sequences(layout) or [sorted(range(count), key=lambda i: _natural(layout.names[i]))]
    pairs = {
        _pair(members[at], later)
        for members in ordered
        for at in range(len(members))
        for later in members[at + 1 : at + 1 + max(1, neighbours // 2)]
    }
    loops = nearest(range(count), _without(costs, pairs), max(1, neighbours // LOOP_SHARE))
    return connect(pairs | loops, count, costs)


def _spatial(layout: Layout, neighbours: int, look_alike: Callable[[], Costs]) -> list[Pair]:
    located = layout.located()
    if np.count_nonzero(located) < 2:
        raise SplatpipeError(
            "matches.pairing=spatial needs photos with positions, and these have none.",
            hint="Set matches.pairing=auto.",
        )
    costs = spatial_costs(layout)
    known = layout.views.known() if layout.views is not None else np.zeros_like(located)
    pairs = nearest(np.flatnonzero(located & ~known).tolist(), costs, neighbours)
    if layout.views is not None:
        pairs |= nearest(np.flatnonzero(known).tolist(), costs, MIN_PARTNERS) | _overlapping(layout.views, neighbours)
    if located.all():
        return connect(pairs, len(layout), costs)
    alike = look_alike()
    pairs |= nearest(np.flatnonzero(~located).tolist(), alike, neighbours)
    return connect(pairs, len(layout), alike)


def _overlapping(views: StatedPoses, neighbours: int) -> set[Pair]:
    """Pair each photo with those whose footprints overlap its own most; views of walls get more partners."""
    wide = math.ceil(OBLIQUE_PARTNER_FACTOR * neighbours)
    partners: dict[int, list[tuple[float, Pair]]] = {}
    for pair, share in overlaps(views, CANDIDATES_OVER_PARTNERS * wide).items():
        if share >= MIN_OVERLAP:
            for photo in pair:
                partners.setdefault(photo, []).append((-share, pair))
    tilted = views.axes[:, 2] > OBLIQUE_UP
    return {
        pair
        for photo, candidates in partners.items()
        for _, pair in sorted(candidates)[: wide if tilted[photo] else neighbours]
    }


def spatial_costs(layout: Layout) -> Costs:
    """Return costs from the distance between two photos divided by cos² of half the angle between their views.

    A typical spacing is added to the distance, so that opposite views from one place are not neighbours either.
    """
    known = layout.positions_m[layout.located()]
    spacing = float(np.sqrt(known.var(axis=0).sum() / len(known)))

    def costs(i: int) -> Float64[np.ndarray, " n"]:
        distances = np.sqrt(((layout.positions_m - layout.positions_m[i]) ** 2).sum(axis=1))
        facing = (1.0 + (layout.directions * layout.directions[i]).sum(axis=1)) / 2.0
        facing = np.where(np.isfinite(facing), facing, 1.0)
        return np.asarray(np.nan_to_num((distances + spacing) / np.maximum(facing, MIN_FACING), nan=np.inf))

    return costs


def _without(costs: Costs, pairs: set[Pair]) -> Costs:
    partners: dict[int, list[int]] = {}
    for i, j in pairs:
        partners.setdefault(i, []).append(j)
        partners.setdefault(j, []).append(i)

    def others(i: int) -> Float64[np.ndarray, " n"]:
        row = costs(i).copy()
        row[partners.get(i, [])] = np.inf
        return row

    return others


def nearest(photos: Iterable[int], costs: Costs, neighbours: int) -> set[Pair]:
    """Pair each of the photos with its cheapest partners; ties are broken by photo order."""
    pairs: set[Pair] = set()
    for i in photos:
        row = costs(i).copy()
        row[i] = np.inf
        for j in np.argsort(row, kind="stable")[:neighbours].tolist():
            if np.isfinite(row[j]):
                pairs.add(_pair(i, j))
    return pairs


def connect(pairs: set[Pair], count: int, costs: Costs) -> list[Pair]:
    """Add the cheapest pairs that connect the graph of photos (Borůvka's algorithm).

    Args:
        pairs: The pairs chosen so far.
        count: Number of photos.
        costs: Costs of all pairs; infinite ones are used only if there are no others.

    Returns:
        All pairs, sorted.
    """
    pairs = set(pairs)
    while True:
        labels = components(pairs, count)
        if labels.max(initial=0) == 0:
            return sorted(pairs)
        best: dict[int, tuple[float, Pair]] = {}
        for i in range(count):
            row = np.where(labels == labels[i], np.inf, np.minimum(costs(i), np.finfo(np.float64).max))
            j = int(row.argmin())
            candidate = float(row[j]), _pair(i, j)
            best[int(labels[i])] = min(best.get(int(labels[i]), candidate), candidate)
        pairs |= {pair for _, pair in best.values()}


def components(pairs: Iterable[Pair], count: int) -> np.ndarray:
    """Return (count,) the connected component of each photo; components are numbered by their first photo."""
    rows = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(rows), np.bool_), (rows[:, 0], rows[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _pair(i: int, j: int) -> Pair:
    return (i, j) if i < j else (j, i)
