"""Checks a boundary against the photos before a run: broken, impossible to georeference, or somewhere else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatpipe.pipeline.app.preflight.findings import Finding
from splatpipe.pipeline.app.preflight.places import MIN_REACH_M
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.boundary import placed, placed_area
from splatpipe.pipeline.survey.crs.frames import Frame, Origin
from splatpipe.pipeline.survey.crs.world import in_crs
from splatpipe.pipeline.survey.files.boundary_file import read_boundary
from splatpipe.pipeline.survey.positions.photo_positions import Position

if TYPE_CHECKING:
    from splatpipe.pipeline.survey.options import GeorefConfig


def boundary_findings(path: Path, config: GeorefConfig, stated: Sequence[Position], controlled: bool) -> list[Finding]:
    """Read the boundary as a run does, and compare it with the photos' positions.

    Args:
        path: The file.
        config: The `georef` options of the run that would follow.
        stated: The photos' positions.
        controlled: Whether there is a GCP file, which can georeference a model whose photos have no positions.
    """
    try:
        drawing = read_boundary(path)
        findings = []
        if drawing.crossing:
            x, y = drawing.crossing
            text = f"The boundary {path.name} crosses itself near {x:.10g}, {y:.10g}."
            findings.append(
                Finding("boundary-crossing", "warning", text, "Redraw it so that it does not cross itself.")
            )
        if not stated:
            return [*findings, *([] if controlled else [_no_positions(path.name)])]
        geodetic = np.array([[each.latitude, each.longitude, each.altitude_m] for each in stated], dtype=np.float64)
        origin = Origin(*np.median(np.nan_to_num(geodetic), axis=0).tolist())
        frame = in_crs(Frame("enu", Similarity.identity(), origin), config.crs, "", config.approximate_crs)
        cameras = origin.enu_from_geodetic(np.nan_to_num(geodetic))
        area = placed_area(drawing, frame)
        vertices = np.concatenate([ring for polygon in area.polygons for ring in polygon])
        wide = float(np.linalg.norm(np.ptp(cameras[:, :2], axis=0)))
        apart = min(float(np.linalg.norm(vertices - camera, axis=1).min()) for camera in cameras[:, :2])
        if apart > max(wide, MIN_REACH_M):  # farther from all photos than the width of the flight
            placed(drawing, frame, cameras)  # raises an error with its location, unless it surrounds all of them
    except SplatpipeError as error:
        return [Finding("boundary-broken", "error", error.message, error.hint)]
    return findings


def _no_positions(name: str) -> Finding:
    text = f"The boundary {name} cannot be used with photos that have no positions."
    return Finding("boundary-broken", "error", text, "Give positions (geo.txt) or control points, or run without it.")
