"""Choose the frames of a film that become photos: sharp ones, each overlapping the one before by 70 to 80 %.

The overlap of two frames is the mean, over a grid of points, of the share of the picture that a shift by the point's
motion would leave: for a flight straight on it is the shared area. Where the picture turns or warps, as in circling
about a subject that stays in its middle, the camera sees other sides of things, which match no more long before they
leave the picture: such motion counts several times. A hovering camera gives no further frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.photos.video.motion import Measures

MIN_OVERLAP, MAX_OVERLAP = 0.7, 0.8  # overlap of successive frames
MAX_BLURRED_OVERLAP = 0.9  # overlap up to which frames are accepted if all others are blurred
GRID = 5  # points along each side of a frame at which motion is evaluated
PARALLAX_WEIGHT = 2.5  # times counts what a point moves apart from the shift of all: steps of some 15° around a house
MIN_SHARPNESS_SHARE = 0.5  # sharpness over that of the sharper frames around, below which a frame is blurred
SHARPNESS_WINDOW_S = 3.0  # seconds to either side in which a frame's sharpness is compared
SHARPNESS_QUANTILE = 0.9  # quantile of the sharpness in that window that counts as sharp
BLOCK = 64  # frames that are compared at a time


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen frames.

    Attributes:
        chosen: Indices into the measures, in order.
        overlaps: Of each chosen frame with the one before; NaN across a cut.
        found: How many frames there would be without a limit.
        blurred: Chosen ones that are blurred, as all that could replace them are.
        cuts_s: When the film goes on with another picture.
    """

    chosen: Int64[np.ndarray, " m"]
    overlaps: Float64[np.ndarray, " m"]
    found: int
    blurred: Int64[np.ndarray, " b"]
    cuts_s: tuple[float, ...]


def choose(measures: Measures, most: int) -> Choice:
    """Choose frames.

    Args:
        measures: Of the film.
        most: At most so many frames; if there are more, every few are left out evenly.
    """
    cuts = np.flatnonzero(np.isnan(measures.steps[:, 0, 0]))
    blurry = measures.sharpness < MIN_SHARPNESS_SHARE * _usual(measures)
    chosen: list[int] = []
    for begin, end in zip(cuts, [*cuts[1:], len(measures)], strict=True):
        part = _Part(int(begin), measures.sharpness[begin:end], blurry[begin:end], measures.steps[begin:end])
        found = part.choose()
        if len(found) > 1 or len(cuts) == 1:  # a single frame between two cuts shows nothing in depth
            chosen += found
    all_chosen = np.array(chosen, np.int64)
    kept = all_chosen
    if len(chosen) > most:
        kept = all_chosen[np.unique(np.rint(np.linspace(0, len(chosen) - 1, most)).astype(np.int64))]
    overlaps = [float("nan"), *(_overlap_between(measures, int(a), int(b)) for a, b in pairwise(kept))]
    return Choice(
        kept,
        np.array(overlaps[: len(kept)]),
        len(chosen),
        kept[blurry[kept]],
        tuple(float(measures.times_s[cut]) for cut in cuts[1:]),
    )


def overlaps_with(maps: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, " n"]:
    """The overlap of frames with another one, by the affine maps that lead from it to them."""
    side = (np.arange(GRID) + 0.5) / GRID
    points = np.stack([*map(np.ravel, np.meshgrid(side, side)), np.ones(GRID * GRID)])
    moved = (maps @ points - points)[:, :2]
    shift = moved.mean(axis=2, keepdims=True)
    moved = shift + PARALLAX_WEIGHT * (moved - shift)
    return np.asarray(np.prod(np.clip(1.0 - np.abs(moved), 0.0, 1.0), axis=1).mean(axis=1))


def _usual(measures: Measures) -> Float64[np.ndarray, " n"]:
    """The sharpness that the sharper frames around each frame have."""
    begins = np.searchsorted(measures.times_s, measures.times_s - SHARPNESS_WINDOW_S, side="left")
    ends = np.searchsorted(measures.times_s, measures.times_s + SHARPNESS_WINDOW_S, side="right")
    return np.array(
        [
            np.quantile(measures.sharpness[a:b], SHARPNESS_QUANTILE)
            for a, b in zip(begins, np.maximum(ends, begins + 1), strict=True)
        ]
    )


def _overlap_between(measures: Measures, first: int, second: int) -> float:
    """The overlap of two frames by all steps between them; NaN across a cut."""
    total = np.eye(3)
    for step in measures.steps[first + 1 : second + 1]:
        total = step @ total
    return float("nan") if np.isnan(total).any() else float(overlaps_with(total[None])[0])


class _Part:
    """A part of a film without a cut.

    Args:
        begin: Its first frame's index.
        sharpness: Of each frame.
        blurry: Whether each is blurred.
        steps: From frame to frame; the first does not count.
    """

    def __init__(
        self,
        begin: int,
        sharpness: Float64[np.ndarray, " n"],
        blurry: np.ndarray,
        steps: Float64[np.ndarray, "n 3 3"],
    ) -> None:
        self._begin, self._sharpness, self._blurry, self._steps = begin, sharpness, blurry, steps

    def choose(self) -> list[int]:
        """The chosen frames' indices into the measures."""
        start = self._along(0)
        same = [0, *(at for at, overlap in enumerate(start, 1) if overlap >= MAX_BLURRED_OVERLAP)]
        chosen = [self._sharpest(np.array(same))]
        while (following := self._next(chosen[-1])) is not None:
            chosen.append(following)
        return [self._begin + at for at in chosen]

    def _next(self, key: int) -> int | None:
        overlaps = self._along(key)
        if len(overlaps) == 0:
            return None
        reached = overlaps[-1] < MIN_OVERLAP
        inside = len(overlaps) - 1 if reached else len(overlaps)  # the last one is past the window
        numbers = key + 1 + np.arange(inside)
        window, wider = numbers[overlaps[:inside] <= MAX_OVERLAP], numbers[overlaps[:inside] <= MAX_BLURRED_OVERLAP]
        if len(window) and not self._blurry[window].all():
            return self._sharpest(window)
        if len(wider):  # all in the window are blurred, or the film ends before it
            return self._sharpest(wider if not self._blurry[wider].all() or not len(window) else window)
        if not reached:
            return None  # the rest of the part shows nothing new
        return key + len(overlaps)  # a leap: from one frame to the next

    def _along(self, key: int) -> Float64[np.ndarray, " m"]:
        """Overlaps with a frame of those after it, up to the first below ``MIN_OVERLAP``, or to the end."""
        total: Float64[np.ndarray, "3 3"] = np.eye(3)
        found: list[Float64[np.ndarray, " k"]] = []
        for begin in range(key + 1, len(self._steps), BLOCK):
            maps = []
            for step in self._steps[begin : begin + BLOCK]:
                total = step @ total
                maps.append(total)
            overlaps = overlaps_with(np.array(maps))
            below = np.flatnonzero(overlaps < MIN_OVERLAP)
            if len(below):
                return np.concatenate([*found, overlaps[: below[0] + 1]])
            found.append(overlaps)
        return np.concatenate([np.zeros(0), *found])

    def _sharpest(self, frames: np.ndarray) -> int:
        return int(frames[np.argmax(self._sharpness[frames])])
