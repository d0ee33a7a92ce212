"""Commands on an OUT, with all that belongs to them: lock, log, worker, viewer and report, whatever happens.

The command line and the library call the same functions; they differ in who watches. Light to import: every command
of the command line loads it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from splatpipe.pipeline.engine.errors import SplatpipeError, StopSignal

if TYPE_CHECKING:
    from splatpipe.pipeline.engine.events import Event
    from splatpipe.pipeline.engine.runs.runner import Outcome, Runner
    from splatpipe.pipeline.engine.runs.session import Request

PART_VARIABLE = "SPLATPIPE_PART"  # set if further commands run more stages at once: success needs no report yet
STOP_S = 4.0  # after Ctrl-C the report is limited to this: a command promises to end within five seconds


class Watch:
    """Watches a command: is told its events and messages, and keeps what came of it, even if it fails.

    Attributes:
        outcome: The stages that ran or were reused; None until OUT is open.
        report: `report.html` as the command left it; None without one.
    """

    def __init__(self) -> None:
        self.outcome: Outcome | None = None
        self.report: Path | None = None

    def event(self, event: Event) -> None:
        """Receive an event."""

    def message(self, text: str) -> None:
        """Receive a message about the whole run, in a sentence or two; by default as an event, a note."""
        from splatpipe.pipeline.engine.events import Event

        self.event(Event("note", data={"message": text}))

    def pause(self) -> None:
        """Make room for messages: no stage is running any more."""


def run_line(
    request: Request,
    watch: Watch,
    *,
    until: str | None = None,
    rerun: frozenset[str] = frozenset(),
    wait: bool = False,
) -> None:
    """Run the pipeline on photos: check first what would end it only hours later, and forecast what it takes.

    Args:
        request: What to run.
        watch: Who watches.
        until: The last stage; None for all.
        rerun: Stages to run again even if they are valid.
        wait: Wait for another splatpipe that is working in OUT.

    Raises:
        SplatpipeError: if it cannot begin, or from the stage that failed; finished work is kept.
    """
    from splatpipe.pipeline.app.preflight.start import require_memory, require_readable

    require_readable(request)
    require_memory(request, until)
    _tell_forecast(request, until, watch)
    carry_out(request, watch, lambda runner: runner.walk(until=until, rerun=rerun), wait=wait)


def run_one_stage(name: str, request: Request, watch: Watch, *, shard: int | None = None, wait: bool = False) -> None:
    """Run one stage again, or one of its shards; no other stage except the one that divides it.

    Args:
        name: The stage.
        request: What to run.
        watch: Who watches.
        shard: The shard's number, from 1: others may be run by other processes at the same time. None for the stage.
        wait: Wait for another splatpipe that is working in OUT.

    Raises:
        SplatpipeError: if it cannot begin, or from the stage.
    """
    if shard is None:
        carry_out(request, watch, lambda runner: runner.run_alone(name), wait=wait)
    else:
        carry_out(request, watch, lambda runner: runner.run_shard(name, shard), wait=wait, shard=f"{name}.{shard}")


def carry_out(
    request: Request, watch: Watch, work: Callable[[Runner], object], *, wait: bool = False, shard: str = ""
) -> None:
    """Open OUT, do some work in it, and leave viewer and report as they have to be afterwards.

    Args:
        request: What to run.
        watch: Who watches.
        work: What to do with the runner.
        wait: Wait for another splatpipe that is working in OUT.
        shard: The only shard to run, e.g. ``train.2``. Others may be running in OUT: viewer and report, which cover
            them all, are left alone.

    Raises:
        SplatpipeError: if OUT or the photos cannot be used, and from the work.
    """
    try:
        _work_in_session(request, watch, work, wait, shard)
    except BaseException as error:
        if not shard and not isinstance(error, GeneratorExit | SystemExit) and not interrupted_again(error):
            _write_report(request.out, watch, error)
        raise
    if not shard and PART_VARIABLE not in os.environ:
        _write_report(request.out, watch, None)


def interrupted_again(error: BaseException | None) -> bool:
    """Whether the user pressed Ctrl-C again during the shutdown: then nothing is waited for."""
    before = None if error is None else error.__context__
    while before is not None and not isinstance(before, StopSignal):
        before = before.__context__
    return isinstance(error, StopSignal) and before is not None


def _work_in_session(request: Request, watch: Watch, work: Callable[[Runner], object], wait: bool, shard: str) -> None:
    from splatpipe.pipeline.engine.runs.session import open_session

    with open_session(request, watch.event, wait=wait, shard=shard) as runner:
        watch.outcome = runner.outcome
        try:
            work(runner)
        finally:
            watch.pause()
            if not shard:
                _update_viewer(request.out, watch)


def _tell_forecast(request: Request, until: str | None, watch: Watch) -> None:
    """Tell the forecast for the whole pipeline, before its first training, and whether memory may not suffice."""
    from splatpipe.pipeline.app.preflight.start import forecast_text, shortage_text

    trained = any((request.out / "stages").glob("train-*"))
    if trained or PART_VARIABLE in os.environ:
        return
    for text in (forecast_text(request) if until is None else "", shortage_text(request, until)):
        if text:
            watch.message(text)


def _update_viewer(out: Path, watch: Watch) -> None:
    """Update the measurements in the viewer while OUT is locked; problems are only reported."""
    from splatpipe.pipeline.app.measured_viewer import update_viewer

    try:
        trouble = update_viewer(out)
    except (OSError, SplatpipeError) as error:
        trouble = f"viewer.html could not be updated: {error}"
    if trouble:
        watch.message(trouble)


def _write_report(out: Path, watch: Watch, error: BaseException | None) -> None:
    """Write the report, unless OUT was not opened, or it is there and no stage ran; its problems are only reported."""
    from splatpipe.pipeline.app.report import REPORT_FILE, is_current, make_report
    from splatpipe.pipeline.engine.runs.run_folder import LOG_FILE

    if watch.outcome is None:
        return
    if error is None and not watch.outcome.ran and is_current(out):
        watch.report = out / REPORT_FILE
        return
    until_s = None
    if isinstance(error, StopSignal | KeyboardInterrupt):
        until_s = getattr(error, "at_s", time.monotonic()) + STOP_S
    try:
        watch.report = make_report(out, out / LOG_FILE, until_s=until_s)
    except SplatpipeError as trouble:
        watch.message(f"{trouble.message} {trouble.hint}".strip())
