"""Runs one job: has a worker execute it, checks what it read, and commits its artifact, all with its events."""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from splatpipe.pipeline.engine.errors import (
    EXIT_INPUT,
    MachineError,
    SplatpipeError,
    StageError,
    StopSignal,
    exit_code,
)
from splatpipe.pipeline.engine.events import Event, Sink
from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes
from splatpipe.pipeline.engine.runs.executor import Executor
from splatpipe.pipeline.engine.runs.line import Job, Line, explain
from splatpipe.pipeline.engine.runs.needs import ForecastFunction, no_forecasts, of_shard, used_with_shards
from splatpipe.pipeline.engine.runs.source import FILM_SUFFIXES
from splatpipe.pipeline.engine.runs.store import MIN_FREE_BYTES, Artifact, Part, StageInputs, Store, unchecked
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


@dataclass(frozen=True)
class Before:
    """What the stages before a job have left.

    Attributes:
        parts: Parts by full name.
        summaries: Summaries by stage.
    """

    parts: Mapping[str, Part]
    summaries: Mapping[str, Summary]


@dataclass(frozen=True)
class JobRunner:
    """Runs jobs of a pipeline in a worker.

    Attributes:
        line: The pipeline.
        store: Where artifacts are kept.
        executor: Runs the bodies.
        machine: Device and threads.
        sink: Receives the events.
        source_now: Returns the current digests of the external parts.
        forecast_needs: Forecasts each stage's resource use; recorded beside the measured use.
        check: Called while an artifact is committed, until it is; what it raises leaves it uncommitted.
        marks: Recorded in manifests and told with the start of each job.
    """

    line: Line
    store: Store
    executor: Executor
    machine: Machine
    sink: Sink
    source_now: Callable[[], Mapping[str, str]]
    forecast_needs: ForecastFunction = no_forecasts
    check: Callable[[], None] = unchecked
    marks: Mapping[str, JSON] = field(default_factory=dict)

    def run(self, job: Job, before: Before, shards: Sequence[Artifact] = ()) -> Artifact:
        """Run a job, valid or not, and commit its artifact.

        Args:
            job: The job.
            before: What it may use.
            shards: The artifacts of its shards, which it joins.

        Raises:
            SplatpipeError: if it failed, or its worker died, or the disk is full or gone.
        """
        stage, inputs = job.stage, job.inputs
        began_s = time.monotonic()
        known = self.store.find(stage, inputs.key) is not None
        reason = "requested" if known else explain(inputs, self.store.artifacts(stage.name))
        reason = f"{job.shard}: {reason}" if job.shard else reason
        of = {"shard": asdict(job.shard)} if job.shard else {}
        self.sink(Event("stage_started", stage.name, {"reason": reason, "key": inputs.key, **of, **self.marks}))
        try:
            with self.plain_errors():
                self._check_space()
                partial = self.store.begin(stage, inputs.key)
                result = self.executor.run(self._task(job, before, shards, partial), self.sink)
                self._check_source(stage)
                summary: Summary = result.pop("summary")
                result = used_with_shards(result, [shard.manifest for shard in shards])
                run = {
                    **result,
                    "machine": {**asdict(self.machine), **describe_machine()},
                    "versions": versions(),
                    **self._recorded_forecast(job, before),
                    **self.marks,
                }
                artifact = self.store.commit(stage, inputs, partial, summary, run, self.check)
        except (SplatpipeError, StopSignal, KeyboardInterrupt) as error:
            with suppress(OSError, MachineError):  # what cannot be logged has been shown
                self.sink(self.failure_event(inputs, time.monotonic() - began_s, error))
            raise
        self.sink(Event("stage_finished", stage.name, {"summary": summary, **result, "key": inputs.key}))
        return artifact

    def _task(self, job: Job, before: Before, shards: Sequence[Artifact], partial: Path) -> Task:
        stage = job.stage
        return Task(
            stage=stage.name,
            entry=stage.entry,
            config_type=f"{stage.config.__module__}:{stage.config.__qualname__}",
            config=dict(job.inputs.config),
            parts={name: str(before.parts[name].path) for name in job.inputs.reads},
            photos_dir=str(self.line.photos_dir),
            settings=dict(job.inputs.borrowed),
            summaries=dict(before.summaries),
            machine=asdict(self.machine),
            out=str(partial),
            shard=asdict(job.shard) if job.shard else None,
            shards=[str(shard.folder) for shard in shards],
        )

    def _recorded_forecast(self, job: Job, before: Before) -> dict[str, JSON]:
        """The forecast of resource use, for the manifest; empty if there is none."""
        needs = self.forecast_needs(before.summaries)
        name = stage_name(job.stage.name)
        need = of_shard(needs, name, job.shard) if job.shard else needs.get(name)
        return {} if need is None else {"forecast": need.as_json()}

    def failure_event(self, inputs: StageInputs, seconds: float, error: BaseException) -> Event:
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
    def plain_errors(self) -> Iterator[None]:
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
