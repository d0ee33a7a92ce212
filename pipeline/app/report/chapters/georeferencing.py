"""The report's chapter on georeferencing: frame, accuracy tables, each surveyed point, and a crop of each mark."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.app.report.chapters.adjustment import adjustment_section
from splatpipe.pipeline.app.report.facts.adjustment_results import read_adjustment
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs
from splatpipe.pipeline.app.report.facts.wording import count, interval, length, metres, number
from splatpipe.pipeline.engine.files.json_file import read_json

if TYPE_CHECKING:
    from splatpipe.pipeline.app.report.charts.geometry import Geometry

Chapter = dict[str, Any]
GROUPS = {"gps": "photo positions", "control": "control points", "check": "check points"}
MAX_POINTS = 200  # rows of the table; metrics.json has all
MAX_BARS = 20
AXES = ("east", "north", "up", "horizontal", "3d")
Residual = tuple[str, Sequence[float], Sequence[float]]  # name, position and residual: east, north, up, metres


def georeferencing_chapter(inputs: ReportInputs, geometry: Geometry | None) -> Chapter | None:
    """The chapter on the model's georeference and its accuracy; None if georef did not finish.

    Args:
        inputs: The report's inputs.
        geometry: The sparse model's geometry; None for a report without images.
    """
    if "georef" not in inputs.artifacts:
        return None
    frame, control, report = (inputs.read(f"georef.{name}") for name in ("frame", "control", "accuracy"))
    points = list(control.get("points", []))
    splat = _splat(inputs)
    chapter: Chapter = {
        "note": str(frame.get("note", "")),
        "facts": _frame_facts(inputs, (frame, control, report), named=geometry is not None),
        "tables": _tables(report.get("tables") or {}, splat.get("tables") or {}),
        "flights": _flights(report.get("tables") or {}),
        "left_out": [str(name) for name in frame.get("left_out", [])],
        "points": [_point(point, splat) for point in points[:MAX_POINTS]],
        "points_more": max(0, len(points) - MAX_POINTS),
        "has_splat": bool(splat["points"]),
        "marks": [],
        "marks_left_out": 0,
        "adjustment": None,
    }
    adjusted = read_adjustment(report)
    if adjusted is not None:
        cameras = inputs.summary("sparse").get("cameras") or []
        places = None if geometry is None else _camera_places(geometry)
        chapter["adjustment"] = adjustment_section(adjusted, cameras, frame.get("origin"), places)
    if geometry is not None:
        drawn = bool(chapter["adjustment"] and chapter["adjustment"]["charts"])
        photos = [] if drawn else _photo_residuals(geometry, frame)
        chapter |= _charts_and_marks(inputs, geometry, points, photos, placed=frame.get("kind") == "enu")
    return chapter


def _splat(inputs: ReportInputs) -> Mapping[str, Any]:
    """The splat's own accuracy from evaluate; empty if damaged, which its own chapter reports."""
    with suppress(OSError, ValueError, AttributeError):
        found = inputs.read("evaluate.metrics").get("accuracy", {}).get("splat")
        if found:
            return dict(found)
    return {"tables": {}, "points": []}


def _frame_facts(
    inputs: ReportInputs, parts: tuple[Mapping[str, Any], Mapping[str, Any], Mapping[str, Any]], *, named: bool
) -> list[tuple[str, str]]:
    frame, control, report = parts
    if frame.get("kind") != "enu":
        if frame.get("metres"):
            gsd = ("Ground sample distance", f"{length(report.get('gsd_m'))} per pixel")
            return [("Frame", "z up, in metres by scale bars; position and heading are arbitrary"), gsd, *_bars(report)]
        return [("Frame", "z up; scale, position and heading are arbitrary: no metres")]
    origin = frame["origin"]
    place = f"{origin['latitude']:.7f}°, {origin['longitude']:.7f}°, {number(origin['height_m'])} m"
    summary = inputs.summary("georef")
    facts = [
        ("Frame", "local east, north, up in metres"),
        ("Origin", f"{place} (latitude, longitude, height)"),
        ("CRS of the coordinates", _crs(inputs, frame)),
        ("Vertical datum", _vertical(str(frame.get("vertical_datum", "unknown")), named=named)),
        ("Ground sample distance", f"{length(report.get('gsd_m'))} per pixel"),
    ]
    text = (report.get("uncertainty") or {}).get("sentence")
    if text:
        facts.append(("From the photo positions alone", str(text)))
    if control.get("file"):
        text = f"{control['file']}, in {control.get('crs')}; marks assumed accurate to {control.get('sigma_pixel')} px"
        facts.append(("Control file", text))
    adjusted = summary.get("model_bent")
    if adjusted is not None:
        moved = f"{number(summary.get('moved_px'), 3)} px"
        text = (
            f"the model was adjusted to it, by {moved} in the photos"
            if adjusted
            else f"the model fits it unadjusted (an adjustment would move it by {moved} in the photos)"
        )
        facts.append(("Control and the model", text if summary.get("moved_px") is not None else "not adjusted"))
    return facts + _bars(report)


def _bars(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The scale bar results from `accuracy.json`; empty if there are none."""
    scale = report.get("scale")
    if not scale:
        return []
    facts = [("Scale bars", str(scale["sentence"]))]
    for bar in scale["bars"][:MAX_BARS]:
        off = (
            "one of its targets was not found"
            if bar["error_m"] is None
            else f"{1000 * bar['error_m']:+.1f} mm in the model"
        )
        left_out = "" if bar["used"] or bar["error_m"] is None else ", left out"
        facts.append((f"{bar['a']} to {bar['b']}", f"{metres(bar['metres'])} m, {off}{left_out}"))
    return facts


def _vertical(datum: str, *, named: bool) -> str:
    """The vertical datum's name, or its text from the frame if there is no time to load pyproj."""
    if not named:
        return datum
    from splatpipe.pipeline.survey.crs.crs import describe_vertical

    return describe_vertical(datum)


def _crs(inputs: ReportInputs, frame: Mapping[str, Any]) -> str:
    """The CRS from `georef.json` if written, else from the frame."""
    from splatpipe.pipeline.survey.crs.georeference import accuracy_in_words

    path = inputs.part("export.georef")
    georeference = read_json(path) if path is not None else {}
    crs = georeference.get("crs") if isinstance(georeference, Mapping) else None
    if not isinstance(crs, Mapping):
        return str(frame.get("crs") or "the UTM zone of the origin")
    operation = crs.get("operation", {})
    accuracy = accuracy_in_words(operation.get("accuracy_m"))
    return f"{crs.get('id')} ({crs.get('name')}), by {operation.get('name')}, {accuracy}"


def _tables(model: Mapping[str, Any], splat: Mapping[str, Any]) -> list[dict[str, Any]]:
    found = [(title, model.get(name)) for name, title in GROUPS.items()]
    found += [(f"splat's surface at {GROUPS[name]}", splat.get(name)) for name in ("control", "check")]
    rows = []
    for title, table in found:
        if table:
            mean = [metres(value) for value in table.get("mean_m") or [None] * 3]
            rows.append(
                {
                    "title": title,
                    "count": count(table.get("count")),
                    "rmse": [metres(table.get(f"rmse_{axis}_m")) for axis in AXES],
                    "mean": ", ".join(mean),
                    "horizontal": interval(table.get("interval_95_horizontal_m")),
                    "vertical": interval(table.get("interval_95_vertical_m")),
                }
            )
    return rows


def _flights(tables: Mapping[str, Any]) -> list[str]:
    flights = [flight for table in tables.values() if table for flight in table.get("flights", [])]
    return [
        f"Flight {flight['flight'] + 1}, {count(flight.get('photos'))} photos: common offset "
        "{} m east, {} m north, {} m up from the model.".format(*map(metres, flight["offset_m"]))
        for flight in flights
    ]


def _point(point: Mapping[str, Any], splat: Mapping[str, Any]) -> dict[str, Any]:
    used = [seen for seen in point["observations"] if seen.get("used", True)]
    own: Mapping[str, Any] = next((found for found in splat["points"] if found.get("name") == point["name"]), {})
    nothing = [None, None, None]
    return {
        "name": str(point["name"]),
        "role": str(point["role"]).replace("_", " "),
        "why": str(point.get("why") or ""),
        "photos": len(used),
        "surveyed": [number(value) for value in point.get("surveyed_crs") or nothing],
        "residual": [metres(value) for value in point.get("residual_m") or nothing],
        "pixels": number(_rms_px(used), 2),
        "splat": [metres(value) for value in own.get("residual_m") or nothing],
    }


def _rms_px(observations: Sequence[Mapping[str, Any]]) -> float | None:
    squares = [x * x + y * y for x, y in (seen["residual_px"] for seen in observations if seen.get("residual_px"))]
    return math.sqrt(math.fsum(squares) / len(squares)) if squares else None


def _charts_and_marks(
    inputs: ReportInputs,
    geometry: Geometry,
    points: Sequence[Mapping[str, Any]],
    photos: Sequence[Residual],
    *,
    placed: bool,
) -> Chapter:
    """The residual maps, and the crops for each point.

    Args:
        inputs: The report's inputs.
        geometry: The sparse model's geometry.
        points: The surveyed points.
        photos: Residuals of the photos' own positions.
        placed: Whether the model is georeferenced; otherwise there are no maps.
    """
    from splatpipe.pipeline.app.report.charts.charts import residual_map
    from splatpipe.pipeline.app.report.charts.pictures import cut_crops

    charts = []
    if placed:
        surveyed = _surveyed_residuals(points)
        if surveyed:
            text = "Residuals of the surveyed points (estimated minus surveyed)."
            charts.append({"svg": residual_map(geometry, surveyed), "text": text})
        if photos:
            text = "Residuals of the photos' own positions relative to the model."
            charts.append({"svg": residual_map(geometry, {"photo": photos}), "text": text})
    crops = cut_crops(points, inputs.part("ingest.photos"), inputs.photos_dir)
    total = sum(len(point["observations"]) for point in points)
    every_point = [_marks(i, point, crops) for i, point in enumerate(points)]
    marks = [mark for mark in every_point if mark["chips"]]
    return {"charts": charts, "marks": marks, "marks_left_out": total - len(crops)}


def _marks(index: int, point: Mapping[str, Any], crops: Mapping[tuple[int, int], Any]) -> dict[str, Any]:
    """A point's crops, worst first."""
    entries = []
    for j, seen in enumerate(point["observations"]):
        image = crops.get((index, j))
        if image is not None:
            residual = seen.get("residual_px")
            off = None if not residual else math.hypot(*residual)
            crop = {"chip": image, "photo": str(seen["photo"]), "off": number(off, 2), "used": seen.get("used", True)}
            entries.append((-(off or 0.0), j, crop))
    role = str(point["role"]).replace("_", " ")
    return {
        "name": str(point["name"]),
        "role": role,
        "chips": [entry for *_, entry in sorted(entries, key=lambda e: e[:2])],
    }


def _surveyed_residuals(points: Sequence[Mapping[str, Any]]) -> dict[str, list[Residual]]:
    groups: dict[str, list[Residual]] = {}
    for point in points:
        place, residual = point.get("surveyed_m"), point.get("residual_m")
        if place and residual and None not in place[:2] and None not in residual[:2]:
            kind = {"control": "control", "check": "check"}.get(str(point["role"]), "left out")
            groups.setdefault(kind, []).append((str(point["name"]), place, residual))
    return groups


def _photo_residuals(geometry: Geometry, frame: Mapping[str, Any]) -> list[Residual]:
    found = (frame.get("residuals") or {}).get("photos") or {}
    places = _camera_places(geometry)
    return [(name, places[name], list(residual)) for name, residual in found.items() if name in places]


def _camera_places(geometry: Geometry) -> dict[str, list[float]]:
    return dict(zip(geometry.photos.names, geometry.photos.centres.tolist(), strict=True))
