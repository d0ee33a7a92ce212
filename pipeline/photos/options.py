"""Options of the stages that check photos and undistort them. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from splatpipe.pipeline.engine.ranges import NonNegativeInt, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig


class IngestConfig(StageConfig):
    masks: bool = True
    """Apply the masks in `masks/` (black is ignored) and `sky_masks/` (white is sky, for `train.sky`), beside or inside
    the photo folder. Masks have the file names of their photos. `NAME_mask.JPG` beside `NAME.JPG` is a mask, too."""
    min_size: PositiveInt = 320
    """Images whose longer side is shorter than this, in pixels, are left out: thumbnails and icons."""
    max_megapixels: Annotated[float, Field(gt=0.0, le=4000.0)] = 500.0
    """Larger images are left out without being decoded, because a small file can claim any size."""
    bands: str = "auto"
    """Of photos of several spectral bands, those that are used: `auto` takes the colour photos, or else the sharpest
    band; a band, such as `green` or `near infrared`; `all`: every photo, each band as a camera of its own."""
    max_frames: Annotated[int, Field(ge=3, le=100_000)] = 300
    """Of a film (`splatpipe run flight.mp4 OUT`), at most so many frames are used. If sharp ones that overlap by 70 to
    80 % are more, they are thinned evenly."""
    positions: str = "auto"
    """File of camera positions, which take precedence over those in the photos: `geo.txt` (ODM) or a CSV with a header.
    `auto`: `geo.txt` or `positions.csv` in the photo folder or beside it; `none`: only the photos' metadata."""
    lens: str = "auto"
    """One or more lens calibration files: COLMAP's `cameras.txt`, Metashape's XML, Pix4D's `.cam` or
    `calibrated_camera_parameters.txt`. `auto`: `lens.xml`, `lens.txt` or `lens.cam` in the photo folder or beside it;
    `none`: only the photos' metadata. `sparse.lens` sets whether the calibration is refined or held fixed."""


class UndistortConfig(StageConfig):
    max_megapixels: Annotated[float, Field(gt=0.005, le=200.0)] = 0.5
    """Size to which photos are reduced in the undistorted dataset; the upper limit for training and evaluation."""


class SplitConfig(StageConfig):
    every: NonNegativeInt = 8
    """Hold every n-th registered photo out of training, in order of name and starting with the first; 0: none."""
    views: str = ""
    """Hold out these photos instead: names separated by commas."""
