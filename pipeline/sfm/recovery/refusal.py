"""Why photos could not be placed: the reason that the keypoints and matches give, and what to do about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.pairing.pairs import components

FEW_KEYPOINTS = 200  # per photo, median; a drone's photo has thousands, and a thermal one some dozens
THERMAL_SIZES = ((160, 120), (320, 240), (320, 256), (336, 256), (640, 480), (640, 512), (1280, 1024))
OVERLAP = "Photos must overlap by two thirds and be taken from different positions."
TEXTURE = "Check that they are sharp and well exposed, and that masks leave enough of each photo."
THERMAL = (
    "They have the size of a thermal camera's photos, which rarely show enough: run on the colour photos that were"
    " taken with them, whose cameras are those of the flight."
)


def little_texture(counts: Iterable[int]) -> bool:
    """Whether most photos have hardly enough keypoints to be matched."""
    return float(np.median(list(counts))) < FEW_KEYPOINTS


def texture_hint(sizes: Iterable[tuple[int, int]]) -> str:
    """What to do about photos without texture.

    Args:
        sizes: Width and height of the photos, or of their cameras, pixels.
    """
    common = Counter((max(size), min(size)) for size in sizes).most_common(1)
    return THERMAL if common and common[0][0] in THERMAL_SIZES else TEXTURE


def refusal(placed: int, least: int, verified: ViewGraph, tried: int) -> SplatpipeError:
    """The error for a capture of which too few photos could be placed.

    Args:
        placed: Number of photos placed.
        least: Number of photos that a model needs, `sparse.min_model_size`.
        verified: The view graph.
        tried: Number of pairs that were matched.
    """
    total = len(verified.names)
    said = f"Only {placed} of {total} photos could be placed" if placed else f"None of {total} photos could be placed"
    counts = [len(found) for found in verified.keypoints.values()]
    if little_texture(counts):
        text = f"{said}: they have too little texture, {np.median(counts):.0f} keypoints a photo (median)."
        return SplatpipeError(text, hint=texture_hint((c.width, c.height) for c in verified.cameras.values()))
    together, inliers = _largest_group(verified)
    if total < least or (together >= 2 and together < least):
        which = f"{total} are" if total < least else f"only {together} show the same place, which is"
        hint = f"These match each other ({inliers:,} matches). " if together >= 2 else ""
        return SplatpipeError(
            f"{said}: {which} too few, as a model needs {least} photos (sparse.min_model_size).",
            hint=f"{hint}Add photos that overlap with them by two thirds, taken from other positions.",
        )
    more = "Add overlap" + (", or try --set matches.pairing=exhaustive." if tried < total * (total - 1) // 2 else ".")
    if together < 2:
        return SplatpipeError(f"{said}: no two of them match.", hint=f"{OVERLAP} {more}")
    return SplatpipeError(f"{said}.", hint=f"{OVERLAP} {more}")


def _largest_group(verified: ViewGraph) -> tuple[int, int]:
    """How many photos the largest group of matching photos has, and how many matches its best pair has."""
    places = {number: place for place, number in enumerate(sorted(verified.names))}
    groups = components([(places[i], places[j]) for i, j in verified.matches], len(places))
    return int(np.bincount(groups).max()), max(map(len, verified.matches.values()), default=0)
