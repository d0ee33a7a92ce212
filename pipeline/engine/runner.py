"""Walks the line: finds what is valid, runs what is not, and says which and why."""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import BaseModel

from splatpipe.pipeline.engine.config import settings_of
from splatpipe.pipeline.engine.errors import (
    EXIT_INPUT,
    MachineError,
    SplatpipeError,
    StageError,
    Stopped,
    UsageError,
    exit_code,
)
from splatpipe.pipeline.engine.events import Event, Sink
from splatpipe.pipeline.engine.executor import Executor
from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes
from splatpipe.pipeline.engine.needs import Foresight, unforeseen
from splatpipe.pipeline.engine.stage import JSON, Machine, Stage, Summary
from splatpipe.pipeline.engine.store import MIN_FREE_BYTES, Artifact, Part, StageInputs, Store
from splatpipe.pipeline.engine.worker import Task

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
State = Literal["valid", "stale", "missing", "waiting"]


@dataclass(frozen=True)
class Line:
    """A line with everything that its answer depends on.

    Attributes:
        stages: In order; each reads parts of those before it.
        config: The resolved configuration, a section a stage.
        source: External parts by name, e.g. ``source.photos``.
        photos_dir: The user's folder.
    """

    stages: Sequence[Stage]
    config: BaseModel
    source: Mapping[str, Part]
    photos_dir: Path

    def needed(self, until: str | None = None) -> list[Stage]:
        """The stages to walk from what the source does not give: those that lead to ``until``, else to deliverables."""
        names = [stage.name for stage in self.stages]
        last = names.index(until) if until else len(names) - 1
        wanted = {names[last]} if until else {names[last], *(stage.name for stage in self.stages if stage.deliverables)}
        for stage in reversed(self.stages[: last + 1]):
            if stage.name in wanted:
                wanted |= {part.split(".")[0] for part in stage.reads if part not in self.source}
        return [stage for stage in self.stages[: last + 1] if stage.name in wanted]

    def inputs_of(self, stage: Stage, parts: Mapping[str, Part]) -> StageInputs:
        """What a stage's key is made of."""
        reads = {name: parts[name].digest for name in stage.reads}
        return StageInputs(stage.name, stage.version, *settings_of(self.config, stage), reads)


@dataclass(frozen=True)
class Standing:
    """Where a stage stands without running anything: its artifact where it is valid, else why it is not."""

    stage: Stage
    state: State
    key: str = ""
    reason: str = ""
    artifact: Artifact | None = None


def survey(line: Line, store: Store) -> Iterator[Standing]:
    """Say of every needed stage whether it is valid, and if not why, without running anything."""
    parts = dict(line.source)
    for stage in line.needed():
        missing = [name for name in stage.reads if name not in parts]
        if missing:
            behind = sorted({name.split(".")[0] for name in missing})
            yield Standing(stage, "waiting", reason=f"waits for {', '.join(behind)}")
            continue
        inputs = line.inputs_of(stage, parts)
        artifact = store.find(stage, inputs.key)
        if artifact is None:
            earlier = store.artifacts(stage.name)
            yield Standing(stage, "stale" if earlier else "missing", inputs.key, explain(inputs, earlier))
        else:
            parts.update(artifact.parts)
            yield Standing(stage, "valid", inputs.key, artifact=artifact)


def explain(inputs: StageInputs, earlier: Iterable[Artifact]) -> str:
    """Why a stage has to run, against its newest artifact."""
    newest = next(iter(earlier), None)
    if newest is None:
        return "not run yet"
    before = newest.manifest["inputs"]
    reasons = []
    if before["version"] != inputs.version:
        reasons.append(f"splatpipe's {inputs.stage} changed")
    for mine, old, prefix in (
        (inputs.config, before["config"], f"{inputs.stage}."),
        (inputs.borrowed, before["borrowed"], ""),
    ):
        reasons += [
            f"{prefix}{name} changed from {old.get(name)} to {mine.get(name)}"
            for name in sorted({*mine, *old})
            if mine.get(name) != old.get(name)
        ]
    reasons += [f"{name} changed" for name in inputs.reads if before["reads"].get(name) != inputs.reads[name]]
    return ", ".join(reasons) or "its files are damaged or gone"


@dataclass
class Outcome:
    """What a walk did: artifacts by stage, the stages that ran, and the one that failed."""

    artifacts: dict[str, Artifact] = field(default_factory=dict)
    ran: list[str] = field(default_factory=list)
    failed: str = ""


@dataclass(frozen=True)
class Runner:
    """Runs a line into a store.

    Attributes:
        line: What to run.
        store: Where artifacts lie.
        executor: Runs the bodies.
        machine: Device and threads.
        sink: Takes the events.
        source_now: Digests of the external parts as they are at this moment.
        save_config: Keeps the configuration in OUT; called once it is known that something can run with it.
        foresee: What each stage will take; written beside what it took.
        outcome: What was done so far, also when it ends in an error.
    """

    line: Line
    store: Store
    executor: Executor
    machine: Machine
    sink: Sink
    source_now: Callable[[], Mapping[str, str]]
    save_config: Callable[[BaseModel], None]
    foresee: Foresight = unforeseen
    outcome: Outcome = field(default_factory=Outcome)

    def walk(self, *, until: str | None = None, rerun: frozenset[str] = frozenset()) -> Outcome:
        """Run the line: reuse what is valid, run the rest.

        Args:
            until: The last stage to run; all if None.
            rerun: Stages to run again though they are valid.

        Raises:
            SplatpipeError: the first stage that failed; what came before it stays.
        """
        with self._explained():
            self.store.recover()
            self.save_config(self.line.config)
        parts = dict(self.line.source)
        outcome = self.outcome
        needed = self.line.needed(until)
        with self._told([stage.name for stage in needed]):
            for stage in needed:
                inputs = self.line.inputs_of(stage, parts)
                artifact = self.store.find(stage, inputs.key)
                if artifact is not None and stage.name not in rerun:
                    data = {"summary": artifact.summary, "seconds": artifact.manifest["seconds"], "key": inputs.key}
                    self.sink(Event("stage_reused", stage.name, data))
                else:
                    reason = "asked for" if artifact else explain(inputs, self.store.artifacts(stage.name))
                    artifact = self._run(stage, inputs, parts, reason)
                outcome.artifacts[stage.name] = artifact
                parts.update(artifact.parts)
                with self._explained():
                    self.store.deliver(artifact, stage)
        return outcome

    def run_alone(self, name: str) -> Outcome:
        """Run one stage again, whether or not it is valid, and nothing else.

        Raises:
            UsageError: if a stage that it reads from is not valid.
        """
        with self._explained():
            self.store.recover()
        outcome = self.outcome
        parts = dict(self.line.source)
        for standing in survey(self.line, self.store):
            if standing.stage.name == name:
                break
            if standing.artifact is not None:
                outcome.artifacts[standing.stage.name] = standing.artifact
                parts.update(standing.artifact.parts)
        stage = next(stage for stage in self.line.stages if stage.name == name)
        absent = {part.split(".")[0] for part in stage.reads if part not in parts}
        missing = [earlier.name for earlier in self.line.stages if earlier.name in absent]
        if missing:
            raise UsageError(
                f"The stage {name} reads what {', '.join(missing)} leaves, and that is not there or no longer valid.",
                hint=f"Run the line up to there first: splatpipe run PHOTOS {self.store.out} --until {missing[-1]}",
            )
        with self._explained():
            self.save_config(self.line.config)
        with self._told([name]):
            artifact = self._run(stage, self.line.inputs_of(stage, parts), parts, "asked for")
            outcome.artifacts[name] = artifact
            with self._explained():
                self.store.deliver(artifact, stage)
        return outcome

    @contextmanager
    def _told(self, stages: Sequence[str]) -> Iterator[None]:
        """The events of a run's beginning and end, the bad one, too."""
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
            told = {"message": "" if ended is None else str(ended), "hint": getattr(ended, "hint", "")}
            seconds = round(time.monotonic() - began_s, 3)
            with suppress(OSError, MachineError):  # a full disk, or a taken one, is what ended it, and is told
                self.sink(Event("run_finished", data={"exit_code": exit_code(ended), **told, "seconds": seconds}))

    def _run(self, stage: Stage, inputs: StageInputs, parts: Mapping[str, Part], reason: str) -> Artifact:
        outcome = self.outcome
        outcome.failed = stage.name
        began_s = time.monotonic()
        self.sink(Event("stage_started", stage.name, {"reason": reason, "key": inputs.key}))
        try:
            with self._explained():
                self._check_space()
                partial = self.store.begin(stage, inputs.key)
                task = Task(
                    stage=stage.name,
                    entry=stage.entry,
                    config_type=f"{stage.config.__module__}:{stage.config.__qualname__}",
                    config=dict(inputs.config),
                    parts={name: str(parts[name].path) for name in stage.reads},
                    photos_dir=str(self.line.photos_dir),
                    settings=dict(inputs.borrowed),
                    summaries={name: dict(done.summary) for name, done in outcome.artifacts.items()},
                    machine=asdict(self.machine),
                    out=str(partial),
                )
                result = self.executor.run(task, self.sink)
                self._check_source(stage)
                summary: Summary = result.pop("summary")
                run = {
                    **result,
                    "machine": {**asdict(self.machine), **describe_machine()},
                    "versions": versions(),
                    **self._forecast(stage),
                }
                artifact = self.store.commit(stage, inputs, partial, summary, run)
        except (SplatpipeError, Stopped, KeyboardInterrupt) as error:
            with suppress(OSError, MachineError):  # what cannot be logged has been shown
                self.sink(self._failed(inputs, time.monotonic() - began_s, error))
            raise
        outcome.ran.append(stage.name)
        outcome.failed = ""
        self.sink(Event("stage_finished", stage.name, {"summary": summary, **result, "key": inputs.key}))
        return artifact

    def _forecast(self, stage: Stage) -> dict[str, JSON]:
        """What the stage was thought to take, for its manifest; empty where nobody could know."""
        needs = self.foresee({name: done.summary for name, done in self.outcome.artifacts.items()})
        return {"forecast": needs[stage.name].as_json()} if stage.name in needs else {}

    def _failed(self, inputs: StageInputs, seconds: float, error: BaseException) -> Event:
        """The event of a stage's bad end; the worker still lives, so that its memory can be told."""
        told = (error.message, error.hint) if isinstance(error, SplatpipeError) else ("Stopped.", "")
        data: dict[str, JSON] = {"message": told[0], "hint": told[1], "exit_code": exit_code(error), "key": inputs.key}
        data |= {"seconds": round(seconds, 3), "peak_memory_bytes": self.executor.peak_memory_bytes()}
        data["lasting"] = data["exit_code"] == EXIT_INPUT and self._source_stands()
        return Event("stage_failed", inputs.stage, data)

    def _check_source(self, stage: Stage) -> None:
        """An artifact's key says what it was made from, so that has to be what the stage read."""
        read = [name for name in stage.reads if name in self.line.source]
        if not read:
            return
        now = self.source_now()
        changed = [name for name in read if now.get(name, "") not in ("", self.line.source[name].digest)]
        if changed:
            what = "The photos" if "source.photos" in changed else "The survey's files"
            raise SplatpipeError(
                f"{what} changed while the stage {stage.name} was reading them.",
                hint="Run again, when nobody writes there any more: what was made before is reused.",
            )

    def _check_space(self) -> None:
        free = shutil.disk_usage(self.store.out).free
        if free < MIN_FREE_BYTES:
            raise MachineError(
                f"The disk of {self.store.out} is full: {free >> 20} MiB are free, and {MIN_FREE_BYTES >> 20} are "
                "the least that a stage needs.",
                hint="Make room, then run again: it goes on from here.",
            )

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn a full, failing or absent disk, here or behind what the worker says, into its plain message."""
        try:
            yield
        except OSError as error:
            self._check_places()
            raise MachineError(
                f"Cannot write to {self.store.out}: {error.strerror or error}.",
                hint="Make room or check the permissions, then run again: it goes on from here.",
            ) from error
        except SplatpipeError as error:
            self._check_places()
            if isinstance(error, StageError):
                self._check_space()
            raise

    def _source_stands(self) -> bool:
        """Whether the user's files are what they were when the run began: then what is wrong with them stays wrong."""
        try:
            now = self.source_now()
        except (SplatpipeError, OSError):
            return False
        return all(now.get(name, "") in ("", part.digest) for name, part in self.line.source.items())

    def _check_places(self) -> None:
        """What lies behind many an error: a disk that is no longer there."""
        if not self.store.stages.is_dir():
            raise MachineError(
                f"{self.store.out} is gone.",
                hint="Was its disk taken away, or the folder removed or renamed? Run again when it is back.",
            )
        if not self.line.photos_dir.is_dir():
            raise SplatpipeError(
                f"The photos' folder {self.line.photos_dir} is gone.",
                hint="Bring it back, then run again: what was finished is kept.",
            )


def versions() -> dict[str, str]:
    """Versions of what computes, for the manifest."""
    found = {"python": platform.python_version()}
    for name in VERSIONED:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def describe_machine() -> dict[str, JSON]:
    """The machine, for the manifest: system, processor family, the cores and the memory that may be used of it."""
    return {
        "system": platform.system(),
        "processor": platform.machine(),
        "cores": available_cores(),
        "memory_bytes": available_memory_bytes(),
    }
