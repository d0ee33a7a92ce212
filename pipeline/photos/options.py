"""Options of the stages that check photos and undistort them. Light to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from splatpipe.pipeline.engine.ranges import NonNegativeInt, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig


class IngestConfig(StageConfig):
    masks: bool = True
    """Honour `masks/` (black is ignored) and `sky_masks/` (white is sky, for `train.sky`) beside or inside the photo
    folder, of the same names as the photos."""
    min_size: PositiveInt = 320
    """Pictures whose longer side is shorter, in pixels, are left out: thumbnails and icons."""
    max_megapixels: Annotated[float, Field(gt=0.0, le=4000.0)] = 500.0
    """Larger pictures are left out undecoded: a small file can claim any size."""
    positions: str = "auto"
    """File of the photos' positions, over what these say: `geo.txt` (ODM) or a CSV with a header. `auto`: `geo.txt` or
    `positions.csv` in the photo folder or beside it; `none`: only what the photos say."""
    lens: str = "auto"
    """File of a calibrated lens, or several: COLMAP's `cameras.txt`, Metashape's XML, Pix4D's `.cam` or
    `calibrated_camera_parameters.txt`. `auto`: `lens.xml`, `lens.txt` or `lens.cam` in the photo folder or beside it;
    `none`: only what the photos say. `sparse.lens` tells whether it is refined or held."""


class UndistortConfig(StageConfig):
    max_megapixels: Annotated[float, Field(gt=0.005, le=200.0)] = 0.5
    """Photos are reduced to this size in the dataset: the most that training and evaluation can use of them."""


class SplitConfig(StageConfig):
    every: NonNegativeInt = 8
    """Every n-th registered photo in name order, starting with the first, is held out of training; 0 for none."""
    views: str = ""
    """Names of photos to hold out instead, separated by commas."""
