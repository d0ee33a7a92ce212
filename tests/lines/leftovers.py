"""A pipeline that copies the output of `ingest`, `features` and `matches` from the photo folder, then runs `sparse`."""

import shutil
from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Stage, StageConfig, Summary
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.stages.line import SPARSE

PREPARED = {
    "ingest": {"photos": "photos", "cameras": "cameras.json", "positions": "positions.json", "lenses": "lenses.json"},
    "features": {"database": "database.db", "colours": "colours.npy"},
    "matches": {"database": "database.db", "pairs": "pairs.json"},
}


class NoConfig(StageConfig):
    pass


class LineConfig(StageConfig):
    ingest: NoConfig = NoConfig()
    features: NoConfig = NoConfig()
    matches: NoConfig = NoConfig()
    sparse: SparseConfig = SparseConfig()


def take_ingest(config: NoConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    return _take("ingest", inputs, out)


def take_features(config: NoConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    return _take("features", inputs, out)


def take_matches(config: NoConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    return _take("matches", inputs, out)


def _take(stage: str, inputs: Inputs, out: Path) -> Summary:
    shutil.copytree(inputs.photos_dir / "prepared" / stage, out, dirs_exist_ok=True)
    return {}


LINE = (
    *(
        Stage(name, 1, NoConfig, ("source.photos",), parts, f"leftovers:take_{name}")
        for name, parts in PREPARED.items()
    ),
    SPARSE,
)
