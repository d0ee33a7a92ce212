"""Contours of a surface model, traced window by window and joined where windows meet.

Windows share a row or column of cell centres, so a line leaves one exactly where it enters the next. Lines end where
there is no data. They are simplified within a window; points on its borders are kept, so that lines stay connected.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from contourpy import LineType, contour_generator
from jaxtyping import Float64
from rasterio.windows import Window

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.rasters.geotiff import gdal, open_raster

INDEX_EVERY = 5  # every fifth contour is drawn bold, as on maps
CELLS_PER_INTERVAL = 6.0  # 95 % of heights are within 3 cells: half an interval, as map standards require
MAX_AUTO_LEVELS = 100  # over the relief, with an automatic interval
MAX_LEVELS = 10_000  # with a given interval
MAX_VERTICES = 3_000_000  # 300 MB until they are written
WINDOW = 1024  # cells
# Largest shift of a simplified line: less than half a cell, the uncertainty of where a height applies.
TOLERANCE_CELLS = 0.3
MIN_LOOP_CELLS = 12.0  # length of a closed line: shorter ones are noise of single cells
MAX_JOIN_CELLS = 1e-6  # two windows round the same crossing differently

Line = Float64[np.ndarray, "n 2"]


@dataclass(frozen=True, eq=False)
class Contour:
    """A contour line.

    Attributes:
        height: Its height in the CRS's unit.
        is_index: Whether it is an index contour (every fifth).
        closed: Whether its last point connects to its first, which is not repeated.
        line: Eastings and northings.
    """

    height: float
    is_index: bool
    closed: bool
    line: Line


@dataclass(frozen=True, eq=False)
class Contours:
    """All contours of a surface model.

    Attributes:
        interval: Contour interval, in the CRS's unit.
        lines: Contour lines, sorted by height.
    """

    interval: float
    lines: tuple[Contour, ...]


def neat_interval(cell: float, relief: float) -> float:
    """A contour interval of 1, 2 or 5 times a power of ten that suits the heights' accuracy and limits the lines.

    Args:
        cell: Cell size, in the heights' unit.
        relief: Difference between the highest and the lowest height.
    """
    least = max(CELLS_PER_INTERVAL * cell, relief / MAX_AUTO_LEVELS)
    power = 10.0 ** math.floor(math.log10(least))
    return next(float(f"{step * power:.1g}") for step in (1, 2, 5, 10) if step * power >= least * (1.0 - 1e-9))


def trace_contours(dsm: Path, interval: float | None = None) -> Contours:
    """Trace the contours of `dsm.tif`.

    Args:
        dsm: Raster with heights in the first band.
        interval: In the heights' unit; None for an automatic one.

    Raises:
        SplatpipeError: if the interval is invalid, or so small that there are too many lines.
    """
    with gdal(dsm.parent), open_raster(dsm) as raster:
        low, high = _height_range(raster)
        if interval is None:
            interval = neat_interval(abs(raster.transform.a) * _cell_in_heights(raster), max(high - low, 0.0))
        if not (math.isfinite(interval) and interval > 0.0) or (high - low) / interval > MAX_LEVELS:
            raise SplatpipeError(
                f"Contours every {interval:g} over {high - low:g} cannot be drawn.", "Choose another interval."
            )
        joiner = _LineJoiner()
        for window in _windows(raster):
            for level, line in _pieces(raster, window, interval):
                joiner.add(level, line)
        found = joiner.lines()
        return Contours(interval, tuple(_contour(level, line, interval, raster.transform) for level, line in found))


def _cell_in_heights(raster: Any) -> float:
    """The plan unit of the CRS, in height units."""
    units = raster.crs.linear_units_factor[1] if raster.crs is not None and raster.crs.is_projected else 1.0
    heights = {"foot": 0.3048, "US survey foot": 1200.0 / 3937.0}.get(raster.units[0] or "", 1.0)
    return float(units) / heights


def _height_range(raster: Any) -> tuple[float, float]:
    low, high = math.inf, -math.inf
    for window in _windows(raster):
        heights = raster.read(1, window=window, masked=True)
        if heights.count():
            low, high = min(low, float(heights.min())), max(high, float(heights.max()))
    return (low, high) if low <= high else (0.0, 0.0)


def _windows(raster: Any) -> Iterator[Window]:
    """Windows that share their border cells, so that each square of four centres is in exactly one."""
    for row in range(0, max(raster.height - 1, 1), WINDOW):
        for column in range(0, max(raster.width - 1, 1), WINDOW):
            width, height = min(WINDOW + 1, raster.width - column), min(WINDOW + 1, raster.height - row)
            yield Window(column, row, width, height)


def _pieces(raster: Any, window: Window, interval: float) -> Iterator[tuple[int, Line]]:
    """Lines within a window, by level, in cells of the raster; closed ones end where they begin."""
    heights = raster.read(1, window=window, masked=True)
    heights = np.ma.masked_invalid(heights)
    if min(heights.shape) < 2 or not heights.count():
        return
    xs = window.col_off + 0.5 + np.arange(heights.shape[1])
    ys = window.row_off + 0.5 + np.arange(heights.shape[0])
    generator = contour_generator(xs, ys, heights, name="serial", line_type=LineType.Separate)
    least, most = math.ceil(float(heights.min()) / interval), math.floor(float(heights.max()) / interval)
    for level in range(least, most + 1):
        for line in generator.lines(level * interval):
            simple = _simplify(np.asarray(line, np.float64), np.array([window.col_off, window.row_off], np.float64))
            if len(simple) > 1:
                yield level, simple


def _simplify(line: Line, corner: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, "k 2"]:
    """Simplify by Douglas-Peucker; float32 from the window's corner is exact to 1e-4 cells, and ends stay unchanged."""
    closed = bool((line[0] == line[-1]).all())
    near = (line[:-1] if closed else line) - corner
    kept = cv2.approxPolyDP(near.astype(np.float32)[:, None], TOLERANCE_CELLS, closed)[:, 0].astype(np.float64) + corner
    if closed:
        return np.concatenate([kept, kept[:1]]) if len(kept) > 2 else kept[:0]
    kept[0], kept[-1] = line[0], line[-1]
    return np.asarray(kept)


@dataclass(eq=False)
class _Chain:
    level: int
    parts: deque[Line] = field(default_factory=deque)


_Place = tuple[int, int, int]  # level, and where in steps of MAX_JOIN_CELLS


class _LineJoiner:
    """Joins pieces into lines: a piece continues one that ends where it begins."""

    def __init__(self) -> None:
        self._begin: dict[_Place, list[_Chain]] = {}
        self._end: dict[_Place, list[_Chain]] = {}
        self._whole: list[tuple[int, Line]] = []
        self._vertices = 0

    def add(self, level: int, piece: Line) -> None:
        """Add a piece.

        Raises:
            SplatpipeError: if there are too many.
        """
        self._vertices += len(piece)
        if self._vertices > MAX_VERTICES:
            raise SplatpipeError(
                f"The contours have more than {MAX_VERTICES:,} points.", "Choose a larger interval, or larger cells."
            )
        begin, end = _place(level, piece[0]), _place(level, piece[-1])
        if begin == end:
            self._whole.append((level, piece))
            return
        chain = _pop_chain(self._end, begin)
        if chain is None:
            chain = _Chain(level)
            self._begin.setdefault(begin, []).append(chain)
        chain.parts.append(piece)
        after = _pop_chain(self._begin, end)
        if after is None:
            self._end.setdefault(end, []).append(chain)
        elif after is chain:
            self._whole.append((level, _concatenate(chain)))
        else:
            self._join(chain, after)

    def _join(self, chain: _Chain, after: _Chain) -> None:
        """Append the chain ``after`` to ``chain``, which takes over its end."""
        waiting = self._end[_place(after.level, after.parts[-1][-1])]
        waiting[waiting.index(after)] = chain
        chain.parts.extend(after.parts)

    def lines(self) -> list[tuple[int, Line]]:
        """All lines with their levels, without the smallest loops; in an order that is independent of the windows."""
        opened = [(chain.level, _concatenate(chain)) for chains in self._begin.values() for chain in chains]
        lines = [found for found in self._whole + opened if not _is_noise(found[1])]
        return sorted(lines, key=lambda found: (found[0], *found[1].min(axis=0), *found[1].max(axis=0)))


def _pop_chain(chains: dict[_Place, list[_Chain]], place: _Place) -> _Chain | None:
    waiting = chains.get(place)
    if not waiting:
        return None
    chain = waiting.pop()
    if not waiting:
        del chains[place]
    return chain


def _place(level: int, point: Float64[np.ndarray, " 2"]) -> _Place:
    return level, round(float(point[0]) / MAX_JOIN_CELLS), round(float(point[1]) / MAX_JOIN_CELLS)


def _concatenate(chain: _Chain) -> Line:
    return np.concatenate([chain.parts[0], *(part[1:] for part in list(chain.parts)[1:])])


def _is_closed(line: Line) -> bool:
    return bool(np.abs(line[0] - line[-1]).max() <= 2.0 * MAX_JOIN_CELLS)


def _is_noise(line: Line) -> bool:
    around = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    return _is_closed(line) and around < MIN_LOOP_CELLS


def _contour(level: int, line: Line, interval: float, transform: Any) -> Contour:
    closed = _is_closed(line)
    cells = line[:-1] if closed else line
    there = np.stack([transform.c + cells[:, 0] * transform.a, transform.f + cells[:, 1] * transform.e], axis=1)
    return Contour(float(f"{level * interval:.12g}"), level % INDEX_EVERY == 0, closed, there)
