"""Evidence beyond the verified matches: how well the lens is determined, and the photos' stated positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.geometry.robust import absolute_weights, robust_similarity
from splatpipe.pipeline.sfm.judging.judging import Reason, is_trusted
from splatpipe.pipeline.sfm.lenses.focal import undetermined_sigma
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.pairing.layout import EARTH_RADIUS_M

MIN_POSITIONS = 8  # photos; a similarity fits fewer too easily
IRLS_ROUNDS = 30  # rounds of iteratively reweighted least squares
# median residual over the stated error, and over the flight's size, that noise does not explain
MIN_RESIDUAL_SIGMAS, MIN_RESIDUAL_SHARE = 5.0, 0.04
# difference of neighbouring residuals over their length: about 1.4 for noise, almost 0 for a bend
MAX_NEIGHBOUR_DIFFERENCE = 0.5


@dataclass(frozen=True)
class PositionMisfit:
    """Misfit between a model and stated positions after a robust similarity fit.

    Attributes:
        median_m: Median length of the residuals.
        size_m: Root mean square distance of the positions from their mean.
        smooth: Median difference of a residual from that of the nearest camera, over ``median_m``.
    """

    median_m: float
    size_m: float
    smooth: float


def outside_reasons(
    model: pycolmap.Reconstruction, verified: ViewGraph, cameras: Sequence[JSON], positions: Sequence[JSON]
) -> list[Reason]:
    """Return reasons for doubt that the matches themselves cannot reveal.

    Args:
        model: In any frame.
        verified: Its view graph, with the cameras as they were before mapping.
        cameras: The camera groups of ``ingest.cameras``.
        positions: The entries of ``positions.json``.
    """
    return [*_uncertain_focal_lengths(model, verified, cameras), *_positions(model, positions)]


def _uncertain_focal_lengths(
    model: pycolmap.Reconstruction, verified: ViewGraph, cameras: Sequence[JSON]
) -> list[Reason]:
    used = sorted({model.images[number].camera_id for number in model.reg_image_ids()})
    rough = [number for number in used if not is_trusted(cameras[number - 1])]
    if not rough:
        return []
    worst = undetermined_sigma(model, rough)
    if not worst:
        return []
    known = all(verified.cameras[number].has_prior_focal_length for number in rough)
    accuracy = f"to {100.0 * worst:.0f} %" if math.isfinite(worst) else "not at all"
    text = f"The photos determine the focal length {accuracy}, and "
    text += "the value in the metadata is only approximate." if known else "it is not in the metadata."
    return [
        Reason("doubt", text, "Add oblique photos or a second height, or compare distances with known ones.", "lens")
    ]


def _positions(model: pycolmap.Reconstruction, positions: Sequence[JSON]) -> list[Reason]:
    known = {entry["name"]: entry for entry in positions if entry["altitude_m"] is not None}
    images = [model.images[number] for number in sorted(model.reg_image_ids())]
    images = [image for image in images if image.name in known]
    if len(images) < MIN_POSITIONS:
        return []
    entries = [known[image.name] for image in images]
    sigma = float(np.median([max(entry["sigma_horizontal_m"], entry["sigma_vertical_m"]) for entry in entries]))
    off = disagreement(np.array([image.projection_center() for image in images]), _metres(entries))
    if (
        off.median_m < max(MIN_RESIDUAL_SIGMAS * sigma, MIN_RESIDUAL_SHARE * off.size_m)
        or off.smooth > MAX_NEIGHBOUR_DIFFERENCE
    ):
        return []
    text = (
        f"The cameras are {off.median_m:.0f} m (median) from the photos' stated positions, with similar offsets "
        "for neighbours: "
    )
    text += "the model may be bent, or the positions may have drifted."
    return [Reason("doubt", text, "Add control points, or compare a known distance.", "positions")]


def _metres(entries: Sequence[JSON]) -> Float64[np.ndarray, "n 3"]:
    """Return east, north and up from the first position, on a sphere: accurate enough for residuals of metres."""
    degrees = np.array([[entry["longitude"], entry["latitude"]] for entry in entries])
    off = np.radians(np.mod(degrees - degrees[0] + 180.0, 360.0) - 180.0) * EARTH_RADIUS_M
    up = np.array([entry["altitude_m"] for entry in entries], np.float64)
    return np.column_stack([off[:, 0] * np.cos(np.radians(degrees[0, 1])), off[:, 1], up - up[0]])


def disagreement(centres: Float64[np.ndarray, "n 3"], places: Float64[np.ndarray, "n 3"]) -> PositionMisfit:
    """Fit a similarity by least absolute distances, and summarise the residuals.

    Args:
        centres: Camera centres in the model's frame.
        places: Their stated positions, metres, in the same order.
    """
    _, residuals = robust_similarity(centres, places, absolute_weights, IRLS_ROUNDS)
    median = float(np.median(np.linalg.norm(residuals, axis=1)))
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = np.argmin(distances, axis=1)
    apart = float(np.median(np.linalg.norm(residuals - residuals[nearest], axis=1)))
    size = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return PositionMisfit(median, size, apart / max(median, 1e-9))
