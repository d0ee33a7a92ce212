"""The report's chapters on the photos: what was captured and excluded, and how the cameras were estimated."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.app.report.facts.adjustment_results import adopted_focals_px
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs
from splatpipe.pipeline.app.report.facts.wording import count, length, number, share

if TYPE_CHECKING:
    from markupsafe import Markup

    from splatpipe.pipeline.app.report.charts.geometry import Geometry

Chapter = dict[str, Any]
MAX_LISTED = 200  # rows of a table of photos
MIN_POINTS = 100  # observed by a well registered photo


def capture_chapter(inputs: ReportInputs, geometry: Geometry | None, *, drawn: bool) -> Chapter:
    """The chapter on the capture: photos, cameras, positions, map, overlap, and excluded photos with reasons.

    Args:
        inputs: The report's inputs.
        geometry: The sparse model's geometry, if there is a model.
        drawn: Whether to draw maps.
    """
    summary = inputs.summary("ingest")
    photos = inputs.read_in_part("ingest.photos", "photos.json").get("photos", [])
    left_out = inputs.read("ingest.left_out").get("left_out", [])
    positions = inputs.read("ingest.positions").get("positions", [])
    times = sorted(str(photo["time"]) for photo in photos if photo.get("time"))
    facts = [
        ("Photos", f"{count(summary.get('photos'))} used, {count(summary.get('left_out'))} left out"),
        ("Pixels", f"{number(summary.get('megapixels'), 1)} megapixels in all"),
        ("Taken", _span(times)),
        ("Positions", _positions(summary, positions)),
        ("Masks", _masks(summary)),
    ]
    cameras = inputs.read("ingest.cameras").get("cameras", [])
    groups = summary.get("camera_groups") or [{}] * len(cameras)
    chapter: Chapter = {
        "facts": [fact for fact in facts if fact[1]],
        "cameras": [_camera(camera, row) for camera, row in zip(cameras, groups, strict=False)],
        "left_out": left_out[:MAX_LISTED],
        "left_out_more": max(0, len(left_out) - MAX_LISTED),
    }
    if geometry is not None:
        chapter |= _map_part(inputs, geometry)
    elif drawn and len(positions) > 1:
        from splatpipe.pipeline.app.report.charts.charts import stated_map

        places = [(float(position["latitude"]), float(position["longitude"])) for position in positions]
        text = "Positions from the photos' metadata, joined in name order. Viewing directions are not known yet."
        chapter["maps"] = [{"svg": stated_map(places), "text": text}]
    return chapter


def _doubles(inputs: ReportInputs, found: Mapping[str, Any]) -> list[tuple[str, Markup]]:
    from splatpipe.pipeline.app.report.charts.pictures import double_crops

    return double_crops(found, inputs.part("ingest.photos"), inputs.photos_dir)


def registration_chapter(inputs: ReportInputs, geometry: Geometry | None, *, drawn: bool) -> Chapter:
    """The chapter on camera registration: matches, tracks, reprojection errors, calibration."""
    sparse, matches, features = (inputs.summary(name) for name in ("sparse", "matches", "features"))
    models = inputs.read("sparse.summary")
    facts = [
        ("Photos placed", f"{count(sparse.get('registered'))} of {count(sparse.get('photos'))}"),
        ("Keypoints", f"{count(features.get('keypoints'))}, {count(features.get('keypoints_per_photo'))} per photo"),
        ("Pairs", f"{count(matches.get('verified'))} verified of {count(matches.get('pairs'))} tried"),
        ("Matches per pair", f"{count(matches.get('median_inliers'))} (median)"),
        ("Pairing", str(matches.get("pairing", ""))),
        ("Sparse points", count(sparse.get("points3d"))),
        ("Track length", f"{number(sparse.get('mean_track_length'), 1)} photos per point on average"),
        ("Reprojection error", f"{number(sparse.get('mean_reprojection_error_px'), 2)} pixels on average"),
    ]
    if not sparse:  # the stage failed or was never reached
        facts = [fact for fact in facts if "–" not in fact[1] and fact[1]]
    unregistered = [str(name) for name in models.get("unregistered", [])]
    lenses = {row["camera"]: row for row in models.get("lenses", [])}
    chapter: Chapter = {
        "facts": facts,
        "unregistered": unregistered[:MAX_LISTED],
        "unregistered_more": max(0, len(unregistered) - MAX_LISTED),
        "other_models": models.get("other_models", []),
        "cameras": [_calibrated(camera, lenses.get(camera.get("id"), {})) for camera in sparse.get("cameras", [])],
        "alike": len(models.get("alike", [])),
        "doubles": _doubles(inputs, models["doubles"]) if drawn and models.get("doubles") else [],
        "tried": [_attempt_row(row) for row in sparse.get("tried", [])],
        "rungs": [_step_row(row) for row in sparse.get("ladder", [])],
        "adjusted_later": False,
    }
    with suppress(OSError, ValueError):  # unreadable: the chapter about it reports that
        chapter["adjusted_later"] = bool(adopted_focals_px(inputs, sparse.get("cameras", [])))
    if geometry is not None:
        chapter |= _registration_charts(inputs, geometry)
    return chapter


def unit_of(inputs: ReportInputs) -> str:
    """``m`` for a georeferenced model, ``metres`` for one with only a scale, else empty."""
    frame = inputs.read("georef.frame")
    if frame.get("kind") == "enu":
        return "m"
    return "metres" if frame.get("metres") else ""


def held_out(inputs: ReportInputs) -> list[str]:
    """Names of the held-out photos, if known."""
    return [str(name) for name in inputs.read("split.views").get("held_out", [])]


def _map_part(inputs: ReportInputs, geometry: Geometry) -> Chapter:
    from splatpipe.pipeline.app.report.charts.charts import overlap_map, survey_map

    unit, shares = unit_of(inputs), geometry.overlap.shares
    gsd = inputs.read("georef.accuracy").get("gsd_m")
    heights = sorted(float(height) for height in geometry.photos.centres[:, 2] - geometry.ground)
    west, east, south, north = geometry.box
    facts = [
        (
            "Overlap",
            f"{share(shares[3])} of the area with sparse points is seen by 3 photos or more, {share(shares[5])} in 5",
        ),
        ("Track length", f"{float(geometry.tracks.mean()):.1f} photos on average"),
    ]
    if unit:
        facts = [
            ("Ground sample distance", f"{length(gsd)} per pixel"),
            (
                "Height above ground",
                f"{heights[0]:.1f} to {heights[-1]:.1f} m, median {heights[len(heights) // 2]:.1f} m",
            ),
            ("Mapped area", f"{east - west:,.0f} m × {north - south:,.0f} m"),
            *facts,
        ]
    maps = [
        {
            "svg": survey_map(geometry, unit, held_out(inputs)),
            "text": "Camera positions, viewing directions, and the ground that each photo covers (footprint), as "
            "far as its points reach; occlusion by walls and trees is ignored.",
        },
        {"svg": overlap_map(geometry.overlap, unit), "text": "Number of footprints that cover each place."},
    ]
    return {"map_facts": facts, "maps": maps}


def _registration_charts(inputs: ReportInputs, geometry: Geometry) -> Chapter:
    from splatpipe.pipeline.app.report.charts import charts

    found = inputs.read("matches.pairs")
    pairs = [(str(a), str(b), int(n)) for a, b, n in found.get("pairs", [])]
    drawn = [
        (
            charts.observations_bars(geometry),
            f"Photos with fewer than {MIN_POINTS} points (red) are poorly constrained.",
        ),
        (
            charts.track_histogram(geometry),
            "Points seen by only two photos (orange) constrain little; longer tracks hold the model together.",
        ),
        (charts.error_histogram(geometry), "Distribution of the reprojection errors."),
    ]
    for number_of, field in enumerate(geometry.fields[:4], start=1):
        text = (
            "Mean residuals over the image, greatly exaggerated: a pattern indicates that the lens model does not fit."
        )
        drawn.append((charts.residual_field(field, number_of), text))
    if pairs:
        drawn.append((charts.match_map(geometry, pairs, unit_of(inputs)), "Pairs of photos that were matched."))
    return {"charts": [{"svg": svg, "text": text} for svg, text in drawn]}


def _source(source: object) -> str:
    """The source of a value in words: ``xmp-calibrated`` becomes XMP calibrated."""
    words = str(source or "").replace("-", " ")
    return words.replace("exif", "EXIF").replace("xmp", "XMP")


def _camera(camera: Mapping[str, Any], group: Mapping[str, Any]) -> dict[str, str]:
    make, model = str(camera.get("make") or ""), str(camera.get("model_name") or "")
    name = (model if model.casefold().startswith(make.casefold()) else f"{make} {model}").strip() or "unknown camera"
    known = _source(camera.get("focal_source"))
    focal = f"{number(camera.get('focal_px'), 1)} px" + (f" ({known})" if known else "")
    size = f"{count(camera.get('width'))} × {count(camera.get('height'))}"
    if group.get("exif_size"):
        size += " ({} from {} × {})".format(
            "cropped" if group.get("cropped") else "reduced", *map(count, group["exif_size"])
        )
    return {"name": name, "photos": count(camera.get("photos")), "size": size, "focal": focal}


def _calibrated(camera: Mapping[str, Any], lens: Mapping[str, Any]) -> dict[str, str]:
    """A camera's estimated calibration, and which parameters were refined."""
    prior, focal = camera.get("prior_focal_px"), camera.get("focal_px")
    change = (focal / prior - 1.0) if camera.get("has_prior") and prior and focal else math.nan
    change_text = f"{change:+.2%}".replace("%", " %") if math.isfinite(change) else "–"
    stated = f"{number(prior, 1)} px" if camera.get("has_prior") else "not stated"
    model = str(camera.get("model", ""))
    if lens.get("freed"):
        model += f" ({', '.join(str(name) for name in lens['freed'])})"
    source = _source(camera.get("focal_source")) if camera.get("has_prior") else ""
    photos = f"{count(camera.get('placed'))} of {count(camera.get('photos'))}"
    return {
        "name": str(camera.get("name") or "unknown camera"),
        "photos": photos,
        "model": model,
        "prior": stated + (f" ({source})" if source else ""),
        "focal": f"{number(focal, 1)} px",
        "change": change_text,
        "error": f"{number(camera.get('error_px'), 2)} px",
    }


def _attempt_row(row: Mapping[str, Any]) -> dict[str, str]:
    """A table row for a mapping attempt; missing figures are dashes."""
    against, pairs = row.get("contradicted") or (None, None)
    return {
        "how": str(row.get("how", row.get("mapper", ""))),
        "placed": count(row.get("placed")),
        "points": count(row.get("points3d")),
        "error": number(row.get("error_px"), 2),
        "focal": ", ".join(number(focal, 0) for focal in row.get("focal_px", [])) or "–",
        "explained": share(row["explained"], 1) if "explained" in row else "–",
        "held_out": share(row["held_out"], 1) if "held_out" in row else "–",
        "against": "–" if against is None else f"{count(against)} of {count(pairs)}",
        "cpu": number(row.get("cpu_s"), 1),
        "taken": "taken" if row.get("chosen") else "",
        "why": str(row.get("why", "")),
    }


def _step_row(row: Mapping[str, Any]) -> dict[str, str]:
    """A table row for a step of the attempts to register the remaining photos."""
    return {
        "rung": str(row.get("rung", "")).replace("_", " "),
        "left": count(row.get("left")),
        "placed": count(row.get("placed")),
        "pairs": count(row.get("verified_pairs_added")),
        "keypoints": count(row.get("keypoints_added")),
        "cpu": number(row.get("cpu_s"), 1),
    }


def _masks(summary: Mapping[str, Any]) -> str:
    kinds = [(summary.get("masks"), "of areas to ignore"), (summary.get("sky_masks"), "of the sky")]
    return ", ".join(f"{count(number_of)} {what}" for number_of, what in kinds if number_of) or "none"


def _span(times: Sequence[str]) -> str:
    if not times:
        return "the photos have no times"
    first, last = times[0].replace("T", " "), times[-1].replace("T", " ")
    return first if first == last else f"{first} to {last} (camera's clock)"


def _positions(summary: Mapping[str, Any], positions: Sequence[Mapping[str, Any]]) -> str:
    if not positions:
        return "none of the photos has a position"
    text = f"{len(positions):,} photos"
    sources = ", ".join(_source(source) for source in summary.get("position_sources", []))
    text += f", from {sources}" if sources else ""
    flights = summary.get("flights")
    text += f", {count(flights)} flights" if isinstance(flights, int) and flights > 1 else ""
    horizontal, vertical = summary.get("sigma_horizontal_m"), summary.get("sigma_vertical_m")
    if horizontal is not None:
        text += f"; assumed accurate to {length(horizontal)} horizontally, "
        text += f"{length(vertical)} in height" if vertical is not None else "without heights"
    return text
