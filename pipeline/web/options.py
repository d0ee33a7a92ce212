"""Options of the stages that hand it over. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from splatpipe.pipeline.engine.ranges import NonNegativeFloat
from splatpipe.pipeline.engine.stage import StageConfig


class ExportConfig(StageConfig):
    sky: bool = False
    """Hand over the sky of `train.sky`, too: `sky.ply`, a dome of Gaussians around the splat, in its frame."""
    title: Annotated[str, Field(max_length=200)] = "3D model"
    """What `viewer.html` is called, e.g. the building and the date."""
    viewer_megabytes: NonNegativeFloat = 60.0
    """A `viewer.html` that would be larger reads `splat.spz` beside it, which takes `splatpipe view`; 0 for none."""
