"""Runs stages ahead of their turn, one at a time, in a second worker beside the stage whose turn it is.

Few stages keep all cores busy, and on a machine with a graphics card the cores are idle while it trains. A stage whose
inputs are there may use them, if both fit the memory. Its worker stands back behind the other, which is hardly slowed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Self

from splatpipe.pipeline.engine.errors import EXIT_TERMINATED, MachineError, StopSignal
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.machine import free_memory_bytes, memory_limit_bytes
from splatpipe.pipeline.engine.runs.executor import Executor, KilledError
from splatpipe.pipeline.engine.runs.job_runner import Before, JobRunner
from splatpipe.pipeline.engine.runs.line import Job
from splatpipe.pipeline.engine.runs.store import Artifact
from splatpipe.pipeline.engine.stage import Stage, Summary

NICENESS = 10  # a tenth of the processor time of the other worker, where both want it
MEMORY_MARGIN = 1.3  # a forecast is within 30 % of what is used
MARKS = {"ahead": True}  # in a stage's manifest and first event: its seconds are those of the idle cores
# What says nothing about the stage itself: in its turn, with the machine to itself, it may succeed.
PASSING = (MachineError, KilledError, StopSignal)
AGAIN = "It ran beside another stage, and goes on in its turn."


@dataclass(frozen=True)
class Turn:
    """The stage whose turn it is.

    Attributes:
        stage: The stage.
        later: The stages after it, in order.
        rerun: Names of those to run again even if they are valid.
        before: What the stages before it have left.
    """

    stage: Stage
    later: Sequence[Stage]
    rerun: frozenset[str]
    before: Before


@dataclass(frozen=True)
class _Chosen:
    """A stage to run ahead, and what it may use."""

    job: Job
    before: Before
    began_s: float = field(default_factory=time.monotonic)


class Ahead:
    """The stages that run ahead of their turn. As a context, it ends the one that runs if an error leaves it.

    Args:
        jobs: Runs the stages whose turn it is.
        executor: The second worker.
        firsts: Names of the stages that may run ahead, each with that of the first stage beside which it may.
    """

    def __init__(self, jobs: JobRunner, executor: Executor, firsts: Mapping[str, str]) -> None:
        self._jobs, self._firsts = jobs, firsts
        self._own = replace(jobs, executor=executor, sink=self._tell, check=self._check, marks=MARKS)
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        # Under the lock:
        self._turn: Turn | None = None
        self._running: _Chosen | None = None
        self._ended: dict[str, Artifact | BaseException] = {}  # until their turn
        self._given_up = False  # nothing more runs ahead
        self._stopped = False
        self._broken: BaseException | None = None  # raised by the sink, not by a stage: it ends the run

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if error is not None or self._broken is not None:
            self._stop(error)
        if self._broken is not None:
            with self._jobs.plain_errors():
                raise self._broken

    @contextmanager
    def beside(self, turn: Turn) -> Iterator[None]:
        """While a stage has its turn, let others run beside it.

        If one is running that does not fit into memory together with this one, it is waited for first.

        Args:
            turn: The stage whose turn it is.
        """
        with self._changed:
            running = self._running
            if running is not None and not self._fits(running.job.stage, turn.stage, turn.before.summaries):
                self._changed.wait_for(lambda: self._running is None)
            self._turn = turn
            self._start()
        try:
            yield
        finally:
            with self._changed:
                self._turn = None

    def has(self, stage: str) -> bool:
        """Whether a stage runs ahead, or has run and not had its turn."""
        with self._changed:
            return stage in self._ended or self._is_running(stage)

    def take(self, stage: str) -> Artifact | None:
        """Return the artifact of a stage that ran ahead; waits for it. None if it has to run again in its turn.

        Raises:
            SplatpipeError: if the stage failed.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._is_running(stage))
            ended = self._ended.pop(stage, None)
        if isinstance(ended, BaseException):
            raise ended
        return ended

    def join(self, timeout_s: float) -> None:
        """Wait for the thread, once the worker has ended; after the timeout, it commits nothing any more either."""
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _stop(self, error: BaseException | None) -> None:
        """Ask the worker to end, and tell that its stage was stopped; what its thread tells from now on is dropped."""
        why = error if isinstance(error, StopSignal | KeyboardInterrupt) else StopSignal(EXIT_TERMINATED)
        with self._changed:
            self._stopped, running = True, self._running
            if running is not None:
                seconds = time.monotonic() - running.began_s
                with suppress(OSError, MachineError):  # what cannot be logged has been shown
                    self._jobs.sink(self._own.failure_event(running.job.inputs, seconds, why))
        self._own.executor.ask_to_end()

    def _start(self) -> None:
        """Start the next stage if none is running; the worker by this thread, which lives as long as the run."""
        if self._running is not None or (chosen := self._next()) is None:
            return
        try:
            self._own.executor.start()
        except (MachineError, OSError):  # e.g. a limit on processes: one worker suffices
            self._given_up = True
            return
        self._running = chosen
        self._thread = threading.Thread(target=self._work, args=(chosen,), name="ahead", daemon=True)
        self._thread.start()

    def _work(self, chosen: _Chosen | None) -> None:
        """Run a stage, then those that have become ready, while there are any: the thread."""
        while chosen is not None:
            ended: Artifact | BaseException
            try:
                ended = self._own.run(chosen.job, chosen.before)
            except BaseException as error:
                ended = error
            with self._changed:
                try:
                    chosen = self._end(chosen.job.stage.name, ended)
                finally:
                    self._changed.notify_all()
        if self._given_up:
            self._own.executor.stop()

    def _end(self, stage: str, ended: Artifact | BaseException) -> _Chosen | None:
        """Keep what came of a stage for its turn; return the next one to run."""
        self._running = None
        if self._stopped:
            return None
        if isinstance(ended, Artifact):
            self._ended[stage] = ended
            self._running = self._next()
            return self._running
        self._given_up = True
        if not isinstance(ended, PASSING):
            self._ended[stage] = ended
            return None
        with suppress(Exception):  # the run's own thread meets the same trouble
            self._jobs.sink(Event("note", stage, {"message": AGAIN}))
        return None

    def _next(self) -> _Chosen | None:
        """The first of the later stages that may run now, in their order."""
        turn, line = self._turn, self._own.line
        if turn is None or self._given_up or self._stopped:
            return None
        parts, summaries = dict(turn.before.parts), dict(turn.before.summaries)
        for stage in turn.later:
            artifact = self._ended.get(stage.name)
            if any(part not in parts for part in line.reads_of(stage)):
                continue
            job = Job(stage, line.inputs_of(stage, parts))
            if artifact is None and stage.name not in turn.rerun:
                artifact = self._own.store.find(stage, job.inputs.key)
            if isinstance(artifact, Artifact):
                parts |= artifact.parts
                summaries[stage.name] = artifact.summary
            elif self._may(stage, turn.stage) and self._fits(stage, turn.stage, summaries):
                return _Chosen(job, Before(parts, summaries))
        return None

    def _may(self, stage: Stage, beside: Stage) -> bool:
        """Whether a stage may run beside that one; one that is turned off takes no time in its turn."""
        names = [each.name for each in self._own.line.stages]
        first = self._firsts.get(stage.name)
        if first not in names or stage.shards is not None or self._own.line.is_off(stage):
            return False
        return names.index(first) <= names.index(beside.name)

    def _fits(self, stage: Stage, beside: Stage, summaries: Mapping[str, Summary]) -> bool:
        """Whether two stages fit into the memory together, of the machine, the user's limit, and what is free now."""
        needs = self._own.forecast_needs(summaries)
        if stage.name not in needs or beside.name not in needs:
            return False
        both = MEMORY_MARGIN * (needs[stage.name].memory_bytes + needs[beside.name].memory_bytes)
        held = self._jobs.executor.resident_bytes() + self._own.executor.resident_bytes()
        limit = memory_limit_bytes(self._own.machine.memory_bytes)
        return both <= min(limit, free_memory_bytes() + held)

    def _is_running(self, stage: str) -> bool:
        return self._running is not None and self._running.job.stage.name == stage

    def _tell(self, event: Event) -> None:
        with self._changed:
            self._check()
            try:
                self._jobs.sink(event)
            except BaseException as error:
                self._broken = error
                self._jobs.executor.ask_to_end()  # the run's own thread waits for its stage, which may be silent
                raise

    def _check(self) -> None:
        """Keep a stage from going on that was stopped.

        Raises:
            StopSignal: if it was.
        """
        if self._stopped:
            raise StopSignal(EXIT_TERMINATED)
