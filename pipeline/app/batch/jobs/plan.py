"""The plan of a `splatpipe batch` call, stored as a file that the jobs, the guard and the monitor read."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.stage import JSON, stage_name

BATCH_FOLDER = ".batch"  # below the batch's folder: the command's own files
PLAN_FILE = "plan.json"
RUNTIME_FACTOR, RUNTIME_MIN = 3.0, 15.0  # a cluster kills jobs at the limit, and extra minutes cost nothing
MEGABYTE = 10**6
SHARDS_FOLDER = "shards"  # below a call's folder
MIN_S = 1.0  # shortest time for a process that only joins


@dataclass(frozen=True)
class StageJob:
    """One stage of one capture, or one of its shards, as a job of the workflow or part of one.

    Attributes:
        stage: Its name; for a shard e.g. ``train.2``.
        threads: Threads it gets.
        memory_bytes: Expected peak memory, with a margin.
        seconds: Expected duration with these threads.
        disk_bytes: Expected disk space at its end, or while it runs.
        joined: Whether it runs in the same job as the next stage.
    """

    stage: str
    threads: int
    memory_bytes: int
    seconds: float
    disk_bytes: int
    joined: bool = False

    @property
    def resources(self) -> list[int]:
        """The resources requested in the workflow, if it is a job by itself."""
        return resources_of([self])


def resources_of(stages: Sequence[StageJob]) -> list[int]:
    """Resources requested for stages that run one after the other: threads, megabytes of memory, minutes, megabytes of
    disk."""
    minutes = round(RUNTIME_MIN + RUNTIME_FACTOR * sum(stage.seconds for stage in stages) / 60.0)
    memory, disk = max(stage.memory_bytes for stage in stages), sum(stage.disk_bytes for stage in stages)
    return [max(stage.threads for stage in stages), max(1, memory // MEGABYTE), minutes, max(1, disk // MEGABYTE)]


def workflow_jobs(stages: Iterable[StageJob]) -> dict[str, list[StageJob]]:
    """The workflow's jobs, each by the name of its last stage, with the stages that it runs, in order."""
    jobs: dict[str, list[StageJob]] = {}
    beside: list[StageJob] = []
    for stage in stages:
        beside.append(stage)
        if not stage.joined:
            jobs[stage.stage] = beside
            beside = []
    return jobs


@dataclass(frozen=True)
class PlannedCapture:
    """A capture and the jobs planned for it.

    Attributes:
        name: The capture's name.
        key: Its name in the workflow: letters, digits and hyphens.
        photos: Its photo folder.
        preset: The preset's name.
        jobs: Jobs of stages that are not valid, in order; empty if all are valid or it fails before it starts.
        weights: Forecast seconds of every requested stage, by which progress is measured.
        photo_count: Number of photos; None if unknown.
        message: Why it fails before it starts; else empty.
        hint: What to do about it.
        stage: The stage in which it failed the last time, if that is the reason.
    """

    name: str
    key: str
    photos: str
    preset: str
    jobs: tuple[StageJob, ...] = ()
    weights: Mapping[str, float] = field(default_factory=dict)
    photo_count: int | None = None
    message: str = ""
    hint: str = ""
    stage: str = ""


@dataclass(frozen=True)
class BatchPlan:
    """The plan of a call.

    Attributes:
        out: The batch's folder.
        began_s: When the command started, seconds since the epoch.
        captures: The captures, in the order of the list.
        until: The last stage; empty for the whole pipeline.
        device: The device given to the command.
        gpu: Whether the stages that can use a GPU get one.
        retries: How often a failed stage is retried.
        local: Whether the jobs run on this machine rather than where a profile sends them.
        node_memory_bytes: Memory of the largest machine that a profile sends them to, which no retry exceeds; 0 if
            unknown.
        warnings: Warnings from planning.
        unlisted: Captures of earlier calls that are no longer listed.
    """

    out: str
    began_s: float
    captures: tuple[PlannedCapture, ...]
    until: str = ""
    device: str = "auto"
    gpu: bool = False
    retries: int = 0
    local: bool = True
    node_memory_bytes: int = 0
    warnings: tuple[str, ...] = ()
    unlisted: tuple[str, ...] = ()

    @property
    def needed_bytes(self) -> int:
        """Bytes of disk space that all jobs together are expected to need."""
        return sum(job.disk_bytes for capture in self.captures for job in capture.jobs)

    def capture(self, key: str) -> PlannedCapture:
        """The capture with that key.

        Raises:
            KeyError: if there is none.
        """
        for capture in self.captures:
            if capture.key == key:
                return capture
        raise KeyError(key)


@dataclass(frozen=True)
class Call:
    """The folder of one call of the command.

    Attributes:
        folder: Absolute; below the batch's folder.
    """

    folder: Path

    @property
    def out(self) -> Path:
        """The batch's folder."""
        return self.folder.parent.parent

    @property
    def stop_file(self) -> Path:
        """Exists once the call is to end: no further job starts."""
        return self.folder / "stop"

    @property
    def end_file(self) -> Path:
        """Records when and how the call ended."""
        return self.folder / "end.json"

    @property
    def snakemake_log(self) -> Path:
        return self.folder / "snakemake.log"

    def config_file(self, key: str) -> Path:
        """The options of a capture."""
        return self.folder / "config" / f"{key}.toml"

    def attempts_file(self, key: str, job: str = "") -> Path:
        """The log of a capture's attempts, one JSON object per line; shards, which run in parallel, have their own.

        Args:
            key: The capture's key.
            job: A job's name; all that are not shards share one file.
        """
        return self.folder / "tries" / f"{key}{_shard(job)}.jsonl"

    def attempts_files(self, key: str) -> list[Path]:
        """The files of all attempts of a capture; they may not exist."""
        return [self.attempts_file(key), *sorted(self.attempts_file(key).parent.glob(f"{key}.*.jsonl"))]

    def log(self, name: str, job: str = "") -> Path:
        """The output of a capture's jobs; it outlives the call.

        Args:
            name: The capture's name.
            job: As for ``attempts_file``.
        """
        return self.folder.parent / "logs" / f"{name}{_shard(job)}.log"

    def shards_file(self, key: str) -> Path:
        """The known jobs of a capture's shards by stage; the workflow reads this file too."""
        return self.folder / SHARDS_FOLDER / f"{key}.json"

    def write_shards(self, key: str, jobs: Mapping[str, Sequence[StageJob]]) -> None:
        """Store the jobs of shards by stage; those of stages already stored are not changed."""
        stored = {
            stage: {
                "jobs": [asdict(job) for job in of_stage],
                "resources": {job.stage: job.resources for job in of_stage},
            }
            for stage, of_stage in jobs.items()
        }
        path = self.shards_file(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, json.dumps({**stored, **self._shards(key)}))

    def jobs(self, capture: PlannedCapture) -> list[StageJob]:
        """A capture's jobs in order, shards before their stage, which keeps the remaining time."""
        known = {
            stage: [StageJob(**job) for job in stored["jobs"]] for stage, stored in self._shards(capture.key).items()
        }
        found = []
        for job in capture.jobs:
            shards = known.get(job.stage, [])
            rest_s = job.seconds - sum(shard.seconds for shard in shards)
            found += [*shards, replace(job, seconds=max(MIN_S, rest_s)) if shards else job]
        return found

    def _shards(self, key: str) -> Mapping[str, JSON]:
        try:
            stored: Mapping[str, JSON] = read_json(self.shards_file(key))
        except FileNotFoundError:
            return {}
        return stored

    def write_plan(self, plan: BatchPlan) -> None:
        write_durably(self.folder / PLAN_FILE, json.dumps(asdict(plan), indent=1))

    def plan(self) -> BatchPlan:
        stored = read_json(self.folder / PLAN_FILE)
        return BatchPlan(
            **{**stored, "captures": tuple(_capture(each) for each in stored["captures"]), **_tuples(stored)}
        )

    def write_end(self, ended_s: float, exit_code: int | None, message: str) -> None:
        stored = {"ended_s": ended_s, "exit_code": exit_code, "message": message}
        write_durably(self.end_file, json.dumps(stored))

    def end(self) -> Mapping[str, JSON]:
        """``ended_s``, ``exit_code`` and ``message``; empty while it is running."""
        try:
            stored: Mapping[str, JSON] = read_json(self.end_file)
        except FileNotFoundError:
            return {}
        return stored


def _shard(job: str) -> str:
    """The file name suffix for a shard; empty for a stage."""
    return f".{job}" if job != stage_name(job) else ""


def _capture(stored: Mapping[str, JSON]) -> PlannedCapture:
    return PlannedCapture(**{**stored, "jobs": tuple(StageJob(**job) for job in stored["jobs"])})


def _tuples(stored: Mapping[str, JSON]) -> dict[str, tuple[str, ...]]:
    return {name: tuple(stored[name]) for name in ("warnings", "unlisted")}
