"""What each capture still needs: its options resolved, its folder of results surveyed, its stages forecast."""

from __future__ import annotations

import importlib.metadata
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from splatpipe.pipeline.app.batch.capture_list import ListedCapture
from splatpipe.pipeline.app.batch.plan import BatchPlan, Call, PlannedCapture
from splatpipe.pipeline.app.batch.shards import MEMORY_MARGIN, NOTHING, missing_shards, shard_jobs, stage_job
from splatpipe.pipeline.app.cli_runs import Overrides, request_of
from splatpipe.pipeline.app.preflight.sizing import size_of
from splatpipe.pipeline.app.preflight.start import require_memory, require_readable
from splatpipe.pipeline.app.report.run_history import read_history
from splatpipe.pipeline.engine.config import Table, dump, load_preset, merge
from splatpipe.pipeline.engine.durable import write_durably
from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.engine.line import Line, StageStatus, line_status
from splatpipe.pipeline.engine.lock import is_locked
from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes, free_memory_bytes
from splatpipe.pipeline.engine.needs import Need
from splatpipe.pipeline.engine.run_folder import EVENTS_FILE, shard_events
from splatpipe.pipeline.engine.session import Request, status_of
from splatpipe.pipeline.engine.source import open_source
from splatpipe.pipeline.engine.stage import Shard, stage_name
from splatpipe.pipeline.engine.store import Part, is_copy
from splatpipe.stages.forecast import forecast, machine_speed

CLUSTER_THREADS = 8  # of a job that another machine runs; a profile's set-threads says otherwise
LONGEST_SLUG = 40
UNTRIED = "Nothing has changed since, so it was not tried again; use --retry-failed to do so."


@dataclass(frozen=True)
class Settings:
    """What the command says of all captures.

    Attributes:
        preset: By name, for captures that name none.
        tables: Options, below a capture's own.
        until: The last stage; empty for the whole line.
        device: ``auto``, ``cpu`` or ``cuda``.
        gpu: Whether the stages that can use a GPU get one.
        threads: Of a job; 0 to divide the machine.
        retries: How often a stage that died is begun again.
        retry_failed: Try again what failed for its photos or options, too, though nothing changed.
        local: Whether the jobs run on this machine.
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


@dataclass(frozen=True)
class _CaptureForecast:
    """A capture before threads are divided.

    Attributes:
        planned: What is known of it.
        needed: Stages that are asked for.
        names: Those of them that are not valid.
        foresee: What each stage needs with so many threads.
        shards: That are not there, by those of ``names`` that are made of them, as far as their number is known.
    """

    planned: PlannedCapture
    needed: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    foresee: Callable[[int], Mapping[str, Need]] = field(default=lambda _threads: {})
    shards: Mapping[str, Sequence[Shard]] = field(default_factory=dict)


def make_plan(captures: Sequence[ListedCapture], call: Call, settings: Settings) -> BatchPlan:
    """Look at every capture and say what is to be done; nothing is run, and no capture's trouble is another's.

    Args:
        captures: As they were listed.
        call: Takes each capture's resolved options, for its jobs.
        settings: Of the command.
    """
    began_s = time.time()
    outlooks = [
        _look(capture, f"{at:04d}-{_slug(capture.name)}", call, settings) for at, capture in enumerate(captures, 1)
    ]
    threads = settings.threads or _threads(outlooks, local=settings.local)
    planned = tuple(_with_jobs(outlook, threads) for outlook in outlooks)
    for outlook in outlooks:
        if outlook.shards:
            call.write_shards(outlook.planned.key, shard_jobs(outlook.shards, outlook.foresee(threads), threads))
    return BatchPlan(
        out=str(call.out),
        began_s=began_s,
        captures=planned,
        until=settings.until,
        device=settings.device,
        gpu=settings.gpu,
        retries=settings.retries,
        local=settings.local,
    )


def _slug(name: str) -> str:
    return re.sub(r"[^0-9A-Za-z]+", "-", name).strip("-")[:LONGEST_SLUG]


def _look(capture: ListedCapture, key: str, call: Call, settings: Settings) -> _CaptureForecast:
    planned = PlannedCapture(capture.name, key, str(capture.photos), capture.preset or settings.preset)
    try:
        if capture.trouble is not None:
            raise capture.trouble
        return _outlook(capture, planned, call, settings)
    except SplatpipeError as error:
        return _CaptureForecast(replace(planned, message=error.message, hint=error.hint))
    except OSError as error:
        trouble = MachineError(f"Cannot read {error.filename or capture.photos}: {error.strerror}.", "Check the disk.")
        return _CaptureForecast(replace(planned, message=trouble.message, hint=trouble.hint))


def _outlook(capture: ListedCapture, planned: PlannedCapture, call: Call, settings: Settings) -> _CaptureForecast:
    tables = (*settings.tables, *capture.tables)
    config = Overrides(tables).resolve(load_preset(planned.preset))
    request = request_of(capture.photos.absolute(), call.out / capture.name, config)
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
        planned = _with_kept_failure(planned, first, request.out)
    if names and not planned.message:
        planned = _with_broken_file(planned, request)
    memory = available_memory_bytes() if settings.local else 0
    foresee = partial(forecast, size, config, speed=machine_speed(), machine_bytes=memory)
    # Where the stage that counts them is to run, it says how many there are then.
    counted = [each for each in statuses if each.stage.name in names] if first else []
    shards = {} if planned.message else missing_shards(counted)
    return _CaptureForecast(planned, tuple(needed), () if planned.message else names, foresee, shards)


def _with_broken_file(planned: PlannedCapture, request: Request) -> PlannedCapture:
    """What the run would end with before its first stage is told without one: such an end leaves no trace in OUT."""
    try:
        require_readable(request)
        require_memory(request)
    except SplatpipeError as error:
        return replace(planned, message=error.message, hint=error.hint)
    return planned


def _statuses(request: Request, needed: Sequence[str]) -> list[StageStatus]:
    if not (request.out / "stages").is_dir():
        return []
    return [status for status in line_status(*status_of(request)) if status.stage.name in needed]


def _to_run(request: Request, needed: Sequence[str], statuses: Sequence[StageStatus]) -> tuple[str, ...]:
    """Stages that are not valid; the last one where all are, but not all of what it delivered lies in OUT.

    Before shards comes the stage that counts them, a moment's work where it is valid: it leaves the options for them.
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


def _with_kept_failure(planned: PlannedCapture, first: StageStatus, out: Path) -> PlannedCapture:
    """A stage that could do nothing with its input gets the same input: what it said then holds, and nothing runs."""
    for status in (first, *first.shards):
        for path in (out / EVENTS_FILE, shard_events(out, status.stage.name)):
            history = read_history(path, running=is_locked(out))
            culprit = history.culprit
            alike = history.versions.get("splatpipe") == importlib.metadata.version("splatpipe")
            if culprit is None or culprit.state != "failed" or not culprit.lasting or not alike:
                continue
            if (culprit.name, culprit.key) == (status.stage.name, status.key):
                hint = f"{culprit.hint} {UNTRIED}".strip()
                return replace(planned, message=culprit.message, hint=hint, stage=culprit.name)
    return planned


def _threads(outlooks: Sequence[_CaptureForecast], *, local: bool) -> int:
    """Threads of a job: the machine divided by the captures that can be under way at once.

    Many captures side by side are done sooner than one after the other with all threads, of which some always wait.
    """
    if not local:
        return CLUSTER_THREADS
    cores = available_cores()
    peaks = [max(_of(outlook, cores, outlook.names).values(), key=_memory) for outlook in outlooks if outlook.names]
    if not peaks:
        return 1
    room = free_memory_bytes()
    fitting = int(room // (MEMORY_MARGIN * max(map(_memory, peaks)))) if room else len(peaks)
    return max(1, cores // max(1, min(len(peaks), fitting, cores)))


def _of(outlook: _CaptureForecast, threads: int, names: Sequence[str]) -> dict[str, Need]:
    """What stages need; one that the forecast does not know costs next to nothing."""
    foreseen = outlook.foresee(threads)
    return {name: foreseen.get(name, NOTHING) for name in names}


def _memory(need: Need) -> int:
    return need.memory_bytes


def _with_jobs(outlook: _CaptureForecast, threads: int) -> PlannedCapture:
    needs = _of(outlook, threads, outlook.needed)
    jobs = tuple(stage_job(name, needs[name], threads) for name in outlook.names)
    return replace(outlook.planned, jobs=jobs, weights={name: need.seconds(threads) for name, need in needs.items()})
