"""Walks the pipeline: reuses what is valid, runs what is not, and reports which and why."""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from pydantic import BaseModel

from splatpipe.pipeline.engine.errors import (
    EXIT_INPUT,
    MachineError,
    SplatpipeError,
    StageError,
    StopSignal,
    UsageError,
    exit_code,
)
from splatpipe.pipeline.engine.events import Event, Sink
from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes
from splatpipe.pipeline.engine.runs.executor import Executor
from splatpipe.pipeline.engine.runs.line import Job, Line, explain, line_status
from splatpipe.pipeline.engine.runs.needs import ForecastFunction, no_forecasts, of_shard, used_with_shards
from splatpipe.pipeline.engine.runs.source import FILM_SUFFIXES
from splatpipe.pipeline.engine.runs.store import MIN_FREE_BYTES, Artifact, Part, StageInputs, Store
from splatpipe.pipeline.engine.runs.worker import Task
from splatpipe.pipeline.engine.stage import JSON, Machine, Stage, Summary, stage_name

VERSIONED = (
    "splatpipe",
    "torch",
    "pycolmap",
    "opencv-contrib-python-headless",
    "kornia",
    "numpy",
    "scipy",
    "pillow",
    "pyproj",
)


@dataclass
class Outcome:
    """The result of a walk: artifacts by stage, the stages that ran, and the one that failed."""

    artifacts: dict[str, Artifact] = field(default_factory=dict)
    ran: list[str] = field(default_factory=list)
    failed: str = ""


@dataclass(frozen=True)
class Runner:
    """Runs a pipeline into a store.

    Attributes:
        line: What to run.
        store: Where artifacts are kept.
        executor: Runs the bodies.
        machine: Device and threads.
        sink: Receives the events.
        source_now: Returns the current digests of the external parts.
        save_config: Saves the configuration in OUT; called once it is known that something can run with it.
        forecast_needs: Forecasts each stage's resource use; recorded beside the measured use.
        outcome: What was done so far, even if the walk ends in an error.
    """

    line: Line
    store: Store
    executor: Executor
    machine: Machine
    sink: Sink
    source_now: Callable[[], Mapping[str, str]]
    save_config: Callable[[BaseModel], None]
    forecast_needs: ForecastFunction = no_forecasts
    outcome: Outcome = field(default_factory=Outcome)

    def walk(self, *, until: str | None = None, rerun: frozenset[str] = frozenset()) -> Outcome:
        """Run the pipeline: reuse what is valid, run the rest.

        Args:
            until: The last stage to run; all if None.
            rerun: Stages to run again even if they are valid.

        Raises:
            SplatpipeError: from the first stage that failed; earlier results are kept.
        """
        with self._plain_errors():
            self.store.recover()
            self.save_config(self.line.config)
        parts = dict(self.line.source)
        outcome = self.outcome
        needed = self.line.needed(until)
        with self._run_events([stage.name for stage in needed]):
            for stage in needed:
                job = Job(stage, self.line.inputs_of(stage, parts))
                artifact = self._reuse(job, again=stage.name in rerun)
                if artifact is None:
                    artifact = self._run_with_shards(job, parts, again=stage.name in rerun)
                parts.update(artifact.parts)
                with self._plain_errors():
                    self.store.deliver(artifact, stage)
        return outcome

    def run_alone(self, name: str) -> Outcome:
        """Run one stage again, valid or not, and those of its shards that are missing.

        The stage that counts the shards is run if it is missing.

        Raises:
            UsageError: if a stage that it reads from is not valid.
        """
        with self._plain_errors():
            self.store.recover()
        stage, parts, counting = self._prepare(name)
        with self._plain_errors():
            self.save_config(self.line.config)
        needed = [*counting, stage]
        with self._run_events([each.name for each in needed]):
            for each in needed:
                artifact = self._run_with_shards(Job(each, self.line.inputs_of(each, parts)), parts)
                parts.update(artifact.parts)
                with self._plain_errors():
                    self.store.deliver(artifact, each)
        return self.outcome

    def run_shard(self, name: str, number: int) -> Outcome:
        """Run one shard of a stage and nothing else; an existing valid one is reused.

        Args:
            name: The stage's name.
            number: The shard's number, counted from 1.

        Raises:
            UsageError: if there is no such shard, or a stage it reads from is not valid.
        """
        with self._plain_errors():
            self.store.recover(f"{name}.{number}")
        stage, parts, counting = self._prepare(name)
        if counting:
            raise self._not_ready(name, counting)
        jobs = self.line.shards_of(stage, parts)
        if not 1 <= number <= len(jobs):
            has = f"{len(jobs)} here" if stage.shards else "none"
            raise UsageError(
                f"The stage {name} has no shard {number}: it has {has}.",
                hint=f"Omit --shard, or see splatpipe status {self.store.out}",
            )
        job = jobs[number - 1]
        with self._run_events([job.stage.name]):
            self._reuse(job) or self._run(job, parts)
        return self.outcome

    def _prepare(self, name: str) -> tuple[Stage, dict[str, Part], list[Stage]]:
        """Return a stage, the parts of the valid stages before it, and the stage to run first, which counts its shards.

        Raises:
            UsageError: if any other stage it reads from is not valid.
        """
        parts = dict(self.line.source)
        for status in line_status(self.line, self.store):
            if status.stage.name == name:
                break
            if status.artifact is not None:
                self.outcome.artifacts[status.stage.name] = status.artifact
                parts.update(status.artifact.parts)
        stage = next(stage for stage in self.line.stages if stage.name == name)
        absent = {stage_name(part) for part in self.line.reads_of(stage) if part not in parts}
        missing = [earlier for earlier in self.line.stages if earlier.name in absent]
        counts = stage_name(stage.shards.counted_by) if stage.shards else ""
        if missing and [earlier.name for earlier in missing] != [counts]:
            raise self._not_ready(name, missing)
        for counting in missing:
            self._prepare(counting.name)
        return stage, parts, missing

    def _not_ready(self, name: str, missing: Sequence[Stage]) -> UsageError:
        names = [stage.name for stage in missing]
        return UsageError(
            f"The stage {name} needs the output of {', '.join(names)}, which is missing or out of date.",
            hint=f"Run the pipeline up to there first: splatpipe run PHOTOS {self.store.out} --until {names[-1]}",
        )

    @contextmanager
    def _run_events(self, stages: Sequence[str]) -> Iterator[None]:
        """Emit the events of a run's start and end, even if it fails."""
        began_s = time.monotonic()
        machine = {**asdict(self.machine), **describe_machine()}
        self.sink(Event("run_started", data={"stages": list(stages), "machine": machine, "versions": versions()}))
        ended: BaseException | None = None
        try:
            yield
        except BaseException as error:
            ended = error
            raise
        finally:
            ending = {"message": "" if ended is None else str(ended), "hint": getattr(ended, "hint", "")}
            seconds = round(time.monotonic() - began_s, 3)
            with suppress(OSError, MachineError):  # a full or taken-over OUT ended the run and is reported anyway
                self.sink(Event("run_finished", data={"exit_code": exit_code(ended), **ending, "seconds": seconds}))

    def _reuse(self, job: Job, *, again: bool = False) -> Artifact | None:
        """The valid artifact of a job, reported as reused; None if the job has to run."""
        artifact = None if again else self.store.find(job.stage, job.inputs.key)
        if artifact is not None:
            data = {"summary": artifact.summary, "seconds": artifact.manifest["seconds"], "key": artifact.key}
            self.sink(Event("stage_reused", job.stage.name, data))
            self.outcome.artifacts[job.stage.name] = artifact
        return artifact

    def _run_with_shards(self, job: Job, parts: Mapping[str, Part], *, again: bool = False) -> Artifact:
        """Run a stage: first its missing shards, one after the other, then the body that joins them.

        A shard that fails with a StageError does not stop the others: the error is raised after they have run.

        Args:
            job: The stage's job.
            parts: The parts available.
            again: Run all shards again, even valid ones.
        """
        shards: list[Artifact] = []
        failures: list[tuple[str, StageError]] = []
        for shard in self.line.shards_of(job.stage, parts):
            try:
                shards.append(self._reuse(shard, again=again) or self._run(shard, parts))
            except StageError as error:
                failures.append((shard.stage.name, error))
        if failures:
            self.outcome.failed, first = failures[0]
            raise first
        return self._run(job, parts, shards)

    def _run(self, job: Job, parts: Mapping[str, Part], shards: Sequence[Artifact] = ()) -> Artifact:
        stage, inputs, outcome = job.stage, job.inputs, self.outcome
        outcome.failed = stage.name
        began_s = time.monotonic()
        known = self.store.find(stage, inputs.key) is not None
        reason = "requested" if known else explain(inputs, self.store.artifacts(stage.name))
        reason = f"{job.shard}: {reason}" if job.shard else reason
        of = {"shard": asdict(job.shard)} if job.shard else {}
        self.sink(Event("stage_started", stage.name, {"reason": reason, "key": inputs.key, **of}))
        try:
            with self._plain_errors():
                self._check_space()
                partial = self.store.begin(stage, inputs.key)
                result = self.executor.run(self._task(job, parts, shards, partial), self.sink)
                self._check_source(stage)
                summary: Summary = result.pop("summary")
                result = used_with_shards(result, [shard.manifest for shard in shards])
                run = {
                    **result,
                    "machine": {**asdict(self.machine), **describe_machine()},
                    "versions": versions(),
                    **self._recorded_forecast(job),
                }
                artifact = self.store.commit(stage, inputs, partial, summary, run)
        except (SplatpipeError, StopSignal, KeyboardInterrupt) as error:
            with suppress(OSError, MachineError):  # what cannot be logged has been shown
                self.sink(self._failure_event(inputs, time.monotonic() - began_s, error))
            raise
        outcome.ran.append(stage.name)
        outcome.failed = ""
        outcome.artifacts[stage.name] = artifact
        self.sink(Event("stage_finished", stage.name, {"summary": summary, **result, "key": inputs.key}))
        return artifact

    def _task(self, job: Job, parts: Mapping[str, Part], shards: Sequence[Artifact], partial: Path) -> Task:
        stage = job.stage
        return Task(
            stage=stage.name,
            entry=stage.entry,
            config_type=f"{stage.config.__module__}:{stage.config.__qualname__}",
            config=dict(job.inputs.config),
            parts={name: str(parts[name].path) for name in job.inputs.reads},
            photos_dir=str(self.line.photos_dir),
            settings=dict(job.inputs.borrowed),
            summaries={name: dict(done.summary) for name, done in self.outcome.artifacts.items()},
            machine=asdict(self.machine),
            out=str(partial),
            shard=asdict(job.shard) if job.shard else None,
            shards=[str(shard.folder) for shard in shards],
        )

    def _recorded_forecast(self, job: Job) -> dict[str, JSON]:
        """The forecast of resource use, for the manifest; empty if there is none."""
        needs = self.forecast_needs({name: done.summary for name, done in self.outcome.artifacts.items()})
        name = stage_name(job.stage.name)
        need = of_shard(needs, name, job.shard) if job.shard else needs.get(name)
        return {} if need is None else {"forecast": need.as_json()}

    def _failure_event(self, inputs: StageInputs, seconds: float, error: BaseException) -> Event:
        """The event of a stage's failure; built while the worker is alive, so that its peak memory can be read."""
        message, hint = (error.message, error.hint) if isinstance(error, SplatpipeError) else ("Stopped.", "")
        data: dict[str, JSON] = {"message": message, "hint": hint, "exit_code": exit_code(error), "key": inputs.key}
        data |= {"seconds": round(seconds, 3), "peak_memory_bytes": self.executor.peak_memory_bytes()}
        data["lasting"] = data["exit_code"] == EXIT_INPUT and self._source_is_unchanged()
        return Event("stage_failed", inputs.stage, data)

    def _check_source(self, stage: Stage) -> None:
        """Check that the source has not changed, since an artifact's key states what the stage read.

        Raises:
            SplatpipeError: if it has changed.
        """
        read = [name for name in self.line.reads_of(stage) if name in self.line.source]
        if not read:
            return
        now = self.source_now()
        changed = [name for name in read if now.get(name, "") not in ("", self.line.source[name].digest)]
        if changed:
            what = "The photos" if "source.photos" in changed else "The survey's files"
            raise SplatpipeError(
                f"{what} changed while the stage {stage.name} was reading them.",
                hint="Run again when nothing is writing to them; earlier results are reused.",
            )

    def _check_space(self) -> None:
        free = shutil.disk_usage(self.store.out).free
        if free < MIN_FREE_BYTES:
            raise MachineError(
                f"The disk of {self.store.out} is full: {free >> 20} MiB are free, and a stage "
                f"needs at least {MIN_FREE_BYTES >> 20}.",
                hint="Free some space, then run again: it resumes from here.",
            )

    @contextmanager
    def _plain_errors(self) -> Iterator[None]:
        """Turn errors caused by a full, failing or missing disk, here or in the worker, into a plain message."""
        try:
            yield
        except OSError as error:
            self._check_places()
            raise MachineError(
                f"Cannot write to {self.store.out}: {error.strerror or error}.",
                hint="Free some space or check the permissions, then run again: it resumes from here.",
            ) from error
        except SplatpipeError as error:
            self._check_places()
            if isinstance(error, StageError):
                self._check_space()
            raise

    def _source_is_unchanged(self) -> bool:
        """Whether the user's files are unchanged since the run began, so that the same error would recur."""
        try:
            now = self.source_now()
        except (SplatpipeError, OSError):
            return False
        return all(now.get(name, "") in ("", part.digest) for name, part in self.line.source.items())

    def _check_places(self) -> None:
        """Check for the cause of many errors: a disk that is no longer there.

        Raises:
            MachineError: if OUT has disappeared.
            SplatpipeError: if the photo folder, or the film, has disappeared.
        """
        if not self.store.stages.is_dir():
            raise MachineError(
                f"{self.store.out} has disappeared.",
                hint="Was its disk disconnected, or the folder removed or renamed? Run again when it is back.",
            )
        if not self.line.photos_dir.exists():
            what = "film" if self.line.photos_dir.suffix.casefold() in FILM_SUFFIXES else "photo folder"
            raise SplatpipeError(
                f"The {what} {self.line.photos_dir} has disappeared.",
                hint="Restore it, then run again: finished work is kept.",
            )


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that affect results, for the manifest."""
    found = {"python": platform.python_version()}
    for name in VERSIONED:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def describe_machine() -> dict[str, JSON]:
    """The machine, for the manifest: system, processor family, and the cores and memory available to this process."""
    return {
        "system": platform.system(),
        "processor": platform.machine(),
        "cores": available_cores(),
        "memory_bytes": available_memory_bytes(),
    }
