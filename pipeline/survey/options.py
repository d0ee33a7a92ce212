"""Options of georeferencing. Light to import."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from splatpipe.pipeline.engine.ranges import PositiveFloat
from splatpipe.pipeline.engine.stage import StageConfig


class ControlConfig(StageConfig):
    scale_bars: str = "auto"
    """File of distances between targets: a CSV with the columns `name_a,name_b,metres` and, optionally, `sigma`. Scale
    bars give metric scale without coordinates, and check the scale otherwise. `auto`: `scale_bars.csv` in the photo
    folder or beside it; `none`: no scale bars."""


class TargetsConfig(StageConfig):
    search: bool = True
    """Detect coded targets (ArUco, AprilTag) and black-and-white quadrants in the photos, if there are control points
    or scale bars; detections that agree with the geometry count as marks."""


class GeorefConfig(StageConfig):
    max_position_error_m: Literal["auto"] | PositiveFloat = "auto"
    """Camera positions further than this from the robust fit are reported and left out of it. Auto: the noise of the
    positions is estimated from the residuals, and positions that are off by far more are left out. Poor positions place
    the model poorly; the accuracy is reported."""
    control: str = "auto"
    """File of ground control points and check points: `gcp_list.txt` (ODM) or a CSV with a header. `auto`:
    `gcp_list.txt` or `control.csv` in the photo folder or beside it; `none`: no control."""
    boundary: str = "auto"
    """GeoJSON file of the area of interest, in WGS 84, in the CRS it names, or in the run's. Gaussians and quality
    figures concentrate on the inside; the outside stays coarse. `auto`: `boundary.geojson` in the photo folder or
    beside it; `none`: no boundary."""
    crs: Annotated[str, Field(max_length=500)] = "auto"
    """CRS of output coordinates: `EPSG:25832`, with heights `EPSG:25832+7837`, `+proj=…`, `WGS84 UTM 32N`. Auto: that
    of the control file, or without one the capture's UTM zone."""
    vertical: Annotated[str, Field(max_length=40)] = "auto"
    """Vertical datum of the photos' heights: `ellipsoidal`, `EPSG:n` or `unknown`. Auto: as declared in the files."""
    approximate_crs: bool = False
    """Accept a CRS although the grid for its best transformation to WGS 84 is missing, or EPSG has no transformation
    from its (modern) datum; the loss of accuracy is stated in `georef.json`."""
    pixel_origin: Literal["corner", "centre"] = "corner"
    """Meaning of pixel coordinates (0, 0) in marks: the top-left corner of the first pixel, or its centre."""
    check_points: Annotated[str, Field(max_length=20_000)] = "auto"
    """Points that are left out of the fit and used to measure accuracy: names separated by commas. `auto`: the check
    points named in the control file, otherwise every third of six or more points; `none`: every point is control."""
    control_sigma_m: Annotated[float, Field(ge=1e-4, le=1e3)] = 0.02
    """Horizontal standard deviation (per axis) of control points whose file states none, metres; increased if the
    points disagree with each other by more."""
    control_sigma_vertical_m: Annotated[float, Field(ge=1e-4, le=1e3)] = 0.03
    """Vertical standard deviation of control points whose file states none, metres."""
    mark_sigma_px: Annotated[float, Field(ge=0.01, le=100.0)] = 0.5
    """Standard deviation of a mark in a photo, pixels."""
    adjust: Literal["auto", "off"] = "auto"
    """`auto`: control and accurate positions (RTK, PPK; up to 0.5 m) enter a bundle adjustment with the lens; if that
    moves image points by half a pixel or more, the adjusted model is used. `off`: they only place the model."""

    @field_validator("crs", "vertical")
    @classmethod
    def _known(cls, text: str, field: Any) -> str:
        """Reject an unknown name at once, not hours into a run; PROJ is loaded only if a name is given."""
        if text.strip().lower() == "auto":
            return "auto"
        from splatpipe.pipeline.survey.crs.crs_names import checked

        return checked(text, str(field.field_name))
