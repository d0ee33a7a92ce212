"""A run on an OUT: opens the source, store, lock, log and worker, and closes them whatever happens."""

from __future__ import annotations

import importlib.metadata
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from pydantic import BaseModel

from splatpipe.pipeline.engine.config import dump
from splatpipe.pipeline.engine.digests import HashTable
from splatpipe.pipeline.engine.events import Event, EventLog, EventReporter, Sink
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.python_module import SAFE_PATH
from splatpipe.pipeline.engine.runs.ahead import NICENESS, Ahead
from splatpipe.pipeline.engine.runs.executor import GRACE_S, Executor, stop_all
from splatpipe.pipeline.engine.runs.job_runner import JobRunner
from splatpipe.pipeline.engine.runs.line import Line
from splatpipe.pipeline.engine.runs.lock import locked, locked_shard
from splatpipe.pipeline.engine.runs.needs import ForecastFunction, no_forecasts
from splatpipe.pipeline.engine.runs.run_folder import CONFIG_FILE, EVENTS_FILE, LOG_FILE, shard_events
from splatpipe.pipeline.engine.runs.runner import Runner
from splatpipe.pipeline.engine.runs.source import open_source
from splatpipe.pipeline.engine.runs.store import Part, Store, open_store, write_error
from splatpipe.pipeline.engine.stage import Machine, Stage


@dataclass(frozen=True)
class Request:
    """What to run.

    Attributes:
        stages: The pipeline.
        config: Its resolved configuration.
        photos: The user's folder.
        out: Where the results go.
        machine: Device and threads.
        forecast_needs: Forecasts each stage's resource use, for the manifests.
        ahead: Names of the stages that may run ahead of their turn on idle cores, each with that of the first stage
            beside which it may; empty: each in its turn.
    """

    stages: Sequence[Stage]
    config: BaseModel
    photos: Path
    out: Path
    machine: Machine
    forecast_needs: ForecastFunction = no_forecasts
    ahead: Mapping[str, str] = field(default_factory=dict)


class _Outlet:
    """Passes events on, those of several threads one after the other.

    Args:
        show: Shows events to the user.
        log: Logs them.
        confirm: Makes sure that OUT is still ours.
    """

    def __init__(self, show: Sink, log: Sink, confirm: Callable[[], None]) -> None:
        self._show, self._log, self._confirm = show, log, confirm
        self._lock = threading.RLock()

    def __call__(self, event: Event) -> None:
        with self._lock:
            self._show(event)  # first: a full disk stops the log but not the display
            self._log(event)
            self._confirm()


@contextmanager
def open_session(request: Request, show: Sink, *, wait: bool = False, shard: str = "") -> Iterator[Runner]:
    """Open everything that a run needs, and close it at the end.

    Args:
        request: What to run.
        show: Shows events to the user.
        wait: Wait for another splatpipe that is working in OUT.
        shard: The only shard to run, e.g. ``train.2``; other processes may run other shards at the same time. It has
            its own log and events; nothing else in OUT is written.

    Yields:
        The runner.

    Raises:
        SplatpipeError: if the photos or OUT cannot be used.
    """
    source = open_source(request.photos, request.out, request.stages, request.config)
    store = open_store(request.out, create=True)

    def notify(message: str) -> None:
        show(Event("note", data={"message": message}))

    lock = locked(store.out, wait=wait, notify=notify)
    events, log_file = store.out / EVENTS_FILE, store.out / LOG_FILE
    if shard:
        lock = locked_shard(store.out, shard, wait=wait, notify=notify)
        events, log_file = shard_events(store.out, shard), store.shards / f"{shard}.log"
    with lock as hold:
        log, descriptors = _open_log(store, events), tuple(hold.descriptors)
        environment = _worker_environment(request.machine.threads)
        executor = Executor(log_file, descriptors, environment)
        second = Executor(log_file, descriptors, environment, NICENESS)
        ahead: Ahead | None = None
        try:
            sink = _Outlet(show, log, hold.confirm)
            digests = partial(_digests, request, store, EventReporter("source", sink), remember=not shard)
            line = _open_line(request, digests())
            jobs = JobRunner(line, store, executor, request.machine, sink, digests, request.forecast_needs)
            if request.ahead and request.machine.threads > 1:  # else there is no idle core
                ahead = Ahead(jobs, second, request.ahead)
            yield Runner(jobs, partial(_save_config, store, source.folder), ahead)
        except BaseException:
            stop_all((executor, second))
            raise
        else:
            if ahead is not None:
                ahead.join(GRACE_S)
            executor.close()
            second.close()
        finally:
            if ahead is not None:
                ahead.join(GRACE_S)
            log.close()


def _open_log(store: Store, path: Path) -> EventLog:
    try:
        return EventLog(path)
    except OSError as error:
        raise write_error(store.out, error) from error


def status_of(request: Request) -> tuple[Line, Store]:
    """The pipeline and the store of an existing OUT, for reading its status only."""
    store = open_store(request.out, create=False)
    return _open_line(request, _digests(request, store, EventReporter("source", _discard), remember=False)), store


def _discard(_event: Event) -> None:
    """Discard an event: reading the status reports no progress."""


def _open_line(request: Request, digests: Mapping[str, str]) -> Line:
    source = open_source(request.photos, request.out, request.stages, request.config)
    parts = {name: Part(source.part_path(name), value) for name, value in digests.items()}
    return Line(request.stages, request.config, parts, source.folder)


def _digests(request: Request, store: Store, report: EventReporter, *, remember: bool) -> dict[str, str]:
    """Digests of the external parts; only files that changed since the last time are read."""
    source = open_source(request.photos, request.out, request.stages, request.config)
    return source.digests(
        HashTable(store.stages / "photos-index.json", remember=remember), request.machine.threads, report
    )


def _worker_environment(threads: int) -> dict[str, str]:
    """Environment variables for the worker: thread pool sizes, idle threads that sleep instead of spin, hash seed.

    Colours are off, since the log is not a terminal, whatever the user's own environment says.
    """
    return {
        "NO_COLOR": "1",
        "FORCE_COLOR": "",
        "CLICOLOR_FORCE": "",
        "TERM": "dumb",
        "OMP_NUM_THREADS": str(threads),
        "MKL_NUM_THREADS": str(threads),
        "OMP_WAIT_POLICY": "PASSIVE",
        "PYTHONHASHSEED": "0",
        **SAFE_PATH,
    }


def _save_config(store: Store, photos: Path, config: BaseModel) -> None:
    head = {"photos": os.fsdecode(photos), "splatpipe": importlib.metadata.version("splatpipe")}
    write_durably(store.out / CONFIG_FILE, dump({**head, **config.model_dump(mode="json")}))
