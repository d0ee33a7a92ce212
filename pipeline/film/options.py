"""Options of the film. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from splatpipe.pipeline.engine.stage import StageConfig

MAX_FILM_MEGAPIXELS = 2.0736
"""Largest film if no size is given: 1920 × 1080. Few screens show more, and frames of 20 megapixels take a gigabyte of
memory and all night."""


class FlythroughConfig(StageConfig):
    seconds: Annotated[float, Field(ge=0.0, le=600.0)] = 10.0
    """Length of `flythrough.webm`, a film along a smooth path through the cameras; 0: no film. Time budgets of ten
    minutes or more reserve time for a film of 10 seconds."""
    fps: Annotated[int, Field(ge=1, le=120)] = 25
    """Frames per second."""
    size: Annotated[str, Field(pattern=r"^(auto|[0-9]{2,4}x[0-9]{2,4})$")] = "auto"
    """Width and height in pixels, both even, such as 1280x720. Auto: 16:9 with as many pixels as the training photos
    have, at most 1920x1080."""

    @field_validator("size")
    @classmethod
    def _even(cls, text: str) -> str:
        if text != "auto" and any(int(side) % 2 or not 16 <= int(side) <= 8192 for side in text.split("x")):
            raise ValueError("a film's width and height are even, from 16 to 8192")
        return text

    @property
    def film_size(self) -> tuple[int, int] | None:
        """``size`` as numbers; None for auto."""
        width, _, height = self.size.partition("x")
        return (int(width), int(height)) if height else None
