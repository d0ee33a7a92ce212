"""Options of the film. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from splatpipe.pipeline.engine.stage import StageConfig

MOST_FILM_MEGAPIXELS = 2.0736
"""Of a film that nobody gave a size: 1920 × 1080. Screens that show more are few, and 20 megapixels a frame take a
gigabyte of memory and the night."""


class FlythroughConfig(StageConfig):
    seconds: Annotated[float, Field(ge=0.0, le=600.0)] = 10.0
    """Length of `flythrough.webm`, a film along a smooth way through the cameras; 0: none. A time budget keeps time for
    10 seconds, from ten minutes on."""
    fps: Annotated[int, Field(ge=1, le=120)] = 25
    """Frames a second."""
    size: Annotated[str, Field(pattern=r"^(auto|[0-9]{2,4}x[0-9]{2,4})$")] = "auto"
    """Width and height in pixels, even, such as 1280x720. Auto: 16:9, as many pixels as the photos have in training,
    at most 1920x1080."""

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
