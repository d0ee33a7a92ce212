"""The model's accuracy at control points, check points and photo positions: ``control.json`` and ``accuracy.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.control.local_survey import LocalSurvey
from splatpipe.pipeline.survey.control.residuals import accuracy_table
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.points.located_points import Sighting, residual_px
from splatpipe.pipeline.survey.points.surveyed_points import Survey


@dataclass(frozen=True)
class GeoreferencedModel:
    """A model in the world frame.

    Attributes:
        model: The model that later stages use.
        world_from_model: Its similarity to the world frame.
        offsets: Offset of each flight's positions, stated minus true, metres.
    """

    model: SparseModel
    world_from_model: Similarity
    offsets: Float64[np.ndarray, "k 3"]


def no_control() -> JSON:
    """``control.json`` of a capture without control."""
    return {"points": []}


def control_json(
    survey: Survey, site: LocalSurvey, placed: GeoreferencedModel, photos: Mapping[str, Photo], mark_sigma_px: float
) -> JSON:
    """Return the contents of ``control.json``: every surveyed point, its estimated position and its marks; local
    metres.

    Residuals are estimated minus surveyed; in pixels, projected minus marked.
    """
    points = []
    for k, point in enumerate(survey.points):
        known = np.isfinite(site.targets.sigmas[k])
        place = None if point.found is None else placed.world_from_model.apply(point.found.xyz[None])[0]
        residual = None if place is None else _listed(place - site.targets.enu[k], known)
        stated = point.surveyed
        points.append(
            {
                "name": point.name,
                "role": point.role,
                "why": point.why,
                "surveyed_m": _listed(site.targets.enu[k], known),
                "sigma_m": [float(site.targets.sigmas[k, 0]), float(site.targets.sigmas[k, 2]) if known[2] else None],
                "surveyed_crs": [stated.x, stated.y, stated.z],
                "estimated_m": None if place is None else place.tolist(),
                "residual_m": residual,
                "observations": [
                    _observation(sighting, None if point.found is None else point.found.xyz, placed.model, photos)
                    for sighting in point.sightings
                ],
            }
        )
    return {
        "crs": survey.crs.text,
        "vertical": survey.crs.vertical,
        "file": survey.name,
        "sigma_pixel": mark_sigma_px,
        "points": points,
    }


def accuracy_json(
    survey: Survey | None,
    site: LocalSurvey | None,
    placed: GeoreferencedModel,
    gsd: float | None,
    uncertainty: JSON = None,
) -> JSON:
    """Return the contents of ``accuracy.json``: errors of positions, control and check points; absent groups are null.

    Args:
        survey: The surveyed points.
        site: The survey in the world frame.
        placed: The model in the world frame.
        gsd: Ground sampling distance, metres.
        uncertainty: Uncertainty of georeferencing by positions alone; null with control.
    """
    tables: dict[str, JSON] = {"gps": None, "control": None, "check": None}
    if site is not None and len(site.stations):
        stations = site.stations
        centres = placed.world_from_model.apply(placed.model.centres[stations.indices])
        residuals = centres + placed.offsets[stations.group] - site.station_enu
        if not stations.with_heights:
            residuals[:, 2] = np.nan  # the model's own heights tell nothing of the positions
        table = accuracy_table(residuals)
        flights = [
            {"flight": number, "photos": int((stations.group == k).sum()), "offset_m": placed.offsets[k].tolist()}
            for k, number in enumerate(stations.flights)
        ]
        tables["gps"] = None if table is None else {**table, "flights": flights}
    if survey is not None and site is not None:
        for role in ("control", "check"):
            errors = [
                np.where(
                    np.isfinite(site.targets.sigmas[k]),
                    placed.world_from_model.apply(point.found.xyz[None])[0] - site.targets.enu[k],
                    np.nan,
                )
                for k, point in enumerate(survey.points)
                if point.role == role and point.found is not None
            ]
            tables[role] = accuracy_table(np.array(errors, dtype=np.float64).reshape(-1, 3))
    return {"gsd_m": gsd, "tables": tables, "uncertainty": uncertainty}


def _listed(values: Float64[np.ndarray, " 3"], known: Sequence[bool] | np.ndarray) -> list[float | None]:
    return [float(value) if is_known else None for value, is_known in zip(values, known, strict=True)]


def _observation(
    sighting: Sighting, place: Float64[np.ndarray, " 3"] | None, model: SparseModel, photos: Mapping[str, Photo]
) -> JSON:
    residual = None if place is None else residual_px(sighting, place, model, photos)
    ray = None
    if sighting.index is not None:
        found = model.view(sighting.index, photos[sighting.photo].width).ray(np.array(sighting.pixel))
        ray = found.tolist() if np.isfinite(found).all() else None
    automatic = {"automatic": True} if sighting.automatic else {}
    return {
        "photo": sighting.photo,
        **automatic,
        "pixel": list(sighting.pixel),
        "ray": ray,
        "residual_px": None if residual is None else residual.tolist(),
        "used": bool(sighting.agrees and sighting.index is not None),
    }
