"""Options of blocks. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from splatpipe.pipeline.engine.stage import StageConfig

MAX_FORCED_BLOCKS = 256  # blocks: cells are cut on a grid that divides them no finer


class BlocksConfig(StageConfig):
    """Blocks: a scene whose Gaussians do not fit in memory is cut on the ground plan, trained block by block and
    merged."""

    least: Annotated[int, Field(ge=0, le=MAX_FORCED_BLOCKS)] = 0
    """Minimum number of blocks, so that several machines can train at once; 0: as few as memory allows, one if
    everything fits."""
