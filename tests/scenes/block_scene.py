"""A tiny scene whose training is divided into blocks."""

import json
from collections.abc import Mapping
from pathlib import Path

import tiny_scene

from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.stages import initialize

QUICK = tiny_scene.plain(iterations=80, max_gaussians=6000, sh_degree=0).model_dump()

OPTIONS: Mapping[str, object] = {"train": QUICK, "blocks": {"least": 3}}

SHARDS = ("train.1", "train.2", "train.3")


def prepared(dataset: Path, every: int) -> Path:
    """A dataset's folder with the other inputs of `blocks`."""
    folder = dataset.parent
    parts = {"undistort.dataset": dataset, **tiny_scene.split_part(dataset, every)}
    parts["split.views"].rename(folder / "split.json")
    (folder / "boundary.json").write_text(json.dumps({"model": None, "world": None}))
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder
