"""Probe a model by matching pairs that show the same thing according to the model but were never matched.

With few pairs, a bent model may contradict none of its matches. Its predictions for other pairs then confirm or refute
it, and their matches help to correct it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.sfm.capture import MappingInput
from splatpipe.pipeline.sfm.judging.agreement import compare, contradicting
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph, read_verified
from splatpipe.pipeline.sfm.recovery.ladder_pairs import match_more, propose_pairs, tried_pairs

PROBE_PAIRS = 24  # pairs: a few seconds' work, and enough for a meaningful share
# verified pairs per photo; drone captures with overlap have 15 or more, chains and trees 2 to 5
SPARSE_PAIRS_PER_PHOTO = 8.0
FILL_PAIRS_PER_PHOTO = 6  # new pairs per photo for a sparse graph


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


def probe(
    capture: MappingInput,
    model: pycolmap.Reconstruction,
    graph: tuple[Path, ViewGraph],
    count: int,
    seed: int,
    report: Reporter,
) -> ProbeResult:
    """Match pairs that show the same thing according to a model, and check the model against them.

    Args:
        capture: Supplies the descriptors.
        model: A model with the keypoints of the graph.
        graph: The current database, and its view graph.
        count: Maximum number of pairs.
        seed: For the verification.
        report: Receives progress.
    """
    database, verified = graph
    pairs = propose_pairs(model, verified, count, capture.tried | tried_pairs(database))
    if not pairs:
        return ProbeResult(database, verified, 0, 0, 0)
    grown = match_more(capture, database, pairs, seed, report)
    after = read_verified(grown)
    new = {pair: rows for pair, rows in after.matches.items() if pair not in verified.matches}
    against = contradicting(compare(model, replace(after, matches=new)))
    return ProbeResult(grown, after, len(pairs), len(new), int(against.sum()))
