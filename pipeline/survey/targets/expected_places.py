"""Predict where photos show control points before any mark is made, from the photos' own positions."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.crs.crs import parse_crs, to_geodetic
from splatpipe.pipeline.survey.crs.frames import Frame, Origin
from splatpipe.pipeline.survey.placing.fitting import FrameUndeterminedError
from splatpipe.pipeline.survey.placing.gps import georeference
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.targets.target_finds import WantedTargets

Window = tuple[int, int, int, int]  # left, top, right, bottom; the latter two exclusive
MIN_RADIUS_M = 8.0  # consumer receivers share an error of several metres, whatever they state
RADIUS_SIGMAS = 4.0
NEAR_M = 15.0  # radius around a point in which sparse points give the ground's height
MIN_NEAR = 5
WHOLE_PHOTO_SHARE = 0.6  # share of a photo's area above which a window becomes the whole photo


def expected_windows(
    wanted: WantedTargets,
    model: SparseModel,
    positions: Positions,
    photos: Mapping[str, Photo],
    settings: Mapping[str, JSON],
) -> dict[str, Window]:
    """The window of each posed photo that is worth searching.

    Args:
        wanted: With scale bars, or without photo positions, every photo is searched whole.
        model: The sparse model.
        positions: The photos' stated positions.
        photos: All photos of the capture by name.
        settings: georef's ``max_position_error_m`` and ``approximate_crs``.
    """
    posed = {name: index for index, name in enumerate(model.names) if name in photos}
    whole = {name: (0, 0, photos[name].width, photos[name].height) for name in posed}
    if wanted.bars:
        return whole
    try:
        limit = settings["georef.max_position_error_m"]
        frame, _ = georeference(model, positions, limit, photos)
        places = expected_enu(wanted, frame, model, bool(settings["georef.approximate_crs"]))
    except (FrameUndeterminedError, SplatpipeError):  # without positions, or with a CRS that georef will report
        return whole
    stated = [r.get("sigma_horizontal_m") for r in positions.by_name.values()]
    sigmas = [float(sigma) for sigma in stated if sigma is not None]
    radius = max(MIN_RADIUS_M, RADIUS_SIGMAS * float(np.median(sigmas)) if sigmas else 0.0)
    radius /= frame.world_from_model.scale
    inside = frame.world_from_model.inverse().apply(places)
    found = {name: _window(inside, radius, model, index, photos[name]) for name, index in posed.items()}
    return {name: window for name, window in found.items() if window is not None}


def expected_enu(
    wanted: WantedTargets, frame: Frame, model: SparseModel, approximate: bool
) -> Float64[np.ndarray, "n 3"]:
    """East, north, up of the points in the frame of positions, with all heights shifted to the model's ground.

    Heights of receivers and of surveys may differ by an unstated datum; the ground is the same.

    Raises:
        SplatpipeError: if the CRS cannot be used.
    """
    assert frame.origin is not None
    stated = np.array([[x, y, math.nan if z is None else z] for _, x, y, z in wanted.points], dtype=np.float64)
    geodetic = to_geodetic(stated, parse_crs(wanted.crs), approximate).geodetic
    enu = frame.origin.enu_from_geodetic(np.where(np.isfinite(geodetic), geodetic, frame.origin.height_m))
    cloud = frame.world_from_model.apply(model.points)
    ground = np.full(len(enu), np.nan)
    for k, place in enumerate(enu):
        near = np.linalg.norm(cloud[:, :2] - place[:2], axis=1) < NEAR_M
        if near.sum() >= MIN_NEAR:
            ground[k] = np.median(cloud[near, 2])
    known = np.isfinite(stated[:, 2])
    lifts = (ground - enu[:, 2])[known & np.isfinite(ground)]
    enu[known, 2] += float(np.median(lifts)) if len(lifts) else 0.0
    middle = float(np.median(cloud[:, 2])) if len(cloud) else 0.0
    enu[~known, 2] = np.where(np.isfinite(ground), ground, middle)[~known]
    return enu


def free_enu(wanted: WantedTargets, approximate: bool) -> Float64[np.ndarray, "n 3"]:
    """East, north, up (metres) of the points about the first one and their median height; unknown heights are NaN.

    Raises:
        SplatpipeError: if the CRS cannot be used.
    """
    stated = np.array([[x, y, math.nan if z is None else z] for _, x, y, z in wanted.points], dtype=np.float64)
    geodetic = to_geodetic(stated, parse_crs(wanted.crs), approximate).geodetic
    height = float(np.nanmedian(geodetic[:, 2])) if np.isfinite(geodetic[:, 2]).any() else 0.0
    origin = Origin(float(geodetic[0, 0]), float(geodetic[0, 1]), height)
    enu = origin.enu_from_geodetic(np.where(np.isfinite(geodetic), geodetic, height))
    enu[~np.isfinite(geodetic[:, 2]), 2] = np.nan
    return np.asarray(enu)


def _window(
    places: Float64[np.ndarray, "n 3"], radius: float, model: SparseModel, index: int, photo: Photo
) -> Window | None:
    """The part of a photo that may show places known to within a radius (model units); None where it shows none."""
    view = model.view(index, photo.width)
    seen = places @ view.cam_from_model[:, :3].T + view.cam_from_model[:, 3]
    seen = seen[seen[:, 2] > radius * 0.25]
    if len(seen) == 0:
        return None
    reach = view.camera.mean_focal_length() / view.scale * radius / seen[:, 2]
    # Without lens distortion, which is small compared with the radius and folds pixels over far outside the photo.
    focal, middle = view.camera.mean_focal_length() / view.scale, np.array([photo.width, photo.height]) / 2.0
    pixels = middle + focal * seen[:, :2] / seen[:, 2:]
    low, high = np.maximum(pixels - reach[:, None], 0.0), pixels + reach[:, None]
    high = np.minimum(high, [photo.width, photo.height])
    visible = (high - low > 1.0).all(axis=1)
    if not visible.any():
        return None
    left, top = np.floor(low[visible].min(axis=0)).astype(int).tolist()
    right, bottom = np.ceil(high[visible].max(axis=0)).astype(int).tolist()
    if (right - left) * (bottom - top) > WHOLE_PHOTO_SHARE * photo.width * photo.height:
        return 0, 0, photo.width, photo.height
    return left, top, right, bottom
