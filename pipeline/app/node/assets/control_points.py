"""The surveyed points as ODM's clients read them: `ground_control_points.geojson`, with errors and marks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from splatpipe.pipeline.app.node.assets.earth import Earth
from splatpipe.pipeline.app.node.assets.shots import LON_LAT_DIGITS, METRE_DIGITS

CHECK = "CHK-"  # how WebODM knows a check point
SHARE_DIGITS = 7  # of a photo's side: a hundredth of a pixel of the largest ones


def control_geojson(
    control: Mapping[str, Any], earth: Earth, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, Any] | None:
    """A point for each surveyed one that the adjustment used or checked, at its surveyed place.

    Args:
        control: `georef.control`.
        earth: Where the run lies.
        sizes: Width and height of each placed photo by name.

    Returns:
        The file's content; None if there is no such point.
    """
    features = [
        feature
        for point in control.get("points", ())
        if point["role"] in ("control", "check") and (feature := _feature(point, earth, sizes)) is not None
    ]
    return {"type": "FeatureCollection", "features": features} if features else None


def _feature(point: Mapping[str, Any], earth: Earth, sizes: Mapping[str, tuple[int, int]]) -> dict[str, Any] | None:
    surveyed, estimated = point.get("surveyed_m"), point.get("estimated_m")
    if surveyed is None or estimated is None:
        return None
    # Where only plan or only height was surveyed, the rest is the estimated place.
    known = [own if own is not None else other for own, other in zip(surveyed, estimated, strict=True)]
    errors = [
        0.0 if each is None else round(float(each), METRE_DIGITS) for each in point.get("residual_m") or [None] * 3
    ]
    lon, lat, alt = earth.lon_lat_alt(np.array([known], np.float64))[0].tolist()
    seen = (_observation(each, sizes) for each in point["observations"])
    return {
        "type": "Feature",
        "properties": {
            "id": f"{CHECK if point['role'] == 'check' else ''}{point['name']}",
            "error": errors,
            "observations": [each for each in seen if each is not None],
        },
        "geometry": {
            "type": "Point",
            "coordinates": [round(lon, LON_LAT_DIGITS), round(lat, LON_LAT_DIGITS), round(alt, METRE_DIGITS)],
        },
    }


def _observation(seen: Mapping[str, Any], sizes: Mapping[str, tuple[int, int]]) -> dict[str, Any] | None:
    """A mark, and where the point is projected to, as shares of the photo's width and height."""
    size, residual = sizes.get(seen["photo"]), seen.get("residual_px")
    if size is None or residual is None or not seen.get("used", True):
        return None
    marked, side = np.array(seen["pixel"], np.float64), np.array(size, np.float64)
    shares = (marked / side, (marked + residual) / side)
    annotated, reprojected = ([round(float(each), SHARE_DIGITS) for each in share] for share in shares)
    return {"shot_id": seen["photo"], "annotated": annotated, "reprojected": reprojected}
