"""The processes of one job: its forecast, its run, and the packing of its results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from splatpipe.pipeline.app.library.requests import IN_TURN_VARIABLE
from splatpipe.pipeline.app.node.tasks.child import Child
from splatpipe.pipeline.app.node.tasks.forecast import MODULE as FORECAST_MODULE
from splatpipe.pipeline.app.node.tasks.jobs import Job, JobStore, link_files, seed_artifacts
from splatpipe.pipeline.app.node.tasks.names import control_file, kind_of
from splatpipe.pipeline.app.node.tasks.progress import RunProgress
from splatpipe.pipeline.app.node.tasks.run_options import RunOptions, run_options
from splatpipe.pipeline.app.node.tasks.settings import Settings
from splatpipe.pipeline.engine.config import dump
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE

Phase = Literal["forecast", "run", "pack"]

RUN_MODULE = "splatpipe.pipeline.app.cli.main"
PACK_MODULE = "splatpipe.pipeline.app.node.assets"  # above this room: started, not imported
BOUNDARY_FILE, OPTIONS_FILE, FORECAST_FILE = "boundary.geojson", "options.toml", "forecast.json"
MAX_ANSWER_BYTES = 1 << 20
MAX_TITLE_LETTERS = 200  # as export.title takes it


class JobProcess:
    """A process of a job that is under way.

    Args:
        job: The job.
        phase: What it does.
        child: The process.
        progress: Its progress, of a run.
    """

    def __init__(self, job: Job, phase: Phase, child: Child, progress: RunProgress | None = None) -> None:
        self.key, self.phase, self.child, self.progress = job.key, phase, child, progress
        self.forecast = job.forecast
        self.ending_s = 0.0  # when it was asked to end, time.monotonic(); 0 if it was not
        self.stalled = False  # whether it was asked because nothing moved


def prepare(job: Job, jobs: JobStore, source: Path) -> None:
    """Put a job's photos in place, and what may be reused of another job with the same photos.

    Args:
        job: The job.
        jobs: Where it is kept.
        source: Folder with its files: a task's upload.

    Raises:
        OSError: if the disk is full or not writable.
    """
    link_files(job.photos, source, jobs.photos(job.key))
    given = run_options(job.options)
    if given.boundary:
        write_durably(jobs.path(job.key) / BOUNDARY_FILE, given.boundary)
    write_durably(jobs.path(job.key) / OPTIONS_FILE, dump(_tables(job, jobs, given)))
    if job.seed:
        seed_artifacts(jobs.out(job.seed), jobs.out(job.key))


def _tables(job: Job, jobs: JobStore, given: RunOptions) -> dict[str, Any]:
    tables: dict[str, Any] = {section: dict(values) for section, values in given.tables.items()}
    if job.title:
        tables["export"] = {**tables.get("export", {}), "title": job.title[:MAX_TITLE_LETTERS]}
    files = {"boundary": jobs.path(job.key) / BOUNDARY_FILE if given.boundary else None}
    control = control_file(job.photos)
    files["control"] = jobs.photos(job.key) / control if control is not None else None
    for name, path in files.items():
        if path is not None:
            tables["georef"] = {**tables.get("georef", {}), name: str(path)}
    return tables


def photos_argument(job: Job, jobs: JobStore) -> Path:
    """What a run is given as PHOTOS: the folder, or the film if there is one and no photo."""
    kinds = {name: kind_of(name) for name in job.photos}
    films = sorted(name for name, kind in kinds.items() if kind == "film")
    return jobs.photos(job.key) / films[0] if films and "photo" not in kinds.values() else jobs.photos(job.key)


def start_forecast(job: Job, jobs: JobStore, threads: int) -> JobProcess:
    """Start the forecast of a job; its answer is in ``read_forecast``.

    Raises:
        OSError: if no process can be started.
    """
    given = run_options(job.options)
    options = {"preset": given.preset, "tables": _tables(job, jobs, given), "until": given.until}
    arguments = [str(photos_argument(job, jobs)), str(jobs.out(job.key)), str(threads), json.dumps(options)]
    answer = jobs.path(job.key) / FORECAST_FILE
    child = Child(FORECAST_MODULE, arguments, jobs.path(job.key) / "forecast.log", answer)
    return JobProcess(job, "forecast", child)


def read_forecast(job: Job, jobs: JobStore) -> dict[str, Any]:
    """What the forecast of a job answered.

    Raises:
        OSError, ValueError: if it died before.
    """
    found = read_json(jobs.path(job.key) / FORECAST_FILE, MAX_ANSWER_BYTES)
    if not isinstance(found, dict):
        raise ValueError("it is not an object")
    return found


def start_run(job: Job, jobs: JobStore, settings: Settings) -> JobProcess:
    """Start the run of a job; an earlier one is continued.

    Where several run at once, each keeps to the memory of its forecast, which is that of one stage.

    Raises:
        OSError: if no process can be started.
    """
    given = run_options(job.options)
    out = jobs.out(job.key)
    arguments = ["run", str(photos_argument(job, jobs)), str(out), "--preset", given.preset]
    arguments += ["--config", str(jobs.path(job.key) / OPTIONS_FILE), "--threads", str(settings.threads), "--wait"]
    arguments += ["--until", given.until] if given.until else []
    arguments += ["--time-budget", given.time_budget] if given.time_budget else []
    progress = RunProgress(out / EVENTS_FILE, job.forecast.weights)
    environment = {IN_TURN_VARIABLE: "1"} if settings.parallel > 1 else {}
    child = Child(RUN_MODULE, arguments, jobs.output(job.key), environment=environment)
    return JobProcess(job, "run", child, progress)


def start_pack(job: Job, jobs: JobStore) -> JobProcess:
    """Start to pack the results of a job; what is absent is printed, and so becomes part of its output.

    Raises:
        OSError: if no process can be started.
    """
    arguments = [str(jobs.out(job.key)), str(jobs.assets(job.key)), "--log", str(jobs.output(job.key))]
    arguments += ["--outputs", json.dumps(list(job.outputs))] if job.outputs else []
    return JobProcess(job, "pack", Child(PACK_MODULE, arguments, jobs.output(job.key)))


def forecast_fields(found: dict[str, Any]) -> dict[str, Any]:
    """The forecast's fields of its answer.

    Raises:
        ValueError: if it is not one.
    """
    try:
        return {
            "photos": int(found["photos"]),
            "memory_bytes": int(found["memory_bytes"]),
            "seconds": float(found["seconds"]),
            "disk_bytes": int(found["disk_bytes"]),
            "weights": {str(name): float(value) for name, value in found["weights"].items()},
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"it is no forecast: {error}") from error
