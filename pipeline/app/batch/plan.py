"""What a call of `splatpipe batch` is to do, as a file: the jobs, the guard and whoever tells of them read it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from splatpipe.pipeline.engine.durable import write_durably
from splatpipe.pipeline.engine.stage import JSON, stage_name

BATCH_FOLDER = ".batch"  # below the batch's folder: what is the command's own
PLAN_FILE = "plan.json"
RUNTIME_FACTOR, RUNTIME_MIN = 3.0, 15.0  # a cluster kills at the limit: minutes too many cost nothing
MEGABYTE = 10**6
SHARDS_FOLDER = "shards"  # below a call's
LEAST_S = 1.0  # of a process that only joins


@dataclass(frozen=True)
class StageJob:
    """One stage of one capture, or one of the shards that it is made of: a job of the workflow.

    Attributes:
        stage: Its name; of a shard ``train.2``.
        threads: That it gets.
        memory_bytes: That it is expected to take at its peak, with a margin.
        seconds: That it is expected to take with these threads.
        disk_bytes: That it is expected to take at its end, or while it runs.
    """

    stage: str
    threads: int
    memory_bytes: int
    seconds: float
    disk_bytes: int

    @property
    def resources(self) -> list[int]:
        """What the workflow asks for: threads, megabytes of memory, minutes, megabytes of disk."""
        minutes = round(RUNTIME_MIN + RUNTIME_FACTOR * self.seconds / 60.0)
        return [self.threads, max(1, self.memory_bytes // MEGABYTE), minutes, max(1, self.disk_bytes // MEGABYTE)]


@dataclass(frozen=True)
class PlannedCapture:
    """A capture and what is to be done about it.

    Attributes:
        name: The capture's.
        key: What it is called in the workflow: letters, digits and hyphens.
        photos: Its folder of photos.
        preset: By name.
        jobs: Stages that are not valid, in order; none where all are, or where it fails before it begins.
        weights: Seconds of every stage that is asked for, by the forecast: what progress is measured by.
        photo_count: How many it has; None where nobody could count.
        message: Why it fails before it begins; empty where it does not.
        hint: What to do about it.
        stage: In which it failed the last time, where that is why.
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
    """What a call is to do.

    Attributes:
        out: The batch's folder.
        began_s: When the command began, seconds since the epoch.
        captures: In the order of the list.
        until: The last stage; empty for the whole line.
        device: As the command was given it.
        gpu: Whether the stages that can use a GPU get one.
        retries: How often a stage that died is begun again.
        local: Whether the jobs run on this machine, and not where a profile sends them.
        warnings: What was noticed before.
        unlisted: Captures of earlier calls that are not listed any more.
    """

    out: str
    began_s: float
    captures: tuple[PlannedCapture, ...]
    until: str = ""
    device: str = "auto"
    gpu: bool = False
    retries: int = 0
    local: bool = True
    warnings: tuple[str, ...] = ()
    unlisted: tuple[str, ...] = ()

    @property
    def needed_bytes(self) -> int:
        """Disk that all jobs together are expected to take."""
        return sum(job.disk_bytes for capture in self.captures for job in capture.jobs)

    def capture(self, key: str) -> PlannedCapture:
        """The capture of that key.

        Raises:
            KeyError: if there is none.
        """
        for capture in self.captures:
            if capture.key == key:
                return capture
        raise KeyError(key)


@dataclass(frozen=True)
class Call:
    """The folder of a call of the command.

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
        """Lies there once the call is to end: no job begins any more."""
        return self.folder / "stop"

    @property
    def end_file(self) -> Path:
        """Says when and how the call ended."""
        return self.folder / "end.json"

    @property
    def snakemake_log(self) -> Path:
        return self.folder / "snakemake.log"

    def config_file(self, key: str) -> Path:
        """The options of a capture."""
        return self.folder / "config" / f"{key}.toml"

    def tries_file(self, key: str, job: str = "") -> Path:
        """What became of a capture's jobs, a JSON object a line; shards have files of their own: they run side by side.

        Args:
            key: The capture's.
            job: The name of a job's stage; any that is no shard has the same file.
        """
        return self.folder / "tries" / f"{key}{_shard(job)}.jsonl"

    def tries_files(self, key: str) -> list[Path]:
        """All of a capture's; none need be there."""
        return [self.tries_file(key), *sorted(self.tries_file(key).parent.glob(f"{key}.*.jsonl"))]

    def log(self, name: str, job: str = "") -> Path:
        """What a capture's jobs said; it outlives the call.

        Args:
            name: The capture's.
            job: As of ``tries_file``.
        """
        return self.folder.parent / "logs" / f"{name}{_shard(job)}.log"

    def shards_file(self, key: str) -> Path:
        """The jobs of a capture's shards, by stage, as far as they are known; the workflow reads it, too."""
        return self.folder / SHARDS_FOLDER / f"{key}.json"

    def write_shards(self, key: str, jobs: Mapping[str, Sequence[StageJob]]) -> None:
        """Keep the jobs of shards by stage; of a stage whose jobs are known already they stay as they are."""
        told = {
            stage: {
                "jobs": [asdict(job) for job in of_stage],
                "resources": {job.stage: job.resources for job in of_stage},
            }
            for stage, of_stage in jobs.items()
        }
        path = self.shards_file(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, json.dumps({**told, **self._shards(key)}))

    def jobs(self, capture: PlannedCapture) -> list[StageJob]:
        """A capture's jobs in order, those of shards before their stage's, which is left with the rest of the time."""
        known = {stage: [StageJob(**job) for job in told["jobs"]] for stage, told in self._shards(capture.key).items()}
        found = []
        for job in capture.jobs:
            shards = known.get(job.stage, [])
            rest_s = job.seconds - sum(shard.seconds for shard in shards)
            found += [*shards, replace(job, seconds=max(LEAST_S, rest_s)) if shards else job]
        return found

    def _shards(self, key: str) -> Mapping[str, JSON]:
        try:
            told: Mapping[str, JSON] = json.loads(self.shards_file(key).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        return told

    def write_plan(self, plan: BatchPlan) -> None:
        write_durably(self.folder / PLAN_FILE, json.dumps(asdict(plan), indent=1))

    def plan(self) -> BatchPlan:
        told = json.loads((self.folder / PLAN_FILE).read_text(encoding="utf-8"))
        return BatchPlan(**{**told, "captures": tuple(_capture(each) for each in told["captures"]), **_tuples(told)})

    def write_end(self, ended_s: float, exit_code: int | None, message: str) -> None:
        told = {"ended_s": ended_s, "exit_code": exit_code, "message": message}
        write_durably(self.end_file, json.dumps(told))

    def end(self) -> Mapping[str, JSON]:
        """``ended_s``, ``exit_code`` and ``message``; empty while it is at work."""
        try:
            told: Mapping[str, JSON] = json.loads(self.end_file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        return told


def _shard(job: str) -> str:
    """What a shard's files have in their names that a stage's have not."""
    return f".{job}" if job != stage_name(job) else ""


def _capture(told: Mapping[str, JSON]) -> PlannedCapture:
    return PlannedCapture(**{**told, "jobs": tuple(StageJob(**job) for job in told["jobs"])})


def _tuples(told: Mapping[str, JSON]) -> dict[str, tuple[str, ...]]:
    return {name: tuple(told[name]) for name in ("warnings", "unlisted")}
