"""What georeferencing starts from: a model, its photos and their positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.adjustment.position_adjustment import LensKnowledge, PositionAdjustment
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel


@dataclass(frozen=True)
class AdjustedPositions:
    """The outcome of an adjustment to positions.

    Attributes:
        done: The adjustment.
        moved_px: RMS shift of what the photos show.
        adopted: Whether the adjusted model is used; otherwise it is too close to the model before.
        names: Photos with a position, in the order of capture.
        flights: Numbers of the flights, in the order of the adjustment's offsets.
    """

    done: PositionAdjustment
    moved_px: float
    adopted: bool
    names: tuple[str, ...]
    flights: tuple[int, ...]


@dataclass(frozen=True)
class GeorefInput:
    """Input of georeferencing.

    Attributes:
        model: The sparse model.
        positions: The photos' stated positions.
        photos: All photos of the capture by name.
        lenses: What is known of the cameras, by COLMAP camera id.
        lenses_held: Whether the interior orientation is kept fixed.
        adjusted: The adjustment of accurate positions, whose model this is; None without.
    """

    model: SparseModel
    positions: Positions
    photos: Mapping[str, Photo]
    lenses: Mapping[int, LensKnowledge]
    lenses_held: bool = False
    adjusted: AdjustedPositions | None = None
