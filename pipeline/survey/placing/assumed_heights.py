"""Heights for positions without altitudes, from the model itself, so that the horizontal ones can place it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.upright import rotation_to_up
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.placing.fitting import MIN_POSITIONS
from splatpipe.pipeline.survey.placing.level import UP_SIGMA_RAD, Positions, gimbal_rotation, upright_cameras
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.placing.position_spread import spread_of

ASSUMED = "assumed"  # an altitude's source
LONG_PAIR_QUANTILE = 0.5  # share of the pairs of cameras, the longest, that give the scale: errors change it less
MAX_PAIRED = 500  # cameras
MIN_SIGMA_M = 1.0


def with_assumed_heights(model: SparseModel, positions: Positions) -> Positions:
    """Complete positions of which hardly any has an altitude; others are returned as they are.

    The model is turned upright by its cameras and scaled by the horizontal positions. Its heights, counted from the
    median of its points, then serve as altitudes. They add no knowledge: they keep the model as upright as the cameras
    show it to be, and their standard deviation is what an error of that up direction makes of them.

    Args:
        model: The sparse model.
        positions: The photos' stated positions.
    """
    index = {name: k for k, name in enumerate(model.names) if name in positions.by_name}
    stated = [name for name in index if positions.by_name[name]["altitude_m"] is not None]
    if len(stated) >= MIN_POSITIONS or len(index) < MIN_POSITIONS:
        return positions
    records = [positions.by_name[name] for name in index]
    if spread_of([(record["latitude"], record["longitude"], 0.0) for record in records]).too_few:
        return positions
    gimbal = gimbal_rotation(model, positions)
    upright = gimbal if gimbal is not None else rotation_to_up(upright_cameras(model, positions).up)
    cameras = model.centres[list(index.values())] @ upright.T
    scale = _horizontal_scale(cameras[:, :2], records)
    if scale is None:
        return positions
    floor = float(np.median((model.points @ upright.T)[:, 2])) if len(model.points) else float(cameras[:, 2].min())
    sigma = max(MIN_SIGMA_M, scale * float(np.ptp(cameras[:, :2], axis=0).max()) * math.tan(UP_SIGMA_RAD))
    heights = (scale * (cameras[:, 2] - floor)).tolist()
    assumed = {
        name: {**record, "altitude_m": height, "altitude_source": ASSUMED, "sigma_vertical_m": sigma}
        for name, record, height in zip(index, records, heights, strict=True)
    }
    return replace(positions, by_name={**positions.by_name, **assumed})


def _horizontal_scale(cameras: Float64[np.ndarray, "n 2"], records: Sequence[Mapping[str, Any]]) -> float | None:
    """Metres per unit of an upright model, the median over distant pairs of cameras; None if there is none."""
    step = math.ceil(len(records) / MAX_PAIRED)
    geodetic = np.array([[r["latitude"], r["longitude"], 0.0] for r in records], dtype=np.float64)
    stated = Origin(*geodetic[0]).enu_from_geodetic(geodetic)[::step, :2]
    first, second = np.triu_indices(len(stated), 1)
    ours = np.linalg.norm(cameras[::step][first] - cameras[::step][second], axis=1)
    theirs = np.linalg.norm(stated[first] - stated[second], axis=1)
    long = ours >= np.quantile(ours, LONG_PAIR_QUANTILE)
    scale = float(np.median(theirs[long] / np.maximum(ours[long], 1e-300)))
    return scale if 0.0 < scale < math.inf and ours.any() else None
