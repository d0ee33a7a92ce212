"""Options of the stages that place the model on the earth. Light to import."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from splatpipe.pipeline.engine.ranges import PositiveFloat
from splatpipe.pipeline.engine.stage import StageConfig


class ControlConfig(StageConfig):
    scale_bars: str = "auto"
    """File of distances between targets: a CSV with the columns `name_a,name_b,metres` and, if known, `sigma`. They
    give metres where no coordinates are known, and check the scale elsewhere. `auto`: `scale_bars.csv` in the photo
    folder or beside it; `none`: no bars."""


class TargetsConfig(StageConfig):
    search: bool = True
    """Look for targets in the photos, coded ones (ArUco, AprilTag) and black-and-white quadrants, where there are
    control points or scale bars; those found where the geometry has them count as marks."""


class GeorefConfig(StageConfig):
    max_position_error_m: Literal["auto"] | PositiveFloat = "auto"
    """Photo positions further than this from the robust fit are named and left out of it. Auto: the positions' noise is
    told from the residuals, and those that are off by far more are left out; poor positions place the model poorly, and
    how poorly is told."""
    control: str = "auto"
    """File of control and check points: `gcp_list.txt` (ODM) or a CSV with a header. `auto`: `gcp_list.txt` or
    `control.csv` in the photo folder or beside it; `none`: no control."""
    boundary: str = "auto"
    """GeoJSON file of the area that counts, in WGS 84, in the CRS that it names, or in the run's: Gaussians are spent
    and figures taken inside, what is outside stays coarse. `auto`: `boundary.geojson` in the photo folder or beside it;
    `none`: no boundary."""
    crs: Annotated[str, Field(max_length=500)] = "auto"
    """CRS of coordinates that are read out: `EPSG:25832`, with heights `EPSG:25832+7837`, `+proj=…`, `WGS84 UTM 32N`.
    Auto: the control file's, without one the capture's UTM zone."""
    vertical: Annotated[str, Field(max_length=40)] = "auto"
    """Vertical datum of the photos' heights: `ellipsoidal`, `EPSG:n` or `unknown`. Auto: what the files declare."""
    approximate_crs: bool = False
    """Take a CRS though the grid of its best way to WGS 84 is missing, or EPSG knows none from its (modern) datum; what
    that costs is stated in `georef.json`."""
    pixel_origin: Literal["corner", "centre"] = "corner"
    """What the pixel coordinates (0, 0) of marks mean: the top-left corner of the first pixel, or its centre."""
    check_points: Annotated[str, Field(max_length=20_000)] = "auto"
    """Points that take no part and tell the accuracy: names, separated by commas. `auto`: those that the file names so,
    else, of six or more, every third; `none`: every point is control."""
    control_sigma_m: Annotated[float, Field(ge=1e-4, le=1e3)] = 0.02
    """Horizontal standard deviation (each of two) of control points whose file states none; raised where they disagree
    with each other by more."""
    control_sigma_vertical_m: Annotated[float, Field(ge=1e-4, le=1e3)] = 0.03
    """The same of their heights."""
    mark_sigma_px: Annotated[float, Field(ge=0.01, le=100.0)] = 0.5
    """Standard deviation of a mark in a photo, pixels."""
    adjust: Literal["auto", "off"] = "auto"
    """`auto`: control enters a bundle adjustment; where it moves what the photos show by half a pixel or more, the bent
    model is used. `off`: it only places the model."""

    @field_validator("crs", "vertical")
    @classmethod
    def _known(cls, text: str, field: Any) -> str:
        """Told now, not after hours; PROJ is only loaded where something is named."""
        if text.strip().lower() == "auto":
            return "auto"
        from splatpipe.pipeline.survey.crs_names import checked

        return checked(text, str(field.field_name))
