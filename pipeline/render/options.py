"""Options of the stages that evaluate the splat. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.ranges import NonNegativeInt
from splatpipe.pipeline.engine.stage import StageConfig

JUDGED_MEGAPIXELS = 2.0
"""Held-out photos are evaluated at this size, or at their own if that is smaller, whatever size was trained: this makes
runs comparable and shows what a preset leaves blurred. A full-screen image has about as many pixels; beyond that, a
photo's pixels are mostly noise and Bayer pattern."""


class EvaluateConfig(StageConfig):
    most_views: NonNegativeInt = 0
    """Judge at most this many of the held-out photos, spread evenly over them in order of name; 0: all. The others are
    not trained on either."""
