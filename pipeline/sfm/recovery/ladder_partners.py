"""Rank likely partners of leftover photos: by matches, by shared points, by position, by visual similarity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from itertools import zip_longest

import numpy as np

from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.model.structure import read_structure
from splatpipe.pipeline.sfm.pairing.layout import make_layout
from splatpipe.pipeline.sfm.pairing.pairs import Costs, Pair, has_informative_positions, spatial_costs
from splatpipe.pipeline.sfm.recovery.ladder_poses import partners_of

PartnersByPhoto = dict[int, list[int]]
"""For each leftover photo, others that may show the same thing, most likely first."""

MAX_PARTNERS = 100  # entries of a ranking that are kept; callers never need more


def rank_partners(capture: MappingInput, found: MappingResult, left: Collection[int], alike: Costs) -> PartnersByPhoto:
    """Interleave the rankings of all hints; candidates are placed photos and photos of other sub-models.

    Args:
        capture: Names and positions.
        found: The model and its view graph.
        left: Photos that are not placed.
        alike: Costs of pairs by the photos' content.
    """
    placed = set(found.model.reg_image_ids())
    groups = [set(other.reg_image_ids()) for other in found.others]
    hints = [by_matches(found, left, placed), by_model(found, left, placed)]
    layout = make_layout(capture.photos.photos, capture.positions)
    if has_informative_positions(layout):
        hints.append(by_costs(left, spatial_costs(layout)))
    hints.append(by_costs(left, alike))
    partners_by_photo: PartnersByPhoto = {}
    for photo in sorted(left):
        own = {member for group in groups if photo in group for member in group}
        wanted = placed.union(*groups) - own - {photo}
        turns = zip_longest(*(hint.get(photo, []) for hint in hints))
        partners_by_photo[photo] = list(dict.fromkeys(other for turn in turns for other in turn if other in wanted))
    return partners_by_photo


def by_matches(found: MappingResult, left: Collection[int], placed: Collection[int]) -> PartnersByPhoto:
    """Rank placed photos by the number of verified matches with each leftover photo."""
    partners_by_photo = {}
    for photo in sorted(left):
        shared = [(-len(mine), partner) for partner, mine, _ in partners_of(found.verified, photo) if partner in placed]
        partners_by_photo[photo] = [partner for _, partner in sorted(shared)]
    return partners_by_photo


def by_model(found: MappingResult, left: Collection[int], placed: Collection[int]) -> PartnersByPhoto:
    """Rank photos by the points they share with placed photos that have verified matches with the leftover photo."""
    tracks = read_structure(found.model).tracks
    rows: dict[int, list[int]] = {}
    for row, track in enumerate(tracks):
        for member, _ in track:
            rows.setdefault(member, []).append(row)
    partners_by_photo = {}
    for photo in sorted(left):
        counts: Counter[int] = Counter()
        for partner, _, _ in partners_of(found.verified, photo):
            if partner in placed:
                counts.update(member for row in rows.get(partner, []) for member, _ in tracks[row])
        partners_by_photo[photo] = sorted(counts, key=lambda member: (-counts[member], member))[:MAX_PARTNERS]
    return partners_by_photo


def choose_pairs(partners_by_photo: PartnersByPhoto, avoided: Collection[Pair], most: int) -> list[Pair]:
    """Pair each photo with its most likely partners.

    Args:
        partners_by_photo: Partners by photo.
        avoided: (i, j), i < j, pairs to exclude.
        most: Maximum number of pairs per photo.

    Returns:
        The pairs (i, j), i < j, sorted.
    """
    chosen: set[Pair] = set()
    for photo, partners in partners_by_photo.items():
        pairs = [(min(photo, partner), max(photo, partner)) for partner in partners]
        chosen |= set([pair for pair in pairs if pair not in avoided][:most])
    return sorted(chosen)


def by_costs(left: Collection[int], costs: Costs) -> PartnersByPhoto:
    """Rank other photos by cost, lowest first, where it is known."""
    partners_by_photo = {}
    for photo in sorted(left):
        row = costs(photo - 1).copy()
        row[photo - 1] = np.inf
        order: Sequence[int] = np.argsort(row, kind="stable")[:MAX_PARTNERS].tolist()
        partners_by_photo[photo] = [other + 1 for other in order if np.isfinite(row[other])]
    return partners_by_photo
