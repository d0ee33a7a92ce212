"""What a check finds of photos in a grid."""

import time
from dataclasses import replace
from pathlib import Path

from splatpipe.pipeline.app.preflight.findings import (
    MachineFacts,
    MatchedPair,
    PhotoFacts,
    Preflight,
)

STEP_M, REACH_M = 10.0, 14.0  # between the photos of the grid, and from a photo to the sides of its footprint


def grid(folder: Path, names: list[str], columns: int = 6, **facts: object) -> Preflight:
    """Photos in a grid, each matched with the next; the last matches no other."""
    photos = []
    for i, name in enumerate(names):
        east, north = STEP_M * (i % columns), STEP_M * (i // columns)
        corners = [(east + x * REACH_M, north + y * REACH_M) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        time_of = f"2026-06-18T13:{i // 60 % 60:02}:{i % 60:02}"
        photos.append(
            PhotoFacts(name, 1200, 900, 1, 0, time_of, (east, north, 40.0), tuple(corners), 1.0, 0.0, 120.0, 2)
        )
    last = len(photos) - 1
    pairs = tuple(MatchedPair(i, i + 1, 20 + i) for i in range(last - 1))
    machine = MachineFacts(8_000_000_000, 2, 81_000_000_000)
    pieces = (tuple(range(last)), (last,))
    made = Preflight(folder, tuple(photos), (), (), (52.0, 13.0), pairs, pieces, (), (), (), machine, time.time(), 21.3)
    return replace(made, **facts)
