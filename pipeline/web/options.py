"""Options of the stage that exports the deliverables. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from splatpipe.pipeline.engine.ranges import NonNegativeFloat
from splatpipe.pipeline.engine.stage import StageConfig
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS

EXPORT, WEB = "export", "web"
"""Folders under OUT that the formats are written to."""
FORMATS = (
    *(each.name for each in SPLAT_FORMATS if each.name != "ply"),
    "tiles",
    "streamed-sog",
    "web",
    "laz",
    "colmap",
    "transforms",
)
"""All names that `export.formats` takes: splat formats, and those that need a whole run; `splat.ply` is always
written."""


SURFACE_FORMATS = ("mesh-tiles", "copc", "mbtiles")
"""All names that `publish.formats` takes: formats of the surface products."""


def parse_formats(text: str) -> tuple[str, ...]:
    """The formats of a list like ``spz, glb``, each once, in the order of ``FORMATS``.

    Raises:
        ValueError: if a name is not one of them.
    """
    return _parse(text, FORMATS)


def parse_surface_formats(text: str) -> tuple[str, ...]:
    """The formats of a list like ``copc, mbtiles``, each once, in the order of ``SURFACE_FORMATS``.

    Raises:
        ValueError: if a name is not one of them.
    """
    return _parse(text, SURFACE_FORMATS)


def parse_any_formats(text: str) -> tuple[str, ...]:
    """The formats of a list of either kind.

    Raises:
        ValueError: if a name is of neither.
    """
    return _parse(text, (*FORMATS, *SURFACE_FORMATS))


def _parse(text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    asked = {name.strip() for name in text.split(",")} - {"", "ply"}
    unknown = sorted(asked - set(known))
    if unknown:
        raise ValueError(f"there is no format {unknown[0][:40]!r}; choose from {', '.join(('ply', *known))}")
    return tuple(name for name in known if name in asked)


def _checked(text: str) -> str:
    return ",".join(parse_formats(text))


def _checked_surface(text: str) -> str:
    return ",".join(parse_surface_formats(text))


class ExportConfig(StageConfig):
    formats: Annotated[str, AfterValidator(_checked)] = ""
    """Further formats, separated by commas, written to `export/` and `web/`; see docs/formats.md."""
    sky: bool = False
    """Also export the sky of `train.sky`: `sky.ply`, a dome of Gaussians around the splat, in the same frame."""
    title: Annotated[str, Field(max_length=200)] = "3D model"
    """Title of `viewer.html`, e.g. the building and the date."""
    viewer_megabytes: NonNegativeFloat = 60.0
    """Largest `viewer.html`, megabytes: a larger one loads `splat.spz` from beside it, which requires `splatpipe view`;
    0: no viewer."""


class PublishConfig(StageConfig):
    formats: Annotated[str, AfterValidator(_checked_surface)] = ""
    """Formats of the surface products for the web and phones, separated by commas, written to `export/`: mesh-tiles
    (3D Tiles of the mesh), copc (the cloud), mbtiles (orthophoto and surface model); see docs/formats.md."""
