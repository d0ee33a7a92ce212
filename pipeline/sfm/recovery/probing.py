"""Probe a model by matching pairs of photos that were never matched.

With few pairs, a bent model may contradict none of its matches. Its predictions for other pairs then confirm or refute
it, and their matches help to correct it. But what a model predicts tends to confirm it: where a pattern repeats, photos
that the model has in the wrong place match their neighbours there, too. So if the graph is thin, the pairs that look
most alike come first, whatever the model has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import pycolmap

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.sfm.capture import MappingInput
from splatpipe.pipeline.sfm.judging.agreement import compare, contradicting
from splatpipe.pipeline.sfm.matching.matching import look_alike
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph, read_verified
from splatpipe.pipeline.sfm.pairing.pairs import Pair
from splatpipe.pipeline.sfm.recovery.ladder_pairs import match_more, propose_pairs, tried_pairs
from splatpipe.pipeline.sfm.recovery.ladder_partners import by_costs, choose_pairs

PROBE_PAIRS = 24  # pairs: a few seconds' work, and enough for a meaningful share
# verified pairs per photo; drone captures with overlap have 15 or more, chains and trees 2 to 5
SPARSE_PAIRS_PER_PHOTO = 8.0
FILL_PAIRS_PER_PHOTO = 6  # predicted pairs per photo for a sparse graph
ALIKE_PHOTOS = 12  # likest photos that each photo of a sparse graph is matched with: about as many pairs


@dataclass(frozen=True)
class ProbeResult:
    """Result of matching new pairs.

    Attributes:
        database: The database, with the verified matches of the new pairs added.
        verified: Its view graph.
        tried: Number of pairs matched.
        held: How many of these were verified.
        contradicting: How many of the verified pairs the model contradicts.
    """

    database: Path
    verified: ViewGraph
    tried: int
    held: int
    contradicting: int


def pairs_a_photo(model: pycolmap.Reconstruction, verified: ViewGraph) -> float:
    """Return the mean number of verified pairs of a placed photo with other placed photos."""
    placed = set(model.reg_image_ids())
    inside = sum(i in placed and j in placed for i, j in verified.matches)
    return 2.0 * inside / max(len(placed), 1)


def is_thin(model: pycolmap.Reconstruction, verified: ViewGraph) -> bool:
    """Whether a model's photos have so few verified pairs that these may hide a bend."""
    return pairs_a_photo(model, verified) < SPARSE_PAIRS_PER_PHOTO


def alike_pairs(capture: MappingInput, graph: tuple[Path, ViewGraph], seed: int) -> list[Pair]:
    """Return the pairs of photos that look most alike and were never matched.

    Args:
        capture: Supplies the descriptors.
        graph: The current database, and its view graph.
        seed: For the codebook.
    """
    database, verified = graph
    tried = capture.tried | tried_pairs(database)
    if tried.issuperset(combinations(sorted(verified.names), 2)):
        return []
    return choose_pairs(by_costs(verified.names, look_alike(capture.features, seed)), tried, ALIKE_PHOTOS)


def predicted_pairs(
    capture: MappingInput, model: pycolmap.Reconstruction, graph: tuple[Path, ViewGraph], many: bool
) -> list[Pair]:
    """Return pairs that show the same thing according to a model, and were never matched.

    Args:
        capture: With the pairs that were matched first.
        model: A model with the keypoints of the graph.
        graph: The current database, and its view graph.
        many: As many as a sparse graph lacks, instead of a sample.
    """
    database, verified = graph
    count = FILL_PAIRS_PER_PHOTO * model.num_reg_images() if many else PROBE_PAIRS
    return propose_pairs(model, verified, count, capture.tried | tried_pairs(database))


def probe(
    capture: MappingInput,
    model: pycolmap.Reconstruction,
    graph: tuple[Path, ViewGraph],
    pairs: Sequence[Pair],
    seed: int,
    report: Reporter,
) -> ProbeResult:
    """Match pairs of photos, and check a model against them.

    Args:
        capture: Supplies the descriptors.
        model: A model with the keypoints of the graph.
        graph: The current database, and its view graph.
        pairs: The pairs, (i, j), i < j.
        seed: For the verification.
        report: Receives progress.
    """
    database, verified = graph
    if not pairs:
        return ProbeResult(database, verified, 0, 0, 0)
    grown = match_more(capture, database, pairs, seed, report)
    after = read_verified(grown)
    new = {pair: rows for pair, rows in after.matches.items() if pair not in verified.matches}
    against = contradicting(compare(model, replace(after, matches=new)))
    return ProbeResult(grown, after, len(pairs), len(new), int(against.sum()))
