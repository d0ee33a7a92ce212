"""Options of the stages that evaluate the splat. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.stage import StageConfig

JUDGED_MEGAPIXELS = 2.0
"""Held-out photos are evaluated at this size, or at their own if that is smaller, whatever size was trained: this makes
runs comparable and shows what a preset leaves blurred. A full-screen image has about as many pixels; beyond that, a
photo's pixels are mostly noise and Bayer pattern."""


class EvaluateConfig(StageConfig):
    """No options: `split` decides which photos are held out."""
