"""Image overlap: the number of footprints that cover each place, as a few large shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int32

from splatpipe.pipeline.app.preflight.map_frame import WIDTH, MapFrame

CELLS = 100  # across the map
STEPS = (1, 2, 3, 5, 10)  # numbers of photos at which a new shade begins; below three, a surface is poorly determined


def count_footprints(
    frame: MapFrame, footprints: Sequence[Sequence[Sequence[float]]]
) -> Int32[np.ndarray, "rows columns"]:
    """The number of footprints that contain the centre of each cell, northern rows first.

    Args:
        frame: The map's frame.
        footprints: Corners of convex outlines, metres, in either orientation.
    """
    cell = WIDTH / CELLS
    rows = round(frame.height / cell)
    x, y = (np.arange(CELLS) + 0.5) * cell, (np.arange(rows) + 0.5) * cell
    counts = np.zeros((rows, CELLS), np.int32)
    for outline in footprints:
        corners = np.array([frame.point(place) for place in outline], np.float64)
        first, last = np.floor(corners.min(axis=0) / cell).astype(int), np.ceil(corners.max(axis=0) / cell).astype(int)
        columns = slice(max(first[0], 0), max(last[0], 0))
        lines = slice(max(first[1], 0), max(last[1], 0))
        sides = np.roll(corners, -1, axis=0) - corners
        right = x[columns][None, :, None] - corners[:, 0]
        down = y[lines][:, None, None] - corners[:, 1]
        turns = sides[:, 0] * down - sides[:, 1] * right
        counts[lines, columns] += (turns >= 0.0).all(axis=2) | (turns <= 0.0).all(axis=2)
    return counts


def shades(counts: Int32[np.ndarray, "rows columns"]) -> list[str]:
    """An SVG path for each of `STEPS`: cells with at least that many photos and fewer than the next; may be empty."""
    cell = WIDTH // CELLS
    steps = np.searchsorted(STEPS, counts, side="right")
    paths = [""] * len(STEPS)
    for row, line in enumerate(steps):
        changes = np.flatnonzero(np.diff(line)) + 1
        for begin, end in zip([0, *changes.tolist()], [*changes.tolist(), len(line)], strict=True):
            if line[begin]:
                wide = (end - begin) * cell
                paths[line[begin] - 1] += f"M{begin * cell} {row * cell}h{wide}v{cell}h-{wide}z"
    return paths
