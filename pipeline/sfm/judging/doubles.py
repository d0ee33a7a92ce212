"""Missing correspondences: where a photo shows other things than its neighbours in the model.

If two like sides of a building are taken for one, all matches agree with the model, since the photos of one side match
those of the other only where these are alike. But elsewhere in their images they show different things: points that one
photo sees, and the other should see according to the model, are missing there, while the other has points of its own
(Zach et al., What can missing correspondences tell us about 3D structure and motion?, CVPR 2008; Heinly et al.,
Correcting for duplicate scene structure, ECCV 2014). A single such place means little, as matching misses many points;
two groups of photos that differ so wherever they overlap are two places.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.sfm.judging.cuts import GraphCut, cut_between
from splatpipe.pipeline.sfm.judging.judging import Level, Reason, name_photo_group
from splatpipe.pipeline.sfm.model.structure import read_structure
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.pairing.pairs import Pair
from splatpipe.pipeline.sfm.pairing.view_overlaps import ANGLE_BINS, ViewOverlap, compare_views

MIN_OWN = 5  # points of the other photo in a cell: it has to show something else
MIN_EXPECTED = 4.0  # common points expected in a cell: fewer may be missing by chance
MAX_FOUND_SHARE = 0.2  # common points over the expected ones, below which a cell shows another place
MIN_COMMON = 30.0  # common points of two groups, to avoid dividing by few
MIN_MISSING = 60.0  # common points that are missing between two groups: fewer are three or four photos' corners
RATIO_DOUBT, RATIO_BAD = 0.15, 0.25  # missing over common points of two groups; sound captures have 0 to 0.09
MAX_CUTS = 5  # cuts tried in turn, each with a higher ratio of missing points
DIGITS = 6  # decimals that are compared: the last ones vary with the number of threads


@dataclass(frozen=True)
class Doubles:
    """Two groups of photos that show different things where the model has them at one place.

    Attributes:
        group: Image ids of the smaller group; empty if no two groups differ.
        ratio: Common points of the groups that are missing, over those that are there.
        missing: How many are missing.
        pair: Of the two groups, the photos that differ most, as image ids.
        places: Where they do, in each of them: pixels of what should show the same.
    """

    group: tuple[int, ...] = ()
    ratio: float = 0.0
    missing: float = 0.0
    pair: tuple[int, int] = (0, 0)
    places: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))

    def level(self) -> Level:
        """How much they speak against a model."""
        if self.ratio < RATIO_DOUBT or self.missing < MIN_MISSING:
            return "good"
        return "bad" if self.ratio >= RATIO_BAD else "doubt"

    def as_json(self, verified: ViewGraph) -> JSON:
        """Return the two photos and places to look at, for ``models.json``; None if nothing speaks against a model."""
        if self.level() == "good":
            return None
        names = [verified.names[number] for number in self.pair]
        return {"photos": names, "places_px": [[round(value, 1) for value in place] for place in self.places]}


def find_doubles(model: pycolmap.Reconstruction, tried: Collection[Pair]) -> Doubles:
    """Look for two groups of photos that show different things wherever the model has them at one place.

    Args:
        model: With points.
        tried: (i, j), i < j, pairs that were matched.
    """
    structure, numbers = read_structure(model), np.array(sorted(model.reg_image_ids()), np.int64)
    found = compare_views(model, structure, numbers, tried)
    usual = usual_rates(found)
    common, against = np.zeros((len(numbers), len(numbers))), np.zeros((len(numbers), len(numbers)))
    for entry in found:
        common[entry.pair] += entry.hits.sum()
        against[entry.pair] += missing(entry, usual).sum()
    common, against = common + common.T, against + against.T
    cut = _largest_cut(common, against, numbers)
    if not cut.group:
        return Doubles()
    inside = np.isin(numbers, cut.group)
    between = against * (inside[:, None] != inside[None, :])
    worst = max(
        (entry for entry in found if inside[entry.pair[0]] != inside[entry.pair[1]]),
        key=lambda entry: (round(float(missing(entry, usual).sum()), DIGITS), entry.pair),
    )
    cell = int(np.argmax(np.round(missing(worst, usual), DIGITS)))
    points = structure.points[worst.rows[worst.rows[:, 1] == cell, 0]]
    sides = sorted((int(numbers[row]), _middle(model, int(numbers[row]), points)) for row in worst.pair)
    (first, here), (second, there) = sides
    return Doubles(cut.group, cut.ratio, float(between.sum()) / 2.0, (first, second), (here, there))


def _largest_cut(
    common: Float64[np.ndarray, "m m"], against: Float64[np.ndarray, "m m"], numbers: Int64[np.ndarray, " m"]
) -> GraphCut:
    """Return the cut with the largest ratio: the common points are weighed by the ratio found so far (Dinkelbach)."""
    best, scale = GraphCut(), 1.0
    for _ in range(MAX_CUTS):
        cut = cut_between(scale * common, against, numbers, scale * MIN_COMMON)
        if scale * cut.ratio <= best.ratio:
            break
        scale *= cut.ratio
        best = GraphCut(cut.group, scale)
    return best


def missing(entry: ViewOverlap, usual: Float64[np.ndarray, " bins"]) -> Float64[np.ndarray, " cells"]:
    """Return how many more common points there should be in those cells where both have points and hardly any common.

    Photos of sand or leaves, from other directions of light, have few points in common everywhere: so no more are
    expected than the two have in common where they have any, and photos that have none at all say nothing.

    Args:
        entry: What one of the photos sees of the other's points.
        usual: Share of points that are found again, by the angle between the views.
    """
    total, common = entry.hits + entry.lacking, entry.hits > 0
    own_rate = float(entry.hits[common].sum()) / max(float(total[common].sum()), 1.0)
    expected = min(float(usual[entry.bin]), own_rate) * total
    differs = (entry.own >= MIN_OWN) & (expected >= MIN_EXPECTED) & (entry.hits < MAX_FOUND_SHARE * expected)
    return np.asarray(np.where(differs, expected - entry.hits, 0.0))


def usual_rates(found: Sequence[ViewOverlap]) -> Float64[np.ndarray, " bins"]:
    """Return the share of points that a photo usually finds again, by angle: the median over pairs that share any."""
    rates: list[list[float]] = [[] for _ in range(ANGLE_BINS)]
    for entry in found:
        hits, total = float(entry.hits.sum()), float((entry.hits + entry.lacking).sum())
        if hits:
            rates[entry.bin].append(hits / total)
    return np.array([np.median(rate) if rate else 0.0 for rate in rates])


def doubles_reasons(verified: ViewGraph, found: Doubles) -> list[Reason]:
    """Return the reason for doubt that doubles are; none if they may be chance."""
    if found.level() == "good":
        return []
    names = [verified.names[number] for number in found.pair]
    text = f"{name_photo_group(found.group, verified)} show other things than the photos that the model has at the "
    text += f"same place, such as {names[0]} and {names[1]}: two places that look alike may have been taken for one."
    hint = "Compare the two photos: the report shows that place in both. Add photos that lead from one place to the "
    hint += "other, or run the places separately."
    return [Reason(found.level(), text, hint, "doubles")]


def _middle(model: pycolmap.Reconstruction, number: int, points: Float64[np.ndarray, "k 3"]) -> tuple[float, float]:
    """Return where a photo should see some points: the median, pixels."""
    image = model.images[number]
    places, _ = project_through_lens(image.camera, image.cam_from_world().matrix(), points)
    x, y = np.nanmedian(np.where(np.isfinite(places), places, np.nan), axis=0)
    return float(x), float(y)
