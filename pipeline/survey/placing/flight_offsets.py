"""Errors shared by all positions of a flight: a receiver's slow error, and a vertical datum of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.geometry.alignment import Correspondences, SharedErrors, SimilarityFit, offset_step_sigmas
from splatpipe.pipeline.survey.crs.crs_names import UNKNOWN

MIN_PHOTOS = 3  # photos of a flight with its own offset; fewer do not determine it
MAX_FLIGHTS = 100  # with offsets of their own: the largest
APART_SIGMAS = 3.0  # a larger difference is not receiver error, but another datum or another base
UNBOUND_M = 1e4  # a standard deviation that imposes no constraint


def shared_errors(records: Sequence[Mapping[str, Any]], sigmas: Float64[np.ndarray, "n 3"]) -> SharedErrors | None:
    """Group positions into flights, each with its own offset; None for a single flight or if all are too small.

    Args:
        records: Of ``positions.json``.
        sigmas: Their standard deviations, metres; a receiver's error is shared by a whole flight.
    """
    flights = np.array([record.get("flight", 0) for record in records], dtype=np.int64)
    numbers, counts = np.unique(flights, return_counts=True)
    if len(numbers) < 2:
        return None
    large = numbers[counts >= MIN_PHOTOS]
    if len(large) == 0:
        return None
    largest = np.argsort(-counts[counts >= MIN_PHOTOS], kind="stable")[:MAX_FLIGHTS]
    large = large[np.sort(largest)]
    group = np.full(len(records), -1, dtype=np.int64)
    for index, number in enumerate(large):
        group[flights == number] = index
    return SharedErrors(group, np.stack([np.median(sigmas[group == index], axis=0) for index in range(len(large))]))


def reference_flight(points: Correspondences) -> int:
    """The flight with the most accurate positions, the largest if tied; it sets the frame where flights are apart."""
    assert points.shared is not None
    counts = points.shared.membership().sum(axis=1)
    accuracy = np.linalg.norm(points.shared.sigmas, axis=1)
    return int(np.lexsort((-counts, accuracy))[0])


def declared_datum(records: Sequence[Mapping[str, Any]], points: Correspondences) -> str:
    """The vertical datum declared by the positions that set the frame's heights; ``unknown`` if they disagree.

    These are the reference flight's positions where there are several flights.
    """
    leading = np.ones(len(records), dtype=bool)
    if points.shared is not None:
        leading = points.shared.group == reference_flight(points)
    datums = {record.get("vertical", UNKNOWN) for record, leads in zip(records, leading, strict=True) if leads}
    return str(datums.pop()) if len(datums) == 1 else UNKNOWN


def unbound(points: Correspondences) -> Correspondences:
    """The same correspondences with all flights' offsets unconstrained except the reference flight's."""
    if points.shared is None:
        return points
    sigmas = np.full_like(points.shared.sigmas, UNBOUND_M)
    reference = reference_flight(points)
    sigmas[reference] = points.shared.sigmas[reference]
    return replace(points, shared=replace(points.shared, sigmas=sigmas))


def bound(points: Correspondences, fit: SimilarityFit) -> Correspondences:
    """The same, with flights that are apart unconstrained and all others constrained by their receivers' accuracy.

    Heights and horizontal position are judged separately: flights in two vertical datums agree horizontally.

    Args:
        points: With the flights' accuracy.
        fit: The fit of the unconstrained points.
    """
    if points.shared is None:
        return points
    sigmas = points.shared.sigmas.copy()
    reference = reference_flight(points)
    steps = np.abs(fit.offsets - fit.offsets[reference])
    known = offset_step_sigmas(fit, unbound(points), reference)
    far = steps > APART_SIGMAS * np.sqrt(sigmas**2 + sigmas[reference] ** 2 + known**2)
    far[:, :2] |= far[:, :2].any(axis=1, keepdims=True)
    sigmas[far] = UNBOUND_M
    return replace(points, shared=replace(points.shared, sigmas=sigmas))


def flights_json(
    records: Sequence[Mapping[str, Any]], points: Correspondences, offsets: Float64[np.ndarray, "g 3"]
) -> list[dict[str, JSON]]:
    """Number, photos, offset (metres) and whether it is apart horizontally and in height, for each flight with an
    offset of its own."""
    if points.shared is None:
        return []
    flights = []
    for index, (offset, sigma) in enumerate(zip(offsets, points.shared.sigmas, strict=True)):
        members = [record for record, group in zip(records, points.shared.group, strict=True) if group == index]
        flights.append(
            {
                "flight": int(members[0].get("flight", 0)),
                "photos": len(members),
                "first": members[0]["name"],
                "offset_m": offset.tolist(),
                "apart": [bool(sigma[0] >= UNBOUND_M), bool(sigma[2] >= UNBOUND_M)],
            }
        )
    return flights


def warn_of_flight_offsets(flights: Sequence[Mapping[str, Any]], report: Reporter) -> None:
    """Warn about flights whose offset far exceeds the accuracy of their positions."""
    for flight in flights:
        name = f"flight {flight['flight'] + 1} ({flight['photos']} photos, from {flight['first']} on)"
        east, north, up = flight["offset_m"]
        if flight["apart"][1]:
            report.warning(
                f"The heights of {name} are {abs(up):.1f} m {'above' if up > 0 else 'below'} those of the reference "
                "flight.",
                "They are in another vertical datum, or the aircraft's height reference was wrong; the offset is "
                "estimated "
                "and removed.",
            )
        if flight["apart"][0]:
            report.warning(
                f"The positions of {name} are {math.hypot(east, north):.1f} m off those of the reference flight.",
                "The base station's coordinates may be wrong; the offset is estimated and removed.",
            )
