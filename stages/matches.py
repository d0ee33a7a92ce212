"""matches: choose photo pairs, match their descriptors and verify the two-view geometry."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.machine import threads_within
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.photos.files.photo_list import load_photo_list
from splatpipe.pipeline.sfm.matching.matching import PROCESS_BYTES, look_alike, match_pairs, write_verified
from splatpipe.pipeline.sfm.options import MatchesConfig
from splatpipe.pipeline.sfm.pairing.layout import half_sizes, make_layout, make_views
from splatpipe.pipeline.sfm.pairing.pairs import choose_pairing, components, select_pairs


def run(config: MatchesConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write ``database.db`` (cameras, keypoints, verified two-view geometries) and ``pairs.json``.

    Raises:
        SplatpipeError: if no two photos match.
    """
    photos = load_photo_list(inputs["ingest.photos"]).photos
    positions = read_json(inputs["ingest.positions"])["positions"]
    features = inputs["features.database"]
    layout = make_layout(photos, positions)
    layout = replace(
        layout, views=make_views(photos, positions, half_sizes(features, [photo.name for photo in photos]))
    )
    report.progress(0, 1, "choosing pairs")
    pairing = config.pairing
    if pairing == "auto":
        pairing = choose_pairing(layout, config.exhaustive_up_to)  # type: ignore[assignment]
    pairs = select_pairs(layout, pairing, config.neighbours, cache(lambda: look_alike(features, config.seed)))
    with tempfile.TemporaryDirectory(prefix="scratch-", dir=out, ignore_cleanup_errors=True) as scratch:
        work = Path(scratch) / "database.db"
        processes = threads_within(inputs.machine.threads, PROCESS_BYTES, inputs.machine.memory_bytes)
        match_pairs(features, work, pairs, config.seed, processes, report)
        inliers = write_verified(work, features, out / "database.db")
    if not any(inliers.values()):
        raise SplatpipeError(
            f"No two of the {len(photos)} photos overlap and were taken from different positions.",
            hint="Photos must overlap, by two thirds at best, and be sharp."
            + ("" if pairing == "exhaustive" else " Or try --set matches.pairing=exhaustive."),
        )
    names = layout.names
    listed = [[names[i], names[j], inliers.get((i, j), 0)] for i, j in pairs]
    text = json.dumps({"pairing": pairing, "pairs": listed}, ensure_ascii=False, indent=0)
    write_file(out / "pairs.json", text + "\n")
    verified = [count for count in inliers.values() if count > 0]
    pieces = components([pair for pair, count in inliers.items() if count > 0], len(photos))
    return {
        "pairing": pairing,
        "pairs": len(pairs),
        "verified": len(verified),
        "median_inliers": int(np.median(verified)),
        "largest_connected": int(np.bincount(pieces).max()),
    }
