"""Options of the stages that start the splat. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from splatpipe.pipeline.engine.ranges import PositiveFloat, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig


class InitializeConfig(StageConfig):
    max_gaussians: PositiveInt = 1_000_000
    """At most this many sparse points become Gaussians, those seen in most photos first."""
    opacity: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.3
    """Opacity at the start. Published: 0.1, from which walls stay a fog whose depth lies behind its front."""
    max_angle: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1
    """Cap on a Gaussian's size for outliers, as a share of its distance to the nearest camera."""
    dense: bool = True
    """Add points where the sparse ones are thin, by PatchMatch between neighbouring photos: 0.6 CPU seconds a
    photo. At most 50,000; with the sparse ones they fill half of the training's cap at most, so that it can grow."""


class DepthsConfig(StageConfig):
    enabled: bool = True
    """Find depths of all photos, which surface products are made from."""
    max_megapixels: PositiveFloat = 1.2
    """Photos are made this small before their depths are found: 10 to 14 CPU seconds a megapixel."""
