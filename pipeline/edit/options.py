"""Options of cleaning. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.stage import StageConfig

SEEN_MEGAPIXELS = 0.3
"""Of the photos' pictures that tell what floats: a floater that hides something is larger than their pixels."""


class CleanConfig(StageConfig):
    """What is delivered of the trained splat."""

    enabled: bool = True
    """Remove floaters, haze and what no photo shows before the splat is measured and delivered."""
