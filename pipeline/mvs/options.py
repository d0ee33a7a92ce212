"""Options of the stages that initialize the splat and estimate depth maps. Light to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from splatpipe.pipeline.engine.ranges import PositiveFloat, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig

DENSE_MEGAPIXELS = 0.05  # per photo: most depths are accurate to 0.5 %


class InitializeConfig(StageConfig):
    max_gaussians: PositiveInt = 1_000_000
    """Maximum number of sparse points that become Gaussians; those observed in the most photos come first."""
    opacity: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.3
    """Initial opacity. The published value is 0.1, with which walls remain a fog whose depth lies behind the
    surface."""
    max_angle: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1
    """Upper limit on a Gaussian's initial size, as a fraction of its distance to the nearest camera; limits
    outliers."""
    dense: bool = True
    """Add points by PatchMatch between neighbouring photos where the sparse points are thin: 0.6 CPU seconds per photo.
    At most 50,000 are added; together with the sparse points they fill at most half of the cap on Gaussians, which
    leaves room for densification."""
    max_megapixels: PositiveFloat = DENSE_MEGAPIXELS
    """Photos are reduced to this size before dense points are estimated from them; the time is proportional to it."""
    photos: Literal["all", "covering"] = "all"
    """Photos that dense points are estimated from: all training photos, or √(48 n) of n (`covering`), or a few more,
    which show the scene."""


class DepthsConfig(StageConfig):
    enabled: bool = True
    """Estimate a depth map for every photo; the surface products are made from them."""
    max_megapixels: PositiveFloat = 1.2
    """Photos are reduced to this size before their depths are estimated: 9 to 13 CPU seconds per megapixel."""
