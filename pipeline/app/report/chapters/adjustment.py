"""The report's part on the adjustment to camera positions: residuals, lens, and what the heights are worth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import groupby
from typing import Any

from splatpipe.pipeline.app.report.facts.adjustment_results import (
    AdjustmentResults,
    Heights,
    Judgement,
    LensResult,
    PositionResidual,
)
from splatpipe.pipeline.app.report.facts.wording import count, number, plural, two_digits

Chapter = dict[str, Any]
CameraPlaces = Mapping[str, Sequence[float]]  # east, north, up by photo, metres
NORMAL_95 = 1.96  # standard deviations that hold 95 % of normal errors
STRONG_CORRELATION = 0.9  # correlation above which two parameters are hardly told apart
MAX_LENSES = 12
MAX_FLIGHTS = 6  # with a chart
MAX_NOISE = 12  # flights and states of the receiver
PARAMETERS = {
    "f": "focal length",
    "aspect": "aspect (fy / fx − 1)",
    "cx": "principal point x",
    "cy": "principal point y",
    **{f"k{k}": f"radial k{k}" for k in range(1, 7)},
    **{f"p{k}": f"tangential p{k}" for k in range(1, 3)},
}
IN_PIXELS = frozenset({"f", "cx", "cy"})
DECIMALS = 8  # at most, of a parameter
REMEDIES = {
    "control_1": "one control point",
    "control_3": "three control points",
    "cross_strip": "a cross strip at another height",
}


def adjustment_section(
    found: AdjustmentResults,
    cameras: Sequence[Mapping[str, Any]],
    origin: Mapping[str, Any] | None,
    places: CameraPlaces | None,
) -> Chapter:
    """The part of the georeferencing chapter on an adjustment.

    Args:
        found: The adjustment.
        cameras: Those of ``sparse``'s summary, for their names.
        origin: The frame's origin; None without one.
        places: The model's camera places; None for a report without images.
    """
    names = _camera_names(found.lenses, cameras)
    lenses = [_lens(name, lens) for name, lens in zip(names, found.lenses, strict=True) if lens.names]
    return {
        "moved": _moved(found),
        "predicted": f"{found.sentence[0].upper()}{found.sentence[1:]}." if found.sentence else "",
        "noise": [
            f"{name}: × {number(across, 2)} horizontally, × {number(height, 2)} in height"
            for name, across, height in found.noise[:MAX_NOISE]
        ],
        "noise_more": max(0, len(found.noise) - MAX_NOISE),
        "judged": "" if found.judged is None else _judged(found.judged),
        "lenses": lenses[:MAX_LENSES],
        "lenses_more": max(0, len(lenses) - MAX_LENSES),
        "heights": None if found.heights is None else _heights(found.heights, origin, places),
        "charts": [] if places is None else _position_charts(found.positions, places),
    }


def _moved(found: AdjustmentResults) -> str:
    if found.adopted is None or found.moved_px is None:
        return ""
    moved = f"{number(found.moved_px, 1)} px"
    if found.adopted:
        return (
            f"Positions, tie points and lens were adjusted together, which moved what the photos show by {moved} (RMS)."
        )
    return (
        "Positions, tie points and lens were adjusted together. That would move what the photos show by only "
        f"{moved} (RMS), so the model stayed as it was."
    )


def _judged(judged: Judgement) -> str:
    """Why the lens was freed, or not."""

    def errors(which: int) -> str:
        across, height = judged.positions_m[which]
        tie_points = number(judged.tie_points_px[which], 2)
        return f"tie points to {tie_points} px and positions to {two_digits(across)} and {two_digits(height)} in height"

    taken, other = (
        ("all parameters", "only focal length and k1")
        if judged.whole
        else (
            "only focal length and k1",
            "all parameters",
        )
    )
    return (
        f"Adjusted with {taken} free: it predicts what it did not use, {errors(int(judged.whole))}; "
        f"with {other} free, {errors(int(not judged.whole))}."
    )


def _camera_names(lenses: Sequence[LensResult], cameras: Sequence[Mapping[str, Any]]) -> list[str]:
    placed = sorted((camera for camera in cameras if camera.get("placed", 1)), key=lambda camera: camera.get("id", 0))
    if len(placed) != len(lenses):
        return [f"Camera {k}" for k in range(1, len(lenses) + 1)]
    return [str(camera.get("name") or f"Camera {k}") for k, camera in enumerate(placed, start=1)]


def _lens(name: str, lens: LensResult) -> Chapter:
    titles = [PARAMETERS.get(each, each) for each in lens.names]
    rows = []
    for k, (each, value, sigma) in enumerate(zip(lens.names, lens.values, lens.sigmas, strict=True)):
        digits = int(min(max(1 - math.floor(math.log10(sigma)), 0), DECIMALS)) if sigma > 0.0 else 2
        unit = " px" if each in IN_PIXELS else ""
        share = f" ({100.0 * sigma / value:.2g} %)" if each == "f" and value > 0.0 else ""
        row = lens.correlations[k] if lens.correlations else ()
        partners = [f"{titles[j]} ({r:+.2f})" for j, r in enumerate(row) if j != k and abs(r) >= STRONG_CORRELATION]
        rows.append(
            {
                "title": titles[k],
                "value": f"{number(value, digits)}{unit}",
                "sigma": f"{number(sigma, digits)}{unit}{share}",
                "strong": ", ".join(partners),
            }
        )
    matrix = [
        {"title": title, "values": [f"{r:+.2f}" for r in row[: k + 1]]}
        for k, (title, row) in enumerate(zip(titles, lens.correlations, strict=False))
    ]
    return {"name": name, "rows": rows, "short": list(lens.names), "matrix": matrix}


def _heights(heights: Heights, origin: Mapping[str, Any] | None, cameras: CameraPlaces | None) -> Chapter:
    together, typical = heights.together_m, heights.typical_m
    text = f"{heights.sentence[0].upper()}{heights.sentence[1:]}." if heights.sentence else ""
    if not text and together is not None:
        text = f"Heights of the ground are known to {_bound(together[2])} together (95 %)."
    if typical is not None:
        height, across = _bound(typical[2]), _across(typical)
        text += f" A single point's height is known to {height}, its place to {across} along each axis."
    rows = [
        {"title": title, "bound": _bound(remedy.height_sigma_m), "where": _where(name, len(remedy.places_m))}
        for name, title in REMEDIES.items()
        if (remedy := heights.remedies.get(name)) is not None
    ]
    if rows and together is not None:
        rows.insert(0, {"title": "the flight as it is", "bound": _bound(together[2]), "where": ""})
    control = max((remedy.places_m for remedy in heights.remedies.values()), key=len, default=())
    charts = []
    if cameras is not None and heights.places:
        from splatpipe.pipeline.app.report.charts.adjustment_charts import heights_map

        caption = "How well the height of the ground is known at some tie points: ±, 95 % (1.96 standard deviations)"
        caption += "; triangles: where control points would help most." if control else "."
        charts.append({"svg": heights_map(heights.places, control, list(cameras.values())), "text": caption})
    located = _control_places(control, origin if cameras is not None else None)
    return {"text": text.strip(), "remedies": rows, "places": located, "charts": charts}


def _bound(sigma_m: float) -> str:
    return f"±{two_digits(NORMAL_95 * sigma_m)}"


def _across(sigmas: tuple[float, float, float]) -> str:
    return _bound(math.hypot(*sigmas[:2]) / math.sqrt(2.0))


def _where(name: str, points: int) -> str:
    if name == "cross_strip":
        return "across the strips, a quarter higher"
    listed = [str(k) for k in range(1, points + 1)]
    return (
        f"at {', '.join(listed[:-1])} and {listed[-1]} on the map"
        if points > 1
        else "at 1 on the map"
        if points
        else ""
    )


def _control_places(places: Sequence[tuple[float, float, float]], origin: Mapping[str, Any] | None) -> list[str]:
    """The proposed control points, also in latitude and longitude if the origin is given: that loads NumPy."""
    degrees: list[list[float]] = []
    if places and origin is not None:
        import numpy as np

        from splatpipe.pipeline.survey.crs.geodesy import Origin

        with suppress(KeyError, TypeError, ValueError):
            at = Origin(*(float(origin[key]) for key in ("latitude", "longitude", "height_m")))
            degrees = at.geodetic_from_enu(np.array(places, np.float64)).tolist()
    listed = []
    for k, (east, north, _) in enumerate(places):
        text = f"{k + 1}: {abs(east):.0f} m {'east' if east >= 0.0 else 'west'} and "
        text += f"{abs(north):.0f} m {'north' if north >= 0.0 else 'south'} of the origin"
        text += f" ({degrees[k][0]:.6f}°, {degrees[k][1]:.6f}°)" if degrees else ""
        listed.append(text)
    return listed


def _position_charts(positions: Sequence[PositionResidual], places: CameraPlaces) -> list[Chapter]:
    from splatpipe.pipeline.app.report.charts.adjustment_charts import flight_lines, positions_map

    known = [entry for entry in positions if entry.photo in places]
    if not known:
        return []
    text = (
        "Residuals of the camera positions, adjusted minus stated: horizontally as arrows, in height by colour. The "
        "grey line is the flight."
    )
    charts = [{"svg": positions_map(known, [places[entry.photo] for entry in known]), "text": text}]
    flights = {
        flight: list(group) for flight, group in groupby(sorted(known, key=lambda e: e.flight), key=lambda e: e.flight)
    }
    longest = sorted(sorted(flights, key=lambda flight: -len(flights[flight]))[:MAX_FLIGHTS])
    for flight in longest:
        entries = flights[flight]
        title = f"flight {flight + 1}, " if len(flights) > 1 else ""
        text = (
            f"Residuals of {title}{plural(len(entries), 'position')} in the order of capture; vertical lines: the "
            "flight turns. A bend along each strip, the same in all of them, would be a lens that does not fit."
        )
        charts.append({"svg": flight_lines(flight, entries, [places[e.photo] for e in entries]), "text": text})
    if len(flights) > MAX_FLIGHTS:
        charts[-1]["text"] += f" {count(len(flights) - MAX_FLIGHTS)} shorter flights are only in accuracy.json."
    return charts
