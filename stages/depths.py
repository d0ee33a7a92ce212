"""depths: a depth map for every photo, where other photos confirm it; the input of all surface products."""

from __future__ import annotations

import shutil
from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.mvs.depth_maps import find_depth_maps, save_depth_maps
from splatpipe.pipeline.mvs.options import DepthsConfig
from splatpipe.pipeline.photos.pixels.dataset import load_views


def run(config: DepthsConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `maps/`, in the model's frame; empty if not requested.

    Held-out photos have maps, too: surfaces are not used to evaluate the splat that was trained without them.

    Raises:
        StageError: if the dataset cannot be read.
    """
    maps, search = out / "maps", out / "search"
    shutil.rmtree(maps, ignore_errors=True)
    if not config.enabled:
        report.progress(1, 1, "no depth maps are made", "steps")
        return save_depth_maps(maps, [])
    search.mkdir(exist_ok=True)
    dataset = inputs["undistort.dataset"]
    found = find_depth_maps(dataset, load_views(dataset), config.max_megapixels, search, inputs.machine.threads, report)
    return save_depth_maps(maps, found)
