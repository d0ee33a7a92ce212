"""Options of the stages that measure the splat. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.ranges import NonNegativeInt
from splatpipe.pipeline.engine.stage import StageConfig


class EvaluateConfig(StageConfig):
    every: NonNegativeInt = 8
    """Every n-th registered photo in name order, starting with the first, is held out of training; 0 for none."""
    views: str = ""
    """Names of photos to hold out instead, separated by commas."""
