"""From targets in photos to marks of control points: which belong together, which point they are, which are refused.

Finds of one target meet in a point of the model. A coded target is the point whose name ends in its number. Any other
target is the point that lies where it is: points and targets are laid over each other as two constellations, first
moved as a whole (photos' positions err together, and their heights may be in another datum), then by a similarity.
What meets nowhere, has no point, or lies elsewhere than its point is refused.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.photo_list import Photo
from splatpipe.pipeline.survey.constellation import LEAST_MATCHES, WRONG, overlay
from splatpipe.pipeline.survey.model import SparseModel
from splatpipe.pipeline.survey.target_finds import TargetFind
from splatpipe.pipeline.survey.target_tracks import Track, coded_tracks, unnamed_tracks

NUMBERS = re.compile(r"\d+")


@dataclass(frozen=True)
class ExpectedPoints:
    """Where the survey has its points.

    Attributes:
        names: Theirs.
        enu: Metres; a height that is not known is NaN.
        world_from_model: Of the photos' positions, roughly right; None where they give none.
    """

    names: tuple[str, ...]
    enu: Float64[np.ndarray, "n 3"]
    world_from_model: Similarity | None


@dataclass(frozen=True)
class NamedTrack:
    """A target that is known by name.

    Attributes:
        name: Of a control point, or of a scale bar's end.
        track: Where it is, and where photos show it.
    """

    name: str
    track: Track


@dataclass(frozen=True)
class TargetMarks:
    """What became of the targets.

    Attributes:
        named: Those that are control points, or ends of scale bars.
        refused: How many targets were not used, by the reason.
    """

    named: tuple[NamedTrack, ...]
    refused: Mapping[str, int]

    def pixels(self) -> dict[str, dict[str, tuple[float, float]]]:
        """Pixels by name and photo."""
        return {each.name: {f.photo: (f.x, f.y) for f in each.track.finds} for each in self.named}


def number_of(name: str) -> int | None:
    """The number in a name: its last digits; None where it has none."""
    digits = NUMBERS.findall(name)
    return int(digits[-1]) if digits and len(digits[-1]) <= 6 else None


def named_tracks(
    finds: Sequence[TargetFind],
    names: Sequence[str],
    scene: tuple[SparseModel, Mapping[str, Photo]],
    expected: ExpectedPoints | None,
    seeds: Mapping[str, Float64[np.ndarray, " 3"]],
) -> TargetMarks:
    """Join targets with names.

    Args:
        finds: In all photos.
        names: Of control points and ends of scale bars.
        scene: The sparse model, and all photos by name.
        expected: Where the control points are; None where there are none.
        seeds: Places in the model of points that somebody marked, by name.
    """
    coded = coded_tracks(finds, *scene)
    by_number, refused = _by_number(coded, names)
    if expected is None:
        refused["quadrants that no coordinates name"] += sum(find.number is None for find in finds)
        return TargetMarks(tuple(by_number), +refused)
    taken = {id(each.track) for each in by_number}
    unnamed = unnamed_tracks([find for find in finds if find.number is None], *scene)
    unnamed += [track for track in coded if id(track) not in taken]
    by_place, wrong = _by_place(unnamed, by_number, expected, seeds)
    kept = [each for each in by_number if each.name not in wrong]
    refused["coded targets elsewhere than their points"] += len(by_number) - len(kept)
    refused["targets where no point is"] += len(unnamed) - len(by_place)
    found = kept + [NamedTrack(name, unnamed[k]) for name, k in sorted(by_place.items())]
    return TargetMarks(tuple(found), +refused)


def _by_place(
    unnamed: Sequence[Track],
    by_number: Sequence[NamedTrack],
    expected: ExpectedPoints,
    seeds: Mapping[str, Float64[np.ndarray, " 3"]],
) -> tuple[dict[str, int], set[str]]:
    """Targets by the points that lie where they are, and the names of those that have a number but lie elsewhere."""
    row = {name: k for k, name in enumerate(expected.names)}
    known = {each.name: each.track.place for each in by_number if each.name in row}
    known |= {name: place for name, place in seeds.items() if name in row}
    if expected.world_from_model is None and len(known) < LEAST_MATCHES:
        return {}, set()
    places = np.array([*known.values(), *(track.place for track in unnamed)], dtype=np.float64).reshape(-1, 3)
    if expected.world_from_model is not None:
        places = expected.world_from_model.apply(places)
    numbered = {k: row[name] for k, name in enumerate(known)}
    found = overlay(places, expected.enu, numbered)
    if found is None:
        return {}, set()
    there = found.points_from_places.apply(places)
    limit = WRONG * found.tolerance_m
    off = {name: expected.enu[row[name]] - there[k] for k, name in enumerate(known)}
    wrong = {each.name for each in by_number if each.name in off and np.nansum(off[each.name] ** 2) > limit**2}
    taken = set(known)
    pairs = [(expected.names[point], place - len(known)) for place, point in found.pairs.tolist()]
    return {name: place for name, place in pairs if place >= 0 and name not in taken}, wrong


def _by_number(coded: Sequence[Track], names: Sequence[str]) -> tuple[list[NamedTrack], Counter[str]]:
    """Coded targets by the names that state their dictionary and number, or their number alone.

    Where targets of two dictionaries have the number of a point, the dictionary counts that names more points.
    """
    refused: Counter[str] = Counter()
    numbers: defaultdict[int, list[str]] = defaultdict(list)
    spelled = {_spelled(name): name for name in names}
    for name in names:
        number = number_of(name)
        if number is not None:
            numbers[number].append(name)
    exact = {
        id(t): spelled[_spelled(f"{t.kind}{t.number}")] for t in coded if _spelled(f"{t.kind}{t.number}") in spelled
    }
    votes: Counter[str] = Counter()
    for track in coded:
        if len(numbers[track.number or 0]) == 1 or id(track) in exact:
            votes[track.kind] += len(track.finds)
    claims: defaultdict[str, list[Track]] = defaultdict(list)
    for track in coded:
        called = numbers[track.number or 0]
        if id(track) in exact:
            claims[exact[id(track)]].append(track)
        elif len(called) == 1:
            claims[called[0]].append(track)
    result = []
    for name, tracks in sorted(claims.items()):
        best = max(votes[track.kind] for track in tracks)
        chosen = [track for track in tracks if votes[track.kind] == best]
        if len(chosen) == 1:
            result.append(NamedTrack(name, chosen[0]))
        else:
            refused["coded targets of which two have a point's number"] += len(chosen)
    return result, refused


def _spelled(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.casefold())
