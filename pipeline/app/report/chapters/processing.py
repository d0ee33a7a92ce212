"""The report's last chapters: every stage with time and memory, versions, options, and output files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote

from splatpipe.pipeline.app.report.facts.overlap import overlap_s
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs
from splatpipe.pipeline.app.report.facts.wording import count, duration, moment, plural, size
from splatpipe.pipeline.engine.stage import shards_first, stage_name
from splatpipe.stages.line import LINE

Chapter = dict[str, Any]
WHAT = {
    "splat.ply": "the splat, for any viewer of Gaussian splats",
    "splat.spz": "the splat, compressed, for viewer.html",
    "viewer.html": "a viewer to navigate and measure the splat in any browser, offline",
    "flythrough.webm": "a film through the scene",
    "ortho.tif": "the true orthophoto, a GeoTIFF",
    "dsm.tif": "the surface model: heights, a GeoTIFF",
    "dsm_confidence.tif": "number of photos that confirm each height, and its expected deviation in millimetres",
    "dtm.tif": "the terrain model: heights of the ground, also under buildings and trees, a GeoTIFF",
    "dtm_confidence.tif": "how far the nearest ground is that photos see, and the expected deviation in millimetres",
    "chm.tif": "heights over the ground: the surface model less the terrain model, a GeoTIFF",
    "contours.dxf": "contours of the ground, or on request of the surface model, for CAD",
    "contours.geojson": "the same contours, for maps",
    "georef.json": "georeference of the splat: CRS, datum, matrices",
    "cameras.json": "the cameras in the splat's frame",
    "metrics.json": "all figures of this report, machine-readable",
    "sparse.glb": "sparse points and cameras, for any 3D viewer",
    "sky.ply": "the sky as a dome of Gaussians",
}
FIRST = ("viewer.html", "flythrough.webm", "splat.ply")  # the files that people open first, so also linked at the top
FOLDERS = {
    "undistort.dataset": "undistorted photos and cameras, for other trainers",
    "evaluate.views": "held-out photos, renders and errors at full size",
}
RECORDS = {
    "config.toml": "all options",
    "events.jsonl": "what happened",
    "splatpipe.log": "log output of the libraries",
}


def processing_chapter(inputs: ReportInputs, *, drawn: bool) -> Chapter:
    """The chapter on processing: stages, machine, versions, seeds, options.

    Args:
        inputs: The report's inputs.
        drawn: Whether to draw charts.
    """
    names = dict.fromkeys((*(stage.name for stage in LINE), *inputs.history.stages))
    rows = [_stage_row(inputs, name) for name in shards_first(names)]
    rows = [row for row in rows if row["state"] != "not requested" or row["made"]]
    versions, machine = dict(inputs.history.versions), dict(inputs.history.machine)
    for artifact in inputs.artifacts.values():
        versions = versions or dict(artifact.manifest.get("versions", {}))
        machine = machine or dict(artifact.manifest.get("machine", {}))
    options = {} if inputs.config is None else inputs.config.model_dump(mode="json")
    top_level_rows = [row for row in rows if not _is_in_stage(inputs, row["name"])]
    overlap = overlap_s(artifact.manifest for artifact in inputs.artifacts.values())
    chapter: Chapter = {
        "rows": rows,
        "total": duration(sum(row["seconds"] or 0.0 for row in top_level_rows) - overlap),
        "cpu_total": duration(sum(row["cpu_seconds"] or 0.0 for row in top_level_rows)),
        "peak": size(max((row["memory"] or 0 for row in rows), default=0) or None),
        "forecast": _forecast([row["foreseen"] for row in rows if row["foreseen"]]),
        "machine": _machine(machine),
        "versions": sorted((str(name), str(value)) for name, value in versions.items()),
        "other_versions": _other_versions(inputs, versions),
        "seeds": [
            (f"{name}.seed", str(section["seed"]))
            for name, section in options.items()
            if isinstance(section, Mapping) and "seed" in section
        ],
        "options": _options(options),
        "charts": _charts(rows) if drawn else [],
    }
    return chapter


def files_chapter(inputs: ReportInputs) -> Chapter:
    """Links to the files beside the report; those of an earlier run are labelled as such."""
    files = [
        {"href": quote(file.name), "name": file.name, "what": WHAT.get(file.name, ""), "size": size(file.size)}
        | {"current": file.current}
        for file in inputs.deliverables
    ]
    order = list(WHAT)
    files.sort(key=lambda file: (not file["current"], order.index(file["name"]) if file["name"] in order else 99))
    folders = []
    for name, what in FOLDERS.items():
        path = inputs.part(name)
        if path is not None:
            relative = path.relative_to(inputs.out).as_posix()
            folders.append({"href": quote(relative) + "/", "name": relative, "what": what})
    records = [
        {"href": quote(name), "name": name, "what": what, "size": size((inputs.out / name).stat().st_size)}
        for name, what in RECORDS.items()
        if (inputs.out / name).is_file()
    ]
    found = {str(file["name"]): file for file in files if file["current"]}
    first = [found[name] for name in FIRST if name in found]
    return {
        "first": first,
        "files": files,
        "folders": folders,
        "records": records,
        "stale": any(not file["current"] for file in files),
    }


def messages_chapter(inputs: ReportInputs) -> Chapter:
    """Warnings and notes of the run, stage by stage."""
    stages = inputs.history.stages
    warnings = [(name, *message) for name, stage in stages.items() for message in stage.messages.warnings]
    notes = [(name, message) for name, stage in stages.items() for message in stage.messages.notes]
    return {"warnings": warnings, "notes": notes}


def _is_in_stage(inputs: ReportInputs, name: str) -> bool:
    """Whether a row is that of a shard, which its stage's row already includes."""
    return name != stage_name(name) and stage_name(name) in inputs.artifacts


def _stage_row(inputs: ReportInputs, name: str) -> dict[str, Any]:
    history, artifact = inputs.history.stages.get(name), inputs.artifacts.get(name)
    manifest: Mapping[str, Any] = {} if artifact is None else artifact.manifest
    state: str = "not requested" if history is None else history.state
    if history is None and artifact is not None:
        state = "earlier run"
    seconds = manifest.get("seconds", None if history is None else history.seconds)
    memory = manifest.get("peak_memory_bytes", None if history is None else history.memory_bytes)
    return {
        "name": name,
        "state": state,
        "made": moment(manifest["finished_s"]) if manifest else "",
        "reason": "" if history is None else history.reason,
        "seconds": seconds,
        "took": duration(seconds) + (" beside others" if manifest.get("ahead") else ""),
        "cpu_seconds": manifest.get("cpu_seconds"),
        "cpu": duration(manifest.get("cpu_seconds")),
        "memory": memory,
        "peak": size(memory),
        "foreseen": manifest.get("forecast"),
        "forecast": _forecast([manifest["forecast"]] if "forecast" in manifest else []),
        "key": (str(manifest.get("key", "")) or ("" if history is None else history.key))[:16],
    }


def _forecast(needs: Sequence[Mapping[str, Any]]) -> str:
    """Forecast CPU time and memory of one or several stages; empty without a forecast."""
    if not needs:
        return ""
    seconds = sum(float(need["cpu_seconds"]) for need in needs)
    return f"{duration(seconds)}, {size(max(int(need['memory_bytes']) for need in needs))}"


def _other_versions(inputs: ReportInputs, versions: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Stages reused from an earlier run with other versions, and these versions."""
    stages = []
    for name, artifact in inputs.artifacts.items():
        other = artifact.manifest.get("versions", {})
        differ = [f"{what} {value}" for what, value in other.items() if versions.get(what) != value]
        if differ:
            stages.append((name, ", ".join(differ)))
    return stages


def _machine(machine: Mapping[str, Any]) -> str:
    parts = [str(machine[name]) for name in ("system", "processor") if machine.get(name)]
    if machine.get("cores"):
        parts.append(f"{count(machine['cores'])} cores")
    if machine.get("threads"):
        parts.append(f"{plural(int(machine['threads']), 'thread')} used")
    if machine.get("device") not in (None, "auto"):
        parts.append(f"device {machine['device']}")
    return ", ".join(parts)


def _options(options: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        (f"{section}.{name}", str(value))
        for section, values in options.items()
        if isinstance(values, Mapping)
        for name, value in values.items()
    ]


def _charts(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    from splatpipe.pipeline.app.report.charts.bars import stage_bars

    times = [(row["name"], row["seconds"]) for row in rows if row["seconds"] is not None]
    memory = [(row["name"], row["memory"] / 1e9) for row in rows if row["memory"]]
    charts = []
    if times:
        text = "Elapsed time of each stage, including stages made by an earlier run."
        charts.append({"svg": stage_bars(times, "seconds", "Time of the stages"), "text": text})
    if memory:
        text = "Peak memory of each stage."
        charts.append({"svg": stage_bars(memory, "gigabytes", "Peak memory of the stages"), "text": text})
    return charts
