"""A pipeline with everything its result depends on, and the status of its stages and shards, without running any."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from pydantic import BaseModel

from splatpipe.pipeline.engine.config import settings_of
from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.runs.lock import is_locked
from splatpipe.pipeline.engine.runs.store import Artifact, Part, StageInputs, Store
from splatpipe.pipeline.engine.stage import Shard, Stage, StageConfig, stage_name

State = Literal["valid", "stale", "missing", "waiting"]


@dataclass(frozen=True)
class Job:
    """A unit of work for one process: a stage's artifact, or a shard's.

    Attributes:
        stage: The stage to run; for a shard, the result of ``Stage.shard``.
        inputs: Everything its result depends on.
        shard: The shard; None for a stage's own body.
    """

    stage: Stage
    inputs: StageInputs
    shard: Shard | None = None


@dataclass(frozen=True)
class Line:
    """A pipeline with everything its result depends on.

    Attributes:
        stages: In order; each reads parts of those before it.
        config: The resolved configuration, with a section for each stage.
        source: External parts by name, e.g. ``source.photos``.
        photos_dir: The user's folder.
    """

    stages: Sequence[Stage]
    config: BaseModel
    source: Mapping[str, Part]
    photos_dir: Path

    def needed(self, until: str | None = None) -> list[Stage]:
        """The stages to run, in order: those that ``until`` depends on, or else the deliverables and the last stage.

        Stages whose parts the source provides are not needed.
        """
        names = [stage.name for stage in self.stages]
        last = names.index(until) if until else len(names) - 1
        wanted = {names[last]} if until else {names[last], *(stage.name for stage in self.stages if stage.deliverables)}
        for stage in reversed(self.stages[: last + 1]):
            if stage.name in wanted:
                wanted |= {stage_name(part) for part in self.reads_of(stage) if part not in self.source}
        return [stage for stage in self.stages[: last + 1] if stage.name in wanted]

    def is_off(self, stage: Stage) -> bool:
        """Whether a stage is turned off."""
        section: StageConfig = getattr(self.config, stage_name(stage.name))
        return section.is_off

    def reads_of(self, stage: Stage) -> tuple[str, ...]:
        """The parts that a stage or one of its shards reads; none if the stage is turned off."""
        return () if self.is_off(stage) else stage.reads

    def inputs_of(self, stage: Stage, parts: Mapping[str, Part]) -> StageInputs:
        """The inputs that make up a stage's key."""
        reads = {name: parts[name].digest for name in self.reads_of(stage)}
        return StageInputs(stage.name, stage.version, *settings_of(self.config, stage), reads)

    def shards_of(self, stage: Stage, parts: Mapping[str, Part]) -> list[Job]:
        """A stage's shards in order, each with its own key, independent of the other shards.

        Raises:
            StageError: if the part that should give their number does not.
        """
        pieces = self.shard_stages(stage, parts)
        inputs = self.inputs_of(stage, parts)
        return [
            Job(piece, replace(inputs, stage=piece.name), Shard(number, len(pieces)))
            for number, piece in enumerate(pieces, 1)
        ]

    def shard_stages(self, stage: Stage, parts: Mapping[str, Part]) -> list[Stage]:
        """The stages that run each shard; empty while the part that gives their number is missing.

        Raises:
            StageError: if that part does not give their number.
        """
        if stage.shards is None or stage.shards.counted_by not in parts:
            return []
        count = _shard_count(parts[stage.shards.counted_by].path, stage.name)
        return [stage.shard(number) for number in range(1, count + 1)]


def _shard_count(path: Path, stage: str) -> int:
    try:
        count = read_json(path)["shards"]
    except (OSError, ValueError, KeyError, TypeError):
        count = None
    if type(count) is not int or count < 0:
        raise StageError(
            f"{path} does not say how many shards {stage} has.", hint="This is a bug in splatpipe; please report it."
        )
    return count


@dataclass(frozen=True)
class StageStatus:
    """The status of a stage without running anything: its artifact if valid, else why it is not.

    Attributes:
        stage: The stage, or the stage that runs a shard.
        state: Whether its artifact is valid, stale, missing, or waits for other stages.
        key: The artifact's key; empty while it waits for others.
        reason: Why there is no valid artifact.
        artifact: The valid artifact.
        shards: The status of its shards.
    """

    stage: Stage
    state: State
    key: str = ""
    reason: str = ""
    artifact: Artifact | None = None
    shards: tuple[StageStatus, ...] = ()

    @property
    def to_keep(self) -> list[tuple[str, str]]:
        """Names and keys of the artifacts to keep: the stage's own and its shards'."""
        return [(self.stage.name, self.key), *((shard.stage.name, shard.key) for shard in self.shards)]


def line_status(line: Line, store: Store) -> Iterator[StageStatus]:
    """Yield the status of every needed stage without running anything."""
    parts = dict(line.source)
    for stage in line.needed():
        missing = [name for name in line.reads_of(stage) if name not in parts]
        if missing:
            behind = sorted(set(map(stage_name, missing)))
            reason = f"waits for {', '.join(behind)}"
            waiting = tuple(StageStatus(piece, "waiting", reason=reason) for piece in line.shard_stages(stage, parts))
            yield StageStatus(stage, "waiting", reason=reason, shards=waiting)
            continue
        shards = tuple(_status(job, store) for job in line.shards_of(stage, parts))
        status = replace(_status(Job(stage, line.inputs_of(stage, parts)), store), shards=shards)
        if status.artifact is not None:
            parts.update(status.artifact.parts)
        yield status


def _status(job: Job, store: Store) -> StageStatus:
    stage, key = job.stage, job.inputs.key
    artifact = store.find(stage, key)
    if artifact is not None:
        return StageStatus(stage, "valid", key, artifact=artifact)
    earlier = store.artifacts(stage.name)
    if job.shard is not None and is_locked(store.out, stage.name):
        return StageStatus(stage, "missing", key, "is running")
    return StageStatus(stage, "stale" if earlier else "missing", key, explain(job.inputs, earlier))


def explain(inputs: StageInputs, earlier: Iterable[Artifact]) -> str:
    """Why a stage has to run, compared with its newest artifact."""
    newest = next(iter(earlier), None)
    if newest is None:
        return "not run yet"
    before, stage = newest.manifest["inputs"], stage_name(inputs.stage)
    reasons = []
    if before["version"] != inputs.version:
        reasons.append(f"splatpipe's {stage} changed")
    for mine, old, prefix in (
        (inputs.config, before["config"], f"{stage}."),
        (inputs.borrowed, before["borrowed"], ""),
    ):
        reasons += [
            f"{prefix}{name} changed from {old.get(name)} to {mine.get(name)}"
            for name in sorted({*mine, *old})
            if mine.get(name) != old.get(name)
        ]
    reasons += [f"{name} changed" for name in inputs.reads if before["reads"].get(name) != inputs.reads[name]]
    return ", ".join(reasons) or "its files are damaged or missing"
