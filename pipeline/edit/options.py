"""Options of cleaning. Light to import."""

from __future__ import annotations

from typing import Literal

from splatpipe.pipeline.engine.stage import StageConfig

SEEN_MEGAPIXELS = 0.3
"""Size of the renders that floaters are detected in: a floater that hides anything is larger than one of their
pixels."""


class CleanConfig(StageConfig):
    """Which of the trained Gaussians are delivered."""

    enabled: bool = True
    """Remove floaters, haze and Gaussians that no photo supports before the splat is evaluated and exported."""

    photos: Literal["all", "covering"] = "all"
    """Training photos with which likely floaters are compared; covering: √(12 n) of n or a few more, which show the
    scene. What none of them shows is kept."""

    @property
    def is_off(self) -> bool:
        """Always False: with cleaning disabled, the stage still passes the trained splat on to the later stages."""
        return False
