"""Walls of buildings, as vertical planes from corner to corner and from the ground to the eaves.

Walls are detected where vertical facets lie in one plane, starting with the strongest evidence, and end where they meet
the plane of another wall; low, short and uneven ones are dropped: fences, cars, hedges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.surface.facades.facets import Facets
from splatpipe.pipeline.survey.boundary import DIRECTIONS

SEED_M, SEED_SECTORS = 1.0, 24  # bins of plan and of direction whose facets seed the search for walls
SEED_M2 = 2.0  # least area of a seed's facets, of all photos together
SEED_HEIGHT_M = 1.2  # least height of the facets in a seed's plane; half a wall's
NORMAL_COSINE = math.cos(math.radians(30.0))  # between a facet's and its wall's normal: three times a facet's noise
REACHES_M = (1.5, 4.0, 12.0, 40.0, 1e6)  # lengths to which a wall grows step by step, each with a new fit of its plane
BAND_M = 0.12  # on either side of a plane: includes plinths and shutters, but not window panes
BAND_PIXELS = 4.0  # least half width of the band, in pixels on the wall, for coarse depths
CLAIM_BANDS = 4.0  # about a wall, within which no other wall is searched for...
CLAIM_COSINE = 0.5  # ...in nearly the same direction: noise turns some of its own facets by more than ``NORMAL_COSINE``
BIN_M = 0.5  # along a wall
GAP_M = 3.0  # between pieces of one wall: a tree in front of it, a gate
CELL_M = 0.25  # side of a cell of a wall's face, occupied if it has three facets
CELL_FACETS = 3
BRIDGED_CELLS = 5  # openings up to this size are bridged
# Least size of a wall that meets others: garden walls are lower.
MIN_HEIGHT_M, MIN_LENGTH_M, MIN_AREA_M2 = 2.1, 2.0, 6.0
FREE_HEIGHT_M = 2.8  # least height of a wall that meets no other: vans are lower
LOW_WALL_BAND_SHARE = 0.22  # share of the band in which half of a low wall's facets have to lie: on the demo, half
# lie within 0.04 for low walls, 0.18 for walls with a plinth, and 0.3 to 0.4 for hedges clipped as high as garages
MIN_BAND_SHARE = 0.6  # share of the facets around a wall's plane within its band: in hedges and trees they scatter
CORNER_M = 0.4  # from where a wall's facets end to the plane of the next one, at most: two facets
CORNER_COSINE = math.cos(math.radians(30.0))  # planes that meet at less than this angle make no corner
TOP_M = 0.4  # above the last facets, which end two of them below the eaves
MIN_END_HEIGHT_SHARE = 0.4  # height seen at a wall's end over its usual height: anything lower is a bush or a fence
ROUNDS = 5  # iterations of a plane's robust fit

Plan = Float64[np.ndarray, " 2"]


@dataclass(frozen=True, eq=False)
class Wall:
    """An upright plane with its extent, in local metres.

    Attributes:
        name: The direction it faces, numbered from the second on: ``south``, ``south-2``.
        left: East and north of its left end, as seen from in front of it.
        right: East and north of its right end.
        low_m: Height of its foot.
        high_m: Height of its top.
    """

    name: str
    left: Plan
    right: Plan
    low_m: float
    high_m: float

    @property
    def length_m(self) -> float:
        """Length from end to end, metres."""
        return float(np.linalg.norm(self.right - self.left))

    @property
    def along(self) -> Plan:
        """Unit vector from left to right, in plan."""
        return np.asarray((self.right - self.left) / self.length_m)

    @property
    def facing(self) -> Plan:
        """Unit vector towards the viewer, in plan."""
        along = self.along
        return np.array([along[1], -along[0]])

    @property
    def area_m2(self) -> float:
        """Area of its rectangle, square metres."""
        return self.length_m * (self.high_m - self.low_m)


@dataclass(frozen=True, eq=False)
class _Line:
    """A vertical plane in plan: points p with ``facing @ p == offset``."""

    facing: Plan
    offset: float

    @property
    def along(self) -> Plan:
        return np.array([-self.facing[1], self.facing[0]])

    def off(self, facets: Facets) -> Float64[np.ndarray, " n"]:
        return np.asarray(facets.places[:, :2] @ self.facing - self.offset)

    def at(self, along_m: float) -> Plan:
        return np.asarray(self.along * along_m + self.facing * self.offset)


@dataclass(frozen=True, eq=False)
class _Piece:
    """A plane with the extent of a wall in it: its ends along the plane, and its heights."""

    line: _Line
    ends: tuple[float, float]
    heights: tuple[float, float]

    def crossing(self, other: _Piece) -> float | None:
        """Position along this wall where the other's plane crosses it; None if the other does not reach near it."""
        if abs(float(self.line.facing @ other.line.facing)) > CORNER_COSINE:
            return None
        if self.heights[1] < other.heights[0] or other.heights[1] < self.heights[0]:
            return None
        matrix = np.stack([self.line.facing, other.line.facing])
        place = np.linalg.solve(matrix, np.array([self.line.offset, other.line.offset]))
        theirs = float(other.line.along @ place)
        if not other.ends[0] - CORNER_M <= theirs <= other.ends[1] + CORNER_M:
            return None
        return float(self.line.along @ place)


def find_walls(facets: Facets) -> list[Wall]:
    """Detect walls in the facets of all photos; sorted by size within each direction."""
    if not len(facets):
        return []
    band_m = _band(facets)
    cells = np.floor(facets.places[:, :2] / SEED_M).astype(np.int64)
    turn = np.arctan2(facets.facing[:, 1], facets.facing[:, 0]) / (2.0 * math.pi) * SEED_SECTORS
    sectors = np.floor(turn).astype(np.int64) % SEED_SECTORS
    _, seeds = np.unique(np.column_stack([cells, sectors]), axis=0, return_inverse=True)
    seeds = seeds.reshape(-1)
    free = np.ones(len(facets), np.bool_)
    pieces = []
    while True:
        weights = np.bincount(seeds[free], facets.areas[free], seeds.max() + 1)
        strongest = int(np.argmax(weights))
        if weights[strongest] < SEED_M2:
            break
        start = free & (seeds == strongest)
        grown = _grow_plane(facets, free, start, band_m)
        if grown is not None:
            line, ends = grown
            piece = _piece(facets, line, ends, band_m)
            if piece is not None:
                pieces.append(piece)
                free &= ~_around(facets, line, ends, CLAIM_BANDS * band_m, CLAIM_COSINE)
            else:
                free &= ~_around(facets, line, ends, band_m)
        free &= ~start
    return name_walls([_wall(piece) for piece in _join_corners(pieces)])


def _band(facets: Facets) -> float:
    """Half width of the band of a plane's facets, metres: wider for coarse pixels."""
    return max(BAND_M, BAND_PIXELS * float(np.median(facets.pixels_m)))


def name_walls(walls: Sequence[Wall]) -> list[Wall]:
    """Name walls by the direction that they face, numbered by size within a direction, the largest first."""
    counts: dict[str, int] = {}
    result = []
    for wall in sorted(walls, key=lambda wall: -wall.area_m2):
        turn = math.atan2(wall.facing[1], wall.facing[0]) / (math.pi / 4.0)
        direction = DIRECTIONS[round(turn) % 8]
        counts[direction] = counts.get(direction, 0) + 1
        number = counts[direction]
        result.append(replace(wall, name=direction if number == 1 else f"{direction}-{number}"))
    return result


def stated_wall(left: Plan, right: Plan, facets: Facets) -> Wall | None:
    """A wall in a given plane, with the heights of the facets near it; None if there are none.

    Args:
        left: East and north of its left end, as seen from in front of it.
        right: East and north of its right end, different from the left one.
        facets: Facets of all photos.
    """
    wall = Wall("", left, right, 0.0, 0.0)
    line = _Line(wall.facing, float(wall.facing @ left))
    face = _face(facets, line, (float(line.along @ left), float(line.along @ right)), CLAIM_BANDS * BAND_M)
    if face is None:
        return None
    low, high = _foot_and_top(face.heights)
    return replace(wall, low_m=low, high_m=high)


def _grow_plane(
    facets: Facets, free: Bool[np.ndarray, " n"], start: Bool[np.ndarray, " n"], band_m: float
) -> tuple[_Line, tuple[float, float]] | None:
    """Grow a plane from starting facets; returns it with its two ends, or None if it is not a wall."""
    rows = np.flatnonzero(start)
    line = _fit_plane(facets.select(rows), None, 2.0 * band_m)
    if line is None:
        return None
    middle = float(np.average(facets.places[rows, :2] @ line.along, weights=facets.areas[rows]))
    ends = (middle, middle)
    for reach in REACHES_M:
        rows = np.flatnonzero(free)
        near = _near(facets.select(rows), line, band_m)
        along = facets.places[rows, :2] @ line.along
        rows = rows[near & (np.abs(along - middle) < reach)]
        run = _run_around(facets.places[rows, :2] @ line.along, middle)
        if run is None:
            return None
        ends = run
        if np.ptp(facets.places[rows, 2]) < SEED_HEIGHT_M:
            return None  # early, as most seeds belong to low objects
        along = facets.places[rows, :2] @ line.along
        found = _fit_plane(facets.select(rows[(along >= ends[0]) & (along <= ends[1])]), line, band_m)
        if found is None:
            return None
        line = found
        middle = float(np.clip(middle, *ends))
    return line, ends


def _near(facets: Facets, line: _Line, band_m: float, cosine: float = NORMAL_COSINE) -> Bool[np.ndarray, " n"]:
    return np.asarray((np.abs(line.off(facets)) < band_m) & (facets.facing @ line.facing > cosine))


def _around(
    facets: Facets, line: _Line, ends: tuple[float, float], band_m: float, cosine: float = NORMAL_COSINE
) -> Bool[np.ndarray, " n"]:
    along = facets.places[:, :2] @ line.along
    return np.asarray(_near(facets, line, band_m, cosine) & (along >= ends[0]) & (along <= ends[1]))


def _run_around(along: Float64[np.ndarray, " n"], middle: float) -> tuple[float, float] | None:
    """Start and end of the run of positions without a gap around a position; None if there is none."""
    if not len(along):
        return None
    there = np.unique(np.floor(along / BIN_M).astype(np.int64))
    runs = np.split(there, np.flatnonzero(np.diff(there) > 1 + GAP_M / BIN_M) + 1)
    nearest = min(runs, key=lambda run: max(run[0] - middle / BIN_M, middle / BIN_M - run[-1] - 1, 0.0))
    return float(nearest[0] * BIN_M), float((nearest[-1] + 1) * BIN_M)


def _fit_plane(facets: Facets, start: _Line | None, band_m: float) -> _Line | None:
    """Fit a vertical plane to facets: robust least squares in plan (Tukey's biweight); None if there are too few.

    Args:
        facets: Facets near the plane.
        start: Initial plane; None starts from the facets' mean direction.
        band_m: Distance from which a facet has weight zero.
    """
    if len(facets) < CELL_FACETS:
        return None
    facing = np.average(facets.facing, axis=0, weights=facets.areas) if start is None else start.facing
    facing = facing / max(float(np.linalg.norm(facing)), 1e-9)
    line = start or _Line(facing, float(np.median(facets.places[:, :2] @ facing)))
    plan = facets.places[:, :2]
    for _ in range(ROUNDS):
        weight = facets.areas * np.square(np.maximum(1.0 - np.square(line.off(facets) / band_m), 0.0))
        if not weight.sum() > 0.0:
            return None
        middle = np.average(plan, axis=0, weights=weight)
        _, axes = np.linalg.eigh((weight[:, None] * (plan - middle)).T @ (plan - middle))
        facing = axes[:, 0] * (1.0 if axes[:, 0] @ line.facing >= 0.0 else -1.0)
        line = _Line(facing, float(facing @ middle))
    return line


@dataclass(frozen=True)
class _Face:
    """The extent of a plane's facets: ends, heights, and area in square metres."""

    ends: tuple[float, float]
    heights: tuple[float, float]
    area_m2: float


def _face(facets: Facets, line: _Line, ends: tuple[float, float], band_m: float) -> _Face | None:
    """The largest connected part of a plane that facets cover."""
    some = facets.select(_around(facets, line, ends, band_m))
    if not len(some):
        return None
    along, up = some.places[:, :2] @ line.along, some.places[:, 2]
    column = np.floor((along - ends[0]) / CELL_M).astype(np.int64)
    row = np.floor((up - up.min()) / CELL_M).astype(np.int64)
    count = np.zeros((row.max() + 1, column.max() + 1), np.int64)
    np.add.at(count, (row, column), 1)
    parts = _connected(count >= CELL_FACETS)
    inner = parts[row, column]
    sizes = np.bincount(parts[(count >= CELL_FACETS) & (parts > 0)], minlength=2)
    best = int(np.argmax(sizes))
    if sizes[best] == 0:
        return None
    kept = (inner == best) & (count[row, column] >= CELL_FACETS)
    half = np.sqrt(some.areas) / 2.0
    tall = ((count >= CELL_FACETS) & (parts == best)).sum(axis=0)
    high = kept & (tall[column] >= MIN_END_HEIGHT_SHARE * np.median(tall[tall > 0]))
    reached = (float((along - half)[high].min()), float((along + half)[high].max()))
    heights = (float((up - half)[kept].min()), float((up + half)[kept].max()))
    return _Face(reached, heights, float(sizes[best]) * CELL_M**2)


def _connected(there: Bool[np.ndarray, "h w"]) -> Int64[np.ndarray, "h w"]:
    """Labels of connected parts, with openings and gaps bridged; 0 where there is nothing."""
    across = 2 * round(GAP_M / CELL_M / 2.0) + 1
    wide = np.pad(there.astype(np.uint8), ((BRIDGED_CELLS, BRIDGED_CELLS), (across, across)))
    wide = np.asarray(cv2.morphologyEx(wide, cv2.MORPH_CLOSE, np.ones((BRIDGED_CELLS, across), np.uint8)))
    parts = np.asarray(cv2.connectedComponents(wide, connectivity=8)[1])
    return parts[BRIDGED_CELLS : len(parts) - BRIDGED_CELLS, across:-across].astype(np.int64)


def _piece(facets: Facets, line: _Line, ends: tuple[float, float], band_m: float) -> _Piece | None:
    """The part of a plane that is a wall; None if it is too low, too short, too small or too uneven."""
    face = _face(facets, line, ends, band_m)
    if face is None or face.area_m2 < MIN_AREA_M2:
        return None
    if face.heights[1] - face.heights[0] < MIN_HEIGHT_M or face.ends[1] - face.ends[0] < MIN_LENGTH_M:
        return None
    around = facets.areas[_around(facets, line, face.ends, CLAIM_BANDS * band_m)].sum()
    flat = facets.select(_around(facets, line, face.ends, band_m))
    is_low = face.heights[1] - face.heights[0] < FREE_HEIGHT_M
    if is_low and np.median(np.abs(line.off(flat))) > LOW_WALL_BAND_SHARE * band_m:
        return None
    return _Piece(line, face.ends, face.heights) if flat.areas.sum() >= MIN_BAND_SHARE * around else None


def _join_corners(pieces: Sequence[_Piece]) -> list[_Piece]:
    """Extend or trim the walls' ends to the planes of walls that they meet; drops low walls that meet none."""
    result = []
    for piece in pieces:
        met = [place for other in pieces if other is not piece and (place := piece.crossing(other)) is not None]
        ends = []
        for end in piece.ends:
            near = min(((abs(place - end), place) for place in met), default=(math.inf, end))
            ends.append(near[1] if near[0] <= CORNER_M else end)
        if (ends[0], ends[1]) != piece.ends or piece.heights[1] - piece.heights[0] >= FREE_HEIGHT_M:
            result.append(replace(piece, ends=(ends[0], ends[1])))
    return result


def _wall(piece: _Piece) -> Wall:
    left, right = (piece.line.at(end) for end in piece.ends)
    return Wall("", left, right, *_foot_and_top(piece.heights))


def _foot_and_top(heights: tuple[float, float]) -> tuple[float, float]:
    """Foot and top of a wall, from the heights of its facets."""
    return heights[0], heights[1] + TOP_M
