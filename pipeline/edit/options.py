"""Options of cleaning. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.stage import StageConfig

SEEN_MEGAPIXELS = 0.3
"""Of the photos' pictures that tell what floats: a floater that hides something is larger than their pixels."""


class CleanConfig(StageConfig):
    """What is delivered of the trained splat."""

    enabled: bool = True
    """Remove floaters, haze and what no photo shows before the splat is measured and delivered."""

    @property
    def is_off(self) -> bool:
        """Never: where nothing is removed, the splat as it was trained is its answer, and what follows reads that."""
        return False
