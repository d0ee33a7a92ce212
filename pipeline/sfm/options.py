"""Options of structure from motion. Light to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from splatpipe.pipeline.engine.ranges import NonNegativeInt, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig


class FeaturesConfig(StageConfig):
    extractor: Literal["sift", "opencv-sift"] = "sift"
    """`sift` is COLMAP's and finds the most keypoints; `opencv-sift` takes a third of the time and finds slightly
    fewer."""
    max_image_size: Annotated[int, Field(ge=320, le=20000)] = 2000
    """Photos are reduced to this longer side, in pixels, before keypoint detection."""
    max_features: Annotated[int, Field(ge=100, le=100_000)] = 8192
    """Target number of keypoints per photo, largest scales first; `sift` keeps whole scales, so it may return up to
    twice as many."""


class MatchesConfig(StageConfig):
    pairing: Literal["auto", "exhaustive", "spatial", "sequential", "retrieval"] = "auto"
    """Which pairs of photos are matched. `auto`: all pairs in small sets, neighbours by position if there is GPS,
    sequential if names and times agree on an order, otherwise retrieval by image similarity."""
    exhaustive_up_to: PositiveInt = 30
    """`auto` matches all pairs of up to this many photos."""
    neighbours: Annotated[int, Field(ge=2, le=200)] = 20
    """Partners per photo for `spatial`, `sequential` and `retrieval`."""
    seed: NonNegativeInt = 0
    """Random seed of geometric verification (RANSAC)."""


class SparseConfig(StageConfig):
    mapper: Literal["auto", "incremental", "global"] = "auto"
    """How cameras are estimated: `incremental` adds one photo after another, `global` solves for all at once; `auto`
    checks the incremental result and, if it is doubtful, runs the other mapper as well and keeps the better result."""
    ladder: bool = True
    """Try to register photos that mapping left out: more pairs, stronger keypoints, registration to the finished model,
    joining of sub-models."""
    lens: Literal["auto", "simple", "held"] = "auto"
    """`auto` frees the principal point and further distortion terms if that improves the prediction of held-out tracks;
    `simple` keeps the focal length and one distortion coefficient; `held` keeps given calibrations fixed."""
    min_model_size: Annotated[int, Field(ge=3)] = 3
    """Models with fewer photos are dropped."""
    seed: NonNegativeInt = 0
    """Random seed of the mappers."""
