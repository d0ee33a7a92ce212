"""Options of the stages that measure the splat. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.stage import StageConfig

JUDGED_MEGAPIXELS = 2.0
"""Held-out photos are measured at so many, or at their own size where that is smaller, whatever was trained: figures of
runs compare, and what a preset leaves blurred is seen. Full screens have as many; a photo's own pixels are mostly noise
and Bayer pattern beyond."""


class EvaluateConfig(StageConfig):
    """None: `split` tells what is measured with."""
