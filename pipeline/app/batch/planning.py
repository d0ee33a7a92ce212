"""Plans what each capture still needs: resolves options, checks the results folder, forecasts stages."""

from __future__ import annotations

import importlib.metadata
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

from splatpipe.pipeline.app.batch.capture_list import ListedCapture
from splatpipe.pipeline.app.batch.jobs.plan import BatchPlan, Call, PlannedCapture, StageJob
from splatpipe.pipeline.app.batch.jobs.shards import (
    MEMORY_MARGIN,
    NOTHING,
    counts_shards,
    missing_shards,
    shard_jobs,
    stage_job,
)
from splatpipe.pipeline.app.batch.jobs.workflow import GPU_STAGES
from splatpipe.pipeline.app.library.requests import Overrides, request_of
from splatpipe.pipeline.app.preflight.sizing import size_of
from splatpipe.pipeline.app.preflight.start import require_memory, require_readable
from splatpipe.pipeline.app.report.facts.run_history import read_history
from splatpipe.pipeline.engine.config import Table, dump, load_preset, merge
from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.output_file import require_own_files
from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes, free_memory_bytes
from splatpipe.pipeline.engine.runs.line import Line, StageStatus, line_status
from splatpipe.pipeline.engine.runs.lock import is_locked
from splatpipe.pipeline.engine.runs.needs import Need
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE, shard_events
from splatpipe.pipeline.engine.runs.session import Request, status_of
from splatpipe.pipeline.engine.runs.source import open_source
from splatpipe.pipeline.engine.runs.store import Part, is_copy
from splatpipe.pipeline.engine.stage import Shard, stage_name
from splatpipe.stages.forecast.needs import RunForecast, machine_speed
from splatpipe.stages.line import LINE

CLUSTER_THREADS = 8  # most threads of a job on another machine; a profile's set-threads overrides it
LIGHT_S = 300.0  # a shorter stage shares its job with its neighbours: an engine's queue costs some 30 s a job
MAX_SLUG_LETTERS = 40
NOT_RETRIED = "Nothing has changed since, so it was not retried; use --retry-failed to do so."


@dataclass(frozen=True)
class Settings:
    """The command's settings for all captures.

    Attributes:
        preset: The preset's name, for captures that name none.
        tables: Options, which a capture's own override.
        until: The last stage; empty for the whole pipeline.
        device: ``auto``, ``cpu`` or ``cuda``.
        gpu: Whether the stages that can use a GPU get one.
        threads: Threads per job; 0 to divide the machine.
        retries: How often a failed stage is retried.
        retry_failed: Also retry what failed because of its photos or options, even if nothing changed.
        local: Whether the jobs run on this machine.
        node_threads: Processors of the largest machine that runs jobs elsewhere; 0 if unknown.
        node_memory_bytes: Its memory; 0 if unknown.
    """

    preset: str = "standard"
    tables: tuple[Table, ...] = ()
    until: str = ""
    device: str = "auto"
    gpu: bool = False
    threads: int = 0
    retries: int = 0
    retry_failed: bool = False
    local: bool = True
    node_threads: int = 0
    node_memory_bytes: int = 0


@dataclass(frozen=True)
class _CaptureDraft:
    """A capture's plan before threads are divided.

    Attributes:
        planned: The capture without its jobs.
        needed: The requested stages.
        names: Those of them that are not valid.
        forecast_needs: Returns each stage's need for a number of threads.
        shards: Missing shards by stage, for those of ``names`` whose number of shards is known.
        divided: Whether shards are missing, or are expected to be.
    """

    planned: PlannedCapture
    needed: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    forecast_needs: Callable[[int], Mapping[str, Need]] = field(default=lambda _threads: {})
    shards: Mapping[str, Sequence[Shard]] = field(default_factory=dict)
    divided: bool = False


def make_plan(captures: Sequence[ListedCapture], call: Call, settings: Settings) -> BatchPlan:
    """Plan every capture without running anything; a problem with one capture does not affect the others.

    Args:
        captures: The captures as listed.
        call: The call, which stores each capture's resolved options for its jobs.
        settings: The command's settings.
    """
    began_s = time.time()
    drafts = [
        _draft_capture(capture, f"{at:04d}-{_slug(capture.name)}", call, settings)
        for at, capture in enumerate(captures, 1)
    ]
    threads = settings.threads or _threads(drafts, settings)
    planned = tuple(_with_jobs(draft, threads, settings) for draft in drafts)
    for draft in drafts:
        if draft.shards:
            needs = draft.forecast_needs(threads)
            call.write_shards(draft.planned.key, shard_jobs(draft.shards, needs, threads, local=settings.local))
    return BatchPlan(
        out=str(call.out),
        began_s=began_s,
        captures=planned,
        until=settings.until,
        device=settings.device,
        gpu=settings.gpu,
        retries=settings.retries,
        local=settings.local,
        node_memory_bytes=settings.node_memory_bytes,
    )


def _slug(name: str) -> str:
    return re.sub(r"[^0-9A-Za-z]+", "-", name).strip("-")[:MAX_SLUG_LETTERS]


def _draft_capture(capture: ListedCapture, key: str, call: Call, settings: Settings) -> _CaptureDraft:
    planned = PlannedCapture(capture.name, key, str(capture.photos), capture.preset or settings.preset)
    try:
        if capture.trouble is not None:
            raise capture.trouble
        return _resolve_capture(capture, planned, call, settings)
    except SplatpipeError as error:
        return _CaptureDraft(replace(planned, message=error.message, hint=error.hint))
    except OSError as error:
        trouble = MachineError(f"Cannot read {error.filename or capture.photos}: {error.strerror}.", "Check the disk.")
        return _CaptureDraft(replace(planned, message=trouble.message, hint=trouble.hint))


def _resolve_capture(capture: ListedCapture, planned: PlannedCapture, call: Call, settings: Settings) -> _CaptureDraft:
    tables = (*settings.tables, *capture.tables)
    config = Overrides(tables).resolve(load_preset(planned.preset))
    request = request_of(capture.photos.absolute(), call.out / capture.name, config)
    require_own_files([request.out])
    source = open_source(request.photos, request.out, request.stages, config)
    size = size_of(source)
    line = Line(request.stages, config, {name: Part(source.folder, "") for name in source.part_files}, source.folder)
    needed = [stage.name for stage in line.needed(settings.until or None)]
    planned = replace(planned, photos=str(request.photos), photo_count=size.photos)
    path = call.config_file(planned.key)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_durably(path, dump(merge(tables)))
    statuses = _statuses(request, needed)
    names = _to_run(request, needed, statuses)
    first = next((each for each in statuses if each.stage.name in names and each.artifact is None), None)
    if first is not None and not settings.retry_failed:
        planned = _with_previous_failure(planned, first, request.out)
    if names and not planned.message:
        planned = _with_input_error(planned, request, settings)
    memory = available_memory_bytes() if settings.local else settings.node_memory_bytes
    speed = machine_speed()

    def forecast(threads: int) -> RunForecast:
        return RunForecast.of(size, config, threads, memory)

    # If the stage that counts the shards has to run, it will determine their number.
    first_stages = [each for each in statuses if each.stage.name in names] if first else []
    shards = {} if planned.message else missing_shards(first_stages)
    divided = any(shards.values()) or forecast(1).training.division is not None
    names = () if planned.message else names
    return _CaptureDraft(planned, tuple(needed), names, lambda threads: forecast(threads).needs(speed), shards, divided)


def _with_input_error(planned: PlannedCapture, request: Request, settings: Settings) -> PlannedCapture:
    """Detect errors that would end the run before its first stage: such a failure leaves no trace in OUT."""
    try:
        require_readable(request)
        require_memory(request, settings.until or None, here=settings.local)
    except SplatpipeError as error:
        return replace(planned, message=error.message, hint=error.hint)
    return planned


def _statuses(request: Request, needed: Sequence[str]) -> list[StageStatus]:
    if not (request.out / "stages").is_dir():
        return []
    return [status for status in line_status(*status_of(request)) if status.stage.name in needed]


def _to_run(request: Request, needed: Sequence[str], statuses: Sequence[StageStatus]) -> tuple[str, ...]:
    """Stages that are not valid; the last one if all are valid but not all of its deliverables are in OUT.

    The stage that counts shards precedes them even if valid, which is quick: it saves the options for them.
    """
    if not statuses:
        return tuple(needed)
    names = {status.stage.name for status in statuses if status.artifact is None}
    if names:
        divided = (stage.shards for stage in request.stages if stage.name in names and stage.shards is not None)
        names |= {stage_name(shards.counted_by) for shards in divided}
        return tuple(name for name in needed if name in names)
    delivered = all(
        (request.out / name).is_file() and is_copy(file, request.out / name)
        for status in statuses
        if status.artifact is not None
        for name, file in status.artifact.deliverables(status.stage).items()
    )
    return () if delivered else (needed[-1],)


def _with_previous_failure(planned: PlannedCapture, first: StageStatus, out: Path) -> PlannedCapture:
    """If a stage failed on its input and the input is unchanged, keep that failure and run nothing."""
    for status in (first, *first.shards):
        for path in (out / EVENTS_FILE, shard_events(out, status.stage.name)):
            history = read_history(path, running=is_locked(out))
            culprit = history.culprit
            same_version = history.versions.get("splatpipe") == importlib.metadata.version("splatpipe")
            if culprit is None or culprit.state != "failed" or not culprit.permanent or not same_version:
                continue
            if (culprit.name, culprit.key) == (status.stage.name, status.key):
                hint = f"{culprit.hint} {NOT_RETRIED}".strip()
                return replace(planned, message=culprit.message, hint=hint, stage=culprit.name)
    return planned


def _threads(drafts: Sequence[_CaptureDraft], settings: Settings) -> int:
    """Threads per job: the machine's threads divided by the captures that can run at once; elsewhere those of a job.

    Many captures in parallel finish sooner than one after the other with all threads, some of which are always idle.
    """
    if not settings.local:
        return min(CLUSTER_THREADS, settings.node_threads or CLUSTER_THREADS)
    cores = available_cores()
    peaks = [max(_needs_of(draft, cores, draft.names).values(), key=_memory) for draft in drafts if draft.names]
    if not peaks:
        return 1
    room = free_memory_bytes()
    fitting = int(room // (MEMORY_MARGIN * max(map(_memory, peaks)))) if room else len(peaks)
    return max(1, cores // max(1, min(len(peaks), fitting, cores)))


def _needs_of(draft: _CaptureDraft, threads: int, names: Sequence[str]) -> dict[str, Need]:
    """The needs of stages; stages without a forecast count as almost nothing."""
    needs = draft.forecast_needs(threads)
    return {name: needs.get(name, NOTHING) for name in names}


def _memory(need: Need) -> int:
    return need.memory_bytes


def _with_jobs(draft: _CaptureDraft, threads: int, settings: Settings) -> PlannedCapture:
    needs = _needs_of(draft, threads, draft.needed)
    jobs = [stage_job(name, needs[name], threads, local=settings.local) for name in draft.names]
    if not settings.local:  # a stage that is turned off needs no job: the next one's command passes it
        jobs = [job for job in jobs if needs[job.stage].memory_bytes] or jobs[-1:]
        jobs = _joined(_with_room_to_decide(jobs), gpu=settings.gpu, divided=draft.divided)
    weights = {name: need.seconds(threads) for name, need in needs.items()}
    return replace(draft.planned, jobs=tuple(jobs), weights=weights)


def _with_room_to_decide(jobs: Sequence[StageJob]) -> list[StageJob]:
    """Let a stage that counts shards request what the stage with shards does: it decides by its own job's memory."""
    asked = {job.stage: job.memory_bytes for job in jobs}
    needed = {stage_name(each.shards.counted_by): asked.get(each.name, 0) for each in LINE if each.shards is not None}
    return [replace(job, memory_bytes=max(job.memory_bytes, needed.get(job.stage, 0))) for job in jobs]


def _joined(jobs: Sequence[StageJob], *, gpu: bool, divided: bool) -> list[StageJob]:
    """Join light stages that follow one another into one job each.

    If there are shards, they have jobs of their own, as has their stage, and the stage that counts them ends its job,
    so that they can start. If there are more than expected, the joined job runs them one after the other. Stages with
    and without a GPU are not joined.
    """
    sharded = {stage.name for stage in LINE if stage.shards is not None} if divided else set()
    return [
        replace(
            job,
            joined=max(job.seconds, after.seconds) < LIGHT_S
            and not {job.stage, after.stage} & sharded
            and not (divided and counts_shards(job.stage, LINE))
            and not (gpu and (job.stage in GPU_STAGES) != (after.stage in GPU_STAGES)),
        )
        for job, after in pairwise(jobs)
    ] + list(jobs[-1:])
