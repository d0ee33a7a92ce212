"""Finds connected photos by a quick match at low resolution, and problems with overlap and positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from splatpipe.pipeline.app.preflight.findings import Finding, Gap
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.files.names import list_names, printable
from splatpipe.pipeline.sfm.matching.quick_match import InlierMatches, QuickFeatures, match_quick_features
from splatpipe.pipeline.sfm.pairing.pairs import (
    Costs,
    Layout,
    Pair,
    choose_pairing,
    components,
    has_informative_positions,
    nearest,
    select_pairs,
)
from splatpipe.pipeline.sfm.pairing.retrieval import look_alike_costs
from splatpipe.pipeline.survey.positions.flight_gaps import MissingStrip, find_missing
from splatpipe.pipeline.survey.positions.swapped_positions import PositionEvidence, find_swapped

EXHAUSTIVE_UP_TO = 40  # photos: 780 pairs, five seconds
NEIGHBOURS = 8  # partners per photo by position or sequence; a run uses 20
SIMILAR_PARTNERS = 4  # further partners by appearance, since positions may be wrong
RETRY_PARTNERS = 16  # partners tried for photos without a match
MIN_MEDIAN_PARTNERS = 2.5  # least median number of matched photos: with fewer, a run loses photos
MIN_CONNECTED = 0.2  # least share for a reconstruction
OUTLINE_SHARE = 0.35  # half the width of a gap's outline as a share of its length


@dataclass(frozen=True)
class MatchGraph:
    """The result of the quick match.

    Attributes:
        found: Inlier matches by tried pair.
        pieces: Connected components of photos, largest first.
    """

    found: Mapping[Pair, InlierMatches]
    pieces: tuple[tuple[int, ...], ...]

    @property
    def matches(self) -> dict[Pair, int]:
        """Number of inlier keypoints by pair."""
        return {pair: len(agreed) for pair, agreed in self.found.items()}

    def partners(self, count: int) -> list[int]:
        """The number of photos that each photo matches."""
        own = [0] * count
        for pair, agreed in self.found.items():
            for photo in pair:
                own[photo] += bool(len(agreed))
        return own


def match_quickly(layout: Layout, all_features: Sequence[QuickFeatures], threads: int, report: Reporter) -> MatchGraph:
    """Match neighbours by metadata, similar-looking photos, and more of these for photos still without a match."""
    count = len(layout)

    @cache
    def alike() -> Costs:
        return look_alike_costs([features.rooted() for features in all_features], seed=0)

    pairing = choose_pairing(layout, EXHAUSTIVE_UP_TO)
    if count <= EXHAUSTIVE_UP_TO:
        pairing = "exhaustive"
    report.progress(0, 1, "matching quickly", "rounds")
    pairs = set(select_pairs(layout, pairing, NEIGHBOURS, alike))
    if pairing != "exhaustive":
        pairs |= nearest(range(count), alike(), SIMILAR_PARTNERS)
    found = match_quick_features(all_features, pairs, threads)
    unmatched = [k for piece in pieces_of(found, count)[1:] for k in piece]
    if unmatched and pairing != "exhaustive":
        more = nearest(unmatched, alike(), RETRY_PARTNERS) - pairs
        found |= match_quick_features(all_features, more, threads)
    report.progress(1, 1, "matching quickly", "rounds")
    return MatchGraph(found, pieces_of(found, count))


def pieces_of(found: Mapping[Pair, InlierMatches], count: int) -> tuple[tuple[int, ...], ...]:
    """Connected components of photos (indices), largest first."""
    labels = components([pair for pair, agreed in found.items() if len(agreed)], count)
    pieces: dict[int, list[int]] = {}
    for photo, label in enumerate(labels.tolist()):
        pieces.setdefault(label, []).append(photo)
    return tuple(sorted((tuple(piece) for piece in pieces.values()), key=lambda piece: (-len(piece), piece)))


def overlap_findings(names: Sequence[str], overlap: MatchGraph) -> list[Finding]:
    """Findings on orphans, separate components, and overlap that is low throughout."""
    count = len(names)
    pieces = overlap.pieces
    if count < 2:
        return []
    if len(pieces[0]) < max(2.0, MIN_CONNECTED * count):
        text = f"Hardly any photos overlap: at most {len(pieces[0])} of {count} are connected."
        hint = "This cannot be reconstructed: photos must overlap by two thirds, be sharp and show texture."
        return [Finding("no-overlap", "error", text, hint)]
    findings = []
    alone = tuple(sorted(names[piece[0]] for piece in pieces if len(piece) == 1))
    if alone:
        text = f"Matches no other photo: {list_names(alone)}." if len(alone) <= count / 10 else ""
        text = text or f"{len(alone)} of {count} photos match no other photo at low resolution."
        hint = "A run will probably fail to place them: take more photos around them, with two thirds overlap."
        findings.append(Finding("orphan", "warning", text, hint, alone if len(alone) <= count / 10 else ()))
    islands = [piece for piece in pieces[1:] if len(piece) > 1]
    if islands:
        groups = "; ".join(list_names([names[k] for k in piece], 4) for piece in islands[:3])
        text = f"The photos fall into {len(islands) + 1} groups that do not overlap: {groups}"
        text += " …" if len(islands) > 3 else ""
        hint = "Take photos between the groups, to connect them."
        findings.append(Finding("pieces", "warning", f"{text}.", hint))
    usual = float(np.median(overlap.partners(count)))
    if usual < MIN_MEDIAN_PARTNERS and count > 3:
        text = f"The overlap is low: a photo matches {usual:.0f} others (median)."
        findings.append(
            Finding("thin-overlap", "warning", text, "Fly with more overlap: two thirds along and across track.")
        )
    return findings


def flight_of(layout: Layout, overlap: MatchGraph) -> PositionEvidence:
    """The flight path; without positions if these scatter no more than their errors."""
    places = layout.positions_m if has_informative_positions(layout) else np.full_like(layout.positions_m, np.nan)
    return PositionEvidence(places, layout.times, overlap.matches)


def swap_findings(names: Sequence[str], flight: PositionEvidence) -> list[Finding]:
    """Photos whose positions are swapped."""
    findings = []
    for pair in find_swapped(flight):
        first, second = (names[k] for k in pair)
        apart = float(np.linalg.norm(flight.places_m[pair[0]] - flight.places_m[pair[1]]))
        text = f"{printable(first)} and {printable(second)} appear to have swapped positions ({apart:.0f} m apart):"
        text += " their content and the flight order suggest so."
        hint = "Swap their positions back, or set them in geo.txt."
        findings.append(Finding("position-swapped", "warning", text, hint, tuple(sorted((first, second)))))
    return findings


def gap_findings(names: Sequence[str], flight: PositionEvidence) -> tuple[list[Finding], list[Gap]]:
    """Strips of photos missing along the flight path."""
    findings, gaps = [], []
    for strip in find_missing(names, flight):
        before, after = printable(names[strip.before]), printable(names[strip.after])
        text = f"About {strip.missing} photos are missing between {before} and {after}"
        if strip.numbers:
            text = f"{strip.missing} photos are missing between {before} and {after}, judging by the file numbers"
        if np.isfinite(strip.apart_m):
            text += f": {strip.apart_m:.0f} m apart, {strip.usual_m:.0f} m elsewhere"
            gaps.append(Gap(_outline(flight, strip), f"{strip.missing} photos missing"))
        hint = "Check whether they are on the card; if not, fly this strip again."
        findings.append(Finding("gap", "warning", f"{text}.", hint))
    return findings, gaps


def _outline(flight: PositionEvidence, strip: MissingStrip) -> tuple[tuple[float, float], ...]:
    """A rectangle along the gap."""
    start, end = flight.places_m[strip.before, :2], flight.places_m[strip.after, :2]
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
    aside = np.array([-along[1], along[0]]) * max(strip.usual_m, OUTLINE_SHARE * strip.apart_m)
    corners = (start + aside, end + aside, end - aside, start - aside)
    return tuple((round(float(corner[0]), 2), round(float(corner[1]), 2)) for corner in corners)
