"""New evidence for a model: photos that by the model show the same thing, but were never matched, are.

A graph of few pairs can leave a bend that contradicts none of its matches. What the model foretells about other pairs
then proves it right or wrong, and mends it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.sfm.agreement import compare
from splatpipe.pipeline.sfm.capture import MappingInput
from splatpipe.pipeline.sfm.judging import contradicting
from splatpipe.pipeline.sfm.ladder_pairs import match_more, propose_pairs, tried_pairs
from splatpipe.pipeline.sfm.view_graph import ViewGraph, read_verified

PROBES = 24  # pairs: a few seconds' work, and enough for a share of them to mean something
PROVEN = (3, 0.1)  # contradicting probes, and their share of those that hold: more than look-alikes give, 0 to 0.05
THIN = 8.0  # verified pairs a photo; drone captures with overlap have 15 and more, chains and trees 2 to 5
FILL = 6  # pairs a photo that a thin graph gets


@dataclass(frozen=True)
class ProbeResult:
    """What new pairs said.

    Attributes:
        database: Everything so far and what holds of the new pairs.
        verified: Its view graph.
        tried: Pairs matched.
        held: Of these, verified.
        contradicting: Of these, those whose matches the model contradicts.
    """

    database: Path
    verified: ViewGraph
    tried: int
    held: int
    contradicting: int

    @property
    def prove_a_bend(self) -> bool:
        """Whether the model foretold wrongly."""
        return self.contradicting >= max(PROVEN[0], PROVEN[1] * self.held)


def pairs_a_photo(model: pycolmap.Reconstruction, verified: ViewGraph) -> float:
    """Verified pairs of a placed photo with other placed ones, on average."""
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
    """Match pairs that a model says show the same thing, and hold the model against them.

    Args:
        capture: Where the descriptors are.
        model: With the keypoints of the graph.
        graph: The database so far, and what it says.
        count: Pairs at most.
        seed: Of the verification.
        report: Told of the progress.
    """
    database, verified = graph
    pairs = propose_pairs(model, verified, count, capture.tried | tried_pairs(database))
    if not pairs:
        return ProbeResult(database, verified, 0, 0, 0)
    grown = match_more(capture, database, pairs, seed, report)
    after = read_verified(grown)
    agreement = compare(model, after)
    known = set(verified.matches)
    new = np.array([(int(i), int(j)) not in known for i, j in agreement.pairs], bool)
    against = contradicting(agreement) & new
    return ProbeResult(grown, after, len(pairs), int(new.sum()), int(against.sum()))
