"""depths: a depth map for every photo, where other photos confirm it; what surfaces are made from."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.json_file import write_json
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.mvs.depth_maps import find_depth_maps
from splatpipe.pipeline.mvs.options import DepthsConfig
from splatpipe.pipeline.photos.dataset import load_views


def run(config: DepthsConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `maps/`: a file for each photo, in the order of the dataset, and `photos.json`, what they are called.

    All photos have a map, held-out ones, too: nothing is judged by surfaces that was trained without them.
    """
    folder = out / "maps"
    folder.mkdir()
    views = load_views(inputs["undistort.dataset"]) if config.enabled else []
    names, pixels, found = [], 0, 0
    maps = find_depth_maps(
        inputs["undistort.dataset"], views, config.max_megapixels, out, inputs.machine.threads, report
    )
    for number, (camera, depths) in enumerate(maps):
        file = f"{number:05d}.npz"
        depths.save(folder / file)
        names.append({"name": camera.name, "file": file, "width": camera.width, "height": camera.height})
        pixels += depths.depth.size
        found += int((depths.confidence > 0).sum())
    write_json(folder / "photos.json", names)
    return {"maps": len(names), "megapixels": pixels / 1e6, "found": found / max(pixels, 1)}
