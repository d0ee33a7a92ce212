"""Options of the stages that measure the splat. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.stage import StageConfig


class EvaluateConfig(StageConfig):
    """None: `split` tells what is measured with."""
