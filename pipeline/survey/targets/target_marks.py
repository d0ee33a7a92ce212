"""From targets in photos to marks of control points: group detections, identify their points, reject the rest.

Rays of detections of one target meet in a point of the model. A coded target is the point whose name ends in its
number. Any other target is matched by position: points and targets are aligned as two constellations, first by a
translation (photos' positions share an error, and their heights may be in another datum), then by a similarity. Targets
whose rays do not meet, that have no point, or that lie elsewhere than their point are rejected.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.targets.constellation import MIN_MATCHES, WRONG_RATIO, overlay
from splatpipe.pipeline.survey.targets.target_finds import TargetFind
from splatpipe.pipeline.survey.targets.target_tracks import Track, coded_tracks, unnamed_tracks

NUMBERS = re.compile(r"\d+")


@dataclass(frozen=True)
class ExpectedPoints:
    """The surveyed positions of the points.

    Attributes:
        names: The points' names.
        enu: East, north, up in metres; an unknown height is NaN.
        world_from_model: By the photos' positions, approximate; None where they give none.
    """

    names: tuple[str, ...]
    enu: Float64[np.ndarray, "n 3"]
    world_from_model: Similarity | None


@dataclass(frozen=True)
class NamedTrack:
    """A target with a name.

    Attributes:
        name: Of a control point, or of a scale bar's end.
        track: Its position and its detections in photos.
    """

    name: str
    track: Track


@dataclass(frozen=True)
class TargetMarks:
    """Targets that were identified or rejected.

    Attributes:
        named: Those that are control points, or ends of scale bars.
        refused: Number of targets not used, by reason.
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
    """Assign names to targets.

    Args:
        finds: Detections in all photos.
        names: Of control points and ends of scale bars.
        scene: The sparse model, and all photos by name.
        expected: Surveyed positions of the control points; None where there are none.
        seeds: Positions in the model of manually marked points, by name.
    """
    coded = coded_tracks(finds, *scene)
    by_number, refused = _by_number(coded, names)
    if expected is None:
        refused["quadrants without coordinates to identify them"] += sum(find.number is None for find in finds)
        return TargetMarks(tuple(by_number), +refused)
    taken = {each.track for each in by_number}
    unnamed = unnamed_tracks([find for find in finds if find.number is None], *scene)
    unnamed += [track for track in coded if track not in taken]
    by_place, wrong = _by_place(unnamed, by_number, expected, seeds)
    kept = [each for each in by_number if each.name not in wrong]
    refused["coded targets far from the points of their numbers"] += len(by_number) - len(kept)
    refused["targets at no surveyed point"] += len(unnamed) - len(by_place)
    found = kept + [NamedTrack(name, unnamed[k]) for name, k in sorted(by_place.items())]
    return TargetMarks(tuple(found), +refused)


def _by_place(
    unnamed: Sequence[Track],
    by_number: Sequence[NamedTrack],
    expected: ExpectedPoints,
    seeds: Mapping[str, Float64[np.ndarray, " 3"]],
) -> tuple[dict[str, int], set[str]]:
    """Targets matched to points by position, and the names of those whose number is a point that lies elsewhere."""
    row = {name: k for k, name in enumerate(expected.names)}
    known = {each.name: each.track.place for each in by_number if each.name in row}
    known |= {name: place for name, place in seeds.items() if name in row}
    if expected.world_from_model is None and len(known) < MIN_MATCHES:
        return {}, set()
    places = np.array([*known.values(), *(track.place for track in unnamed)], dtype=np.float64).reshape(-1, 3)
    if expected.world_from_model is not None:
        places = expected.world_from_model.apply(places)
    numbered = {k: row[name] for k, name in enumerate(known)}
    found = overlay(places, expected.enu, numbered)
    if found is None:
        return {}, set()
    there = found.points_from_places.apply(places)
    limit = WRONG_RATIO * found.tolerance_m
    off = {name: expected.enu[row[name]] - there[k] for k, name in enumerate(known)}
    wrong = {each.name for each in by_number if each.name in off and np.nansum(off[each.name] ** 2) > limit**2}
    taken = set(known)
    pairs = [(expected.names[point], place - len(known)) for place, point in found.pairs.tolist()]
    return {name: place for name, place in pairs if place >= 0 and name not in taken}, wrong


def _by_number(coded: Sequence[Track], names: Sequence[str]) -> tuple[list[NamedTrack], Counter[str]]:
    """Coded targets matched to names that state their dictionary and number, or their number alone.

    Where targets of two dictionaries have a point's number, the dictionary that names more points is used.
    """
    refused: Counter[str] = Counter()
    numbers: defaultdict[int, list[str]] = defaultdict(list)
    spelled = {_spelled(name): name for name in names}
    for name in names:
        number = number_of(name)
        if number is not None:
            numbers[number].append(name)
    exact = {
        track: spelled[_spelled(f"{track.kind}{track.number}")]
        for track in coded
        if _spelled(f"{track.kind}{track.number}") in spelled
    }
    votes: Counter[str] = Counter()
    for track in coded:
        if len(numbers[track.number or 0]) == 1 or track in exact:
            votes[track.kind] += len(track.finds)
    claims: defaultdict[str, list[Track]] = defaultdict(list)
    for track in coded:
        called = numbers[track.number or 0]
        if track in exact:
            claims[exact[track]].append(track)
        elif len(called) == 1:
            claims[called[0]].append(track)
    result = []
    for name, tracks in sorted(claims.items()):
        best = max(votes[track.kind] for track in tracks)
        chosen = [track for track in tracks if votes[track.kind] == best]
        if len(chosen) == 1:
            result.append(NamedTrack(name, chosen[0]))
        else:
            refused["coded targets that share a point's number"] += len(chosen)
    return result, refused


def _spelled(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.casefold())
