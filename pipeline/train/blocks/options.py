"""Options of blocks. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from splatpipe.pipeline.engine.stage import StageConfig

MOST_ASKED = 256  # blocks: cells are cut on a grid that divides them no finer


class BlocksConfig(StageConfig):
    """Scenes whose Gaussians do not fit in memory are cut into blocks of ground, trained one by one and merged."""

    least: Annotated[int, Field(ge=0, le=MOST_ASKED)] = 0
    """Blocks at least, for several machines to train at once; 0: as few as memory allows, one where all fits."""
