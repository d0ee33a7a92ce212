"""split: choose which photos are held out of training for evaluation; the only place that decides it."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.photos.options import SplitConfig
from splatpipe.pipeline.photos.pixels.dataset import load_views, split_views


def run(config: SplitConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `split.json`: the names of training and held-out photos, in order.

    Raises:
        SplatpipeError: if a name is unknown or ambiguous, or if nothing is left to train on.
    """
    names = [view.camera.name for view in load_views(inputs["undistort.dataset"])]
    found = split_views(names, config.every, config.views)
    write_file(out / "split.json", found.to_json())
    report.progress(len(names), len(names), "holding out", "photos")
    return {"trained_on": len(found.train), "held_out": len(found.held_out)}
