"""The options of the stages that find the cameras. Light to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from splatpipe.pipeline.engine.ranges import NonNegativeInt, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig


class FeaturesConfig(StageConfig):
    extractor: Literal["sift", "opencv-sift"] = "sift"
    """`sift` is COLMAP's, the most points; `opencv-sift` takes a third of the time for a few points less."""
    max_image_size: Annotated[int, Field(ge=320, le=20000)] = 2000
    """Photos are reduced to this longer side, in pixels, before keypoints are looked for."""
    max_features: Annotated[int, Field(ge=100, le=100_000)] = 8192
    """Keypoints wanted a photo, the largest first; `sift` takes whole scales, so gives up to twice as many."""


class MatchesConfig(StageConfig):
    pairing: Literal["auto", "exhaustive", "spatial", "sequential", "retrieval"] = "auto"
    """Which pairs are matched: `auto` takes all for small sets, neighbours by position where there is GPS,
    sequence where names and times agree on one, else look-alikes."""
    exhaustive_up_to: PositiveInt = 30
    """`auto` matches every pair up to this many photos."""
    neighbours: Annotated[int, Field(ge=2, le=200)] = 20
    """Pairs a photo, for `spatial`, `sequential` and `retrieval`."""
    seed: NonNegativeInt = 0
    """Seed of the geometric verification (RANSAC)."""


class SparseConfig(StageConfig):
    mapper: Literal["auto", "incremental", "global"] = "auto"
    """How cameras are found: `incremental` adds photo after photo, `global` solves for all at once; `auto` judges the
    answer, and where it looks doubtful maps the other way, too, and takes the better one."""
    ladder: bool = True
    """Go after photos that could not be placed: more pairs, stronger keypoints, registration, joined sub-models."""
    lens: Literal["auto", "simple", "held"] = "auto"
    """`auto` frees principal point and further distortion where held-out matches improve; `simple` keeps focal length
    and one distortion coefficient; `held` keeps given lenses as they are."""
    min_model_size: Annotated[int, Field(ge=3)] = 3
    """Models of fewer photos are dropped."""
    seed: NonNegativeInt = 0
    """Seed of the mappers."""
