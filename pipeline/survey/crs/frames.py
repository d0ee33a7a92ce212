"""The frame of a reconstruction: where its model lies in the world, and how well that is known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json
from splatpipe.pipeline.geometry.alignment import Correspondences, DirectionPrior, SimilarityFit, robust_similarity
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.crs.geodesy import Origin, ecef_from_geodetic, geodetic_from_ecef

__all__ = [
    "Correspondences",
    "DirectionPrior",
    "Frame",
    "Origin",
    "Similarity",
    "SimilarityFit",
    "Undetermined",
    "ecef_from_geodetic",
    "geodetic_from_ecef",
    "load_frame",
    "robust_similarity",
    "save_frame",
]

FRAME_KINDS = ("enu", "arbitrary")


@dataclass(frozen=True)
class Frame:
    """A model's placement in the world.

    Attributes:
        kind: ``enu``: the world is local east-north-up in metres about ``origin``. ``arbitrary``: up is +z, but scale,
            position and heading are meaningless.
        world_from_model: From the model's frame to the world's.
        origin: The world's zero on the earth; None when arbitrary.
        vertical_datum: Of the world's heights, which are as stated: ``ellipsoidal``, ``EPSG:n``, or ``unknown`` if not
            declared.
        crs: The CRS of output coordinates, as ``parse_crs`` accepts it; empty for the UTM zone of ``origin``.
        metres: Whether an arbitrary frame is nevertheless in metres, by scale bars.
        approximate_crs: Whether the user accepts the CRS although one of its grids is missing.
        residuals: ``rmse_horizontal_m``, ``rmse_vertical_m``, ``rmse_m`` of the photos used, how many there are, the
            standard deviations of scale and rotation, and east, north, up of each photo by name (metres).
        left_out: Photos whose position is off, sorted.
        note: What the frame was computed from, as a sentence.
    """

    kind: Literal["enu", "arbitrary"]
    world_from_model: Similarity
    origin: Origin | None = None
    vertical_datum: str = "unknown"
    residuals: Mapping[str, Any] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    note: str = ""
    crs: str = ""
    approximate_crs: bool = False
    metres: bool = False

    @property
    def in_metres(self) -> bool:
        """Whether lengths are metres."""
        return self.origin is not None or self.metres


@dataclass(frozen=True)
class Undetermined:
    """A frame that neither positions nor control determine.

    Attributes:
        why: The reason, a sentence without its full stop.
    """

    why: str


def save_frame(frame: Frame, path: Path) -> None:
    """Write a frame as JSON; numbers read back as the same float64."""
    similarity = frame.world_from_model
    origin = frame.origin
    value = {
        "kind": frame.kind,
        "origin": None
        if origin is None
        else {"latitude": origin.latitude, "longitude": origin.longitude, "height_m": origin.height_m},
        "vertical_datum": frame.vertical_datum,
        "crs": frame.crs,
        "approximate_crs": frame.approximate_crs,
        "world_from_model": similarity.matrix().tolist(),
        "scale": similarity.scale,
        "rotation": similarity.rotation.tolist(),
        "translation": similarity.translation.tolist(),
        "residuals": dict(frame.residuals),
        "left_out": list(frame.left_out),
        "note": frame.note,
    }
    if frame.metres:
        value["metres"] = True
    write_json(path, value)


def load_frame(path: Path) -> Frame:
    """Read a frame.

    Raises:
        SplatpipeError: if the file is missing or broken.
    """
    try:
        value: dict[str, Any] = read_json(path)
        similarity = Similarity(
            float(value["scale"]),
            np.array(value["rotation"], dtype=np.float64).reshape(3, 3),
            np.array(value["translation"], dtype=np.float64).reshape(3),
        )
        Similarity.from_matrix(similarity.matrix())
        if value["kind"] not in FRAME_KINDS or not math.isfinite(similarity.scale):
            raise ValueError(f"kind {value['kind']!r}")
        return Frame(
            kind=value["kind"],
            world_from_model=similarity,
            origin=None if value["origin"] is None else Origin(**value["origin"]),
            vertical_datum=value["vertical_datum"],
            residuals=value["residuals"],
            left_out=tuple(value["left_out"]),
            note=value["note"],
            crs=str(value.get("crs", "")),
            metres=bool(value.get("metres", False)),
            approximate_crs=bool(value.get("approximate_crs", False)),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatpipeError(f"The frame {path} cannot be read: {error}", "Run again with --rerun georef.") from error
