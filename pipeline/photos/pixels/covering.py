"""Chooses photos that show the whole scene where a stage need not look at all of them."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

# least share of the points that the chosen photos show; the rest, only one or two photos show at all
MIN_COVERED_SHARE = 0.9


def covering_photos(seen: Sequence[Int64[np.ndarray, " _"]], points: int, few: int) -> list[int]:
    """Choose photos that show the scene: √(few n) of n, and more until they show nine tenths of its points.

    The more photos there are, the more of what one shows others show, too.

    One after the other, the photo is chosen whose points the chosen ones show least: a point that k of them show counts
    1 / (1 + k)², so that most points are shown by several. Among equals, the first is chosen.

    Args:
        seen: For each photo the rows of the points that it shows, ascending.
        points: Number of points.
        few: Number of photos up to which all are chosen.

    Returns:
        Indices of the chosen photos, ascending.
    """
    view_counts = np.zeros(points, np.int64)
    needed = MIN_COVERED_SHARE * np.unique(np.concatenate([*seen, np.zeros(0, np.int64)])).size
    least = math.ceil(math.sqrt(min(len(seen), few) * len(seen)))

    def gain(photo: int) -> float:
        return float((1.0 / np.square(1.0 + view_counts[seen[photo]])).sum())

    chosen: list[int] = []
    heap = [(-gain(photo), photo) for photo in range(len(seen))]
    heapq.heapify(heap)
    while heap and (len(chosen) < least or np.count_nonzero(view_counts) < needed):
        before, photo = heap[0]
        now = -gain(photo)
        if now != before:  # gains only fall, so one that is still the best was the best all along
            heapq.heapreplace(heap, (now, photo))
            continue
        heapq.heappop(heap)
        chosen.append(photo)
        view_counts[seen[photo]] += 1
    return sorted(chosen)
