"""Walks the pipeline: reuses what is valid, runs what is not, and reports which and why."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field

from pydantic import BaseModel

from splatpipe.pipeline.engine.errors import MachineError, StageError, UsageError, exit_code
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.ahead import Ahead, Turn
from splatpipe.pipeline.engine.runs.job_runner import Before, JobRunner, describe_machine, versions
from splatpipe.pipeline.engine.runs.line import Job, Line, line_status
from splatpipe.pipeline.engine.runs.store import Artifact, Part, Store
from splatpipe.pipeline.engine.stage import JSON, Stage, stage_name


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
        jobs: Runs each job; has the pipeline, the store and the sink of events.
        save_config: Saves the configuration in OUT; called once it is known that something can run with it.
        ahead: Runs stages ahead of their turn; None: each in its turn.
        outcome: What was done so far, even if the walk ends in an error.
    """

    jobs: JobRunner
    save_config: Callable[[BaseModel], None]
    ahead: Ahead | None = None
    outcome: Outcome = field(default_factory=Outcome)

    @property
    def line(self) -> Line:
        """What to run."""
        return self.jobs.line

    @property
    def store(self) -> Store:
        """Where artifacts are kept."""
        return self.jobs.store

    def walk(self, *, until: str | None = None, rerun: frozenset[str] = frozenset()) -> Outcome:
        """Run the pipeline: reuse what is valid, run the rest.

        Args:
            until: The last stage to run; all if None.
            rerun: Stages to run again even if they are valid.

        Raises:
            SplatpipeError: from the first stage that failed; earlier results are kept.
        """
        with self.jobs.plain_errors():
            self.store.recover()
            self.save_config(self.line.config)
        parts = dict(self.line.source)
        outcome = self.outcome
        needed = self.line.needed(until)
        with self._run_events([stage.name for stage in needed]), self.ahead or nullcontext():
            for at, stage in enumerate(needed):
                artifact, job = self._made_ahead(stage), Job(stage, self.line.inputs_of(stage, parts))
                if artifact is None:
                    artifact = self._reuse(job, again=stage.name in rerun)
                if artifact is None:
                    turn = Turn(stage, needed[at + 1 :], rerun, self._before(parts))
                    with nullcontext() if self.ahead is None else self.ahead.beside(turn):
                        artifact = self._run_with_shards(job, parts, again=stage.name in rerun)
                parts.update(artifact.parts)
                with self.jobs.plain_errors():
                    self.store.deliver(artifact, stage)
        return outcome

    def run_alone(self, name: str) -> Outcome:
        """Run one stage again, valid or not, and those of its shards that are missing.

        The stage that counts the shards is run if it is missing.

        Raises:
            UsageError: if a stage that it reads from is not valid.
        """
        with self.jobs.plain_errors():
            self.store.recover()
        stage, parts, counting = self._prepare(name)
        with self.jobs.plain_errors():
            self.save_config(self.line.config)
        needed = [*counting, stage]
        with self._run_events([each.name for each in needed]):
            for each in needed:
                artifact = self._run_with_shards(Job(each, self.line.inputs_of(each, parts)), parts)
                parts.update(artifact.parts)
                with self.jobs.plain_errors():
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
        with self.jobs.plain_errors():
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
        machine = {**asdict(self.jobs.machine), **describe_machine()}
        self.jobs.sink(Event("run_started", data={"stages": list(stages), "machine": machine, "versions": versions()}))
        ended: BaseException | None = None
        try:
            yield
        except BaseException as error:
            ended = error
            raise
        finally:
            ending: dict[str, JSON] = {"exit_code": exit_code(ended), "message": "" if ended is None else str(ended)}
            ending |= {"hint": getattr(ended, "hint", ""), "seconds": round(time.monotonic() - began_s, 3)}
            with suppress(OSError, MachineError):  # a full or taken-over OUT ended the run and is reported anyway
                self.jobs.sink(Event("run_finished", data=ending))

    def _reuse(self, job: Job, *, again: bool = False) -> Artifact | None:
        """The valid artifact of a job, reported as reused; None if the job has to run."""
        artifact = None if again else self.store.find(job.stage, job.inputs.key)
        if artifact is not None:
            data = {"summary": artifact.summary, "seconds": artifact.manifest["seconds"], "key": artifact.key}
            self.jobs.sink(Event("stage_reused", job.stage.name, data))
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
        self.outcome.failed = job.stage.name
        artifact = self.jobs.run(job, self._before(parts), shards)
        return self._done(job.stage, artifact)

    def _made_ahead(self, stage: Stage) -> Artifact | None:
        """The artifact of a stage that runs ahead or has run, waited for; None if it has yet to run."""
        if self.ahead is None or not self.ahead.has(stage.name):
            return None
        self.outcome.failed = stage.name
        artifact = self.ahead.take(stage.name)
        return None if artifact is None else self._done(stage, artifact)

    def _done(self, stage: Stage, artifact: Artifact) -> Artifact:
        self.outcome.ran.append(stage.name)
        self.outcome.failed = ""
        self.outcome.artifacts[stage.name] = artifact
        return artifact

    def _before(self, parts: Mapping[str, Part]) -> Before:
        return Before(dict(parts), {name: dict(done.summary) for name, done in self.outcome.artifacts.items()})
