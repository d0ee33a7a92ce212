"""Options of the stages that hand it over. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from splatpipe.pipeline.engine.ranges import NonNegativeFloat
from splatpipe.pipeline.engine.stage import StageConfig
from splatpipe.pipeline.splat.formats import SPLAT_FORMATS

EXPORT, WEB = "export", "web"
"""Folders of the formats below OUT."""
FORMATS = (
    *(each.name for each in SPLAT_FORMATS if each.name != "ply"),
    "tiles",
    "streamed-sog",
    "web",
    "laz",
    "colmap",
    "transforms",
)
"""All that `export.formats` can name: a splat's, and those that take a run; `splat.ply` is always there."""


def format_names(text: str) -> tuple[str, ...]:
    """The formats of a list like ``spz, glb``, each once, in the order of ``FORMATS``.

    Raises:
        ValueError: if there is none of that name.
    """
    asked = {name.strip() for name in text.split(",")} - {"", "ply"}
    unknown = sorted(asked - set(FORMATS))
    if unknown:
        raise ValueError(f"there is no format {unknown[0][:40]!r}; choose from {', '.join(('ply', *FORMATS))}")
    return tuple(name for name in FORMATS if name in asked)


def _checked(text: str) -> str:
    return ",".join(format_names(text))


class ExportConfig(StageConfig):
    formats: Annotated[str, AfterValidator(_checked)] = ""
    """Further formats, separated by commas, into `export/` and `web/`; docs/formats.md lists them."""
    sky: bool = False
    """Hand over the sky of `train.sky`, too: `sky.ply`, a dome of Gaussians around the splat, in its frame."""
    title: Annotated[str, Field(max_length=200)] = "3D model"
    """What `viewer.html` is called, e.g. the building and the date."""
    viewer_megabytes: NonNegativeFloat = 60.0
    """A `viewer.html` that would be larger reads `splat.spz` beside it, which takes `splatpipe view`; 0 for none."""
