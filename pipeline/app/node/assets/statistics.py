"""A run's figures as ODM's clients read them: `stats.json`, of which WebODM shows area, GSD, dates and accuracy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.app.node.assets.clouds import CloudFacts
from splatpipe.pipeline.app.report.facts.overlap import overlap_s
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs

DATE = "%d/%m/%Y at %H:%M:%S"  # as in OpenSfM's statistics
DIGITS = 4  # of metres and centimetres
AXES = ("x", "y", "z")


def run_statistics(
    inputs: ReportInputs, cloud: CloudFacts | None, photos: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """`stats.json`.

    Args:
        inputs: The run.
        cloud: Facts of `cloud.laz`; None if there is none.
        photos: The checked photos, of `ingest.photos`.

    Raises:
        OSError: if a file cannot be read.
        ValueError: if one is broken.
    """
    accuracy, control = inputs.read("georef.accuracy"), inputs.read("georef.control")
    tables = accuracy.get("tables") or {}
    gsd_m = accuracy.get("gsd_m")
    seconds = {name: stage.seconds for name, stage in inputs.history.stages.items() if stage.seconds is not None}
    overlap = overlap_s(artifact.manifest for artifact in inputs.artifacts.values())
    moments = sorted(str(photo["time"]) for photo in photos if photo.get("time"))
    sparse = inputs.summary("sparse")
    points = [point for point in control.get("points", ()) if point.get("residual_m")]
    return {
        "odm_processing_statistics": {
            "total_time": round(sum(seconds.values()) - overlap, 1),
            **({} if gsd_m is None else {"average_gsd": round(100.0 * gsd_m, DIGITS)}),
        },
        "processing_statistics": {
            "steps_times": {name: round(value, 1) for name, value in seconds.items()},
            **({} if not moments else {"start_date": _date(moments[0]), "end_date": _date(moments[-1])}),
            **_listed("area", inputs.summary("dsm").get("area_m2")),
        },
        "point_cloud_statistics": _cloud(cloud),
        "reconstruction_statistics": {
            "components": 1 + int(sparse.get("other_models") or 0),
            "has_gps": tables.get("gps") is not None,
            "has_gcp": tables.get("control") is not None,
            "initial_shots_count": sparse.get("photos"),
            "reconstructed_shots_count": sparse.get("registered"),
            "reconstructed_points_count": sparse.get("points3d"),
            "average_track_length": sparse.get("mean_track_length"),
            "reprojection_error_pixels": sparse.get("mean_reprojection_error_px"),
        },
        **_listed("gcp_errors", _errors(point["residual_m"] for point in points if point["role"] == "control")),
        **_listed("check_point_errors", _errors(point["residual_m"] for point in points if point["role"] == "check")),
    }


def _listed(name: str, value: Any) -> dict[str, Any]:
    return {} if value is None else {name: value}


def _date(text: str) -> str:
    """A photo's own time in OpenSfM's format; as it is if it is none."""
    try:
        return datetime.fromisoformat(text).strftime(DATE)
    except ValueError:
        return text


def _cloud(cloud: CloudFacts | None) -> dict[str, Any]:
    if cloud is None:
        return {"dense": False, "stats": {"statistic": []}}
    bounds = zip("XYZ", *cloud.box.tolist(), strict=True)
    listed = [{"name": name, "count": cloud.count, "minimum": low, "maximum": high} for name, low, high in bounds]
    return {"dense": True, "stats": {"statistic": listed}}


def _errors(residuals: Iterable[Sequence[float | None]]) -> dict[str, Any] | None:
    """Means, deviations and root mean squares of residuals (metres), and their mean length; None without any."""
    whole = [[float(value) for value in each if value is not None] for each in residuals]
    errors: Float64[np.ndarray, "n 3"] = np.array([each for each in whole if len(each) == len(AXES)]).reshape(-1, 3)
    if not len(errors):
        return None
    figures = {"mean": errors.mean(axis=0), "std": errors.std(axis=0), "error": np.sqrt((errors**2).mean(axis=0))}
    named = {name: dict(zip(AXES, np.round(values, DIGITS).tolist(), strict=True)) for name, values in figures.items()}
    return {**named, "average_error": round(float(np.linalg.norm(errors, axis=1).mean()), DIGITS)}
