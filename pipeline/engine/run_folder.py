"""An OUT that is there: its settings, what it holds that belongs together, and whether a splatpipe works in it.

Unlike ``runner.survey`` this asks nothing of the photos, so it finds what they left when they are gone, too.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from splatpipe.pipeline.engine.config import Table, known, load_file, resolve, settings_of
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.lock import is_locked
from splatpipe.pipeline.engine.stage import Stage, stage_name
from splatpipe.pipeline.engine.store import Artifact, Part, Store, is_copy, open_store

CONFIG_FILE = "config.toml"
LOG_FILE = "splatpipe.log"
EVENTS_FILE = "events.jsonl"
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class Contents:
    """Artifacts that belong together.

    Attributes:
        artifacts: By stage.
        working: Where a stage that is not done leaves what it has so far, by stage; also a shard, by its name.
    """

    artifacts: Mapping[str, Artifact] = field(default_factory=dict)
    working: Mapping[str, Path] = field(default_factory=dict)

    @property
    def parts(self) -> dict[str, Part]:
        """What they left, by full name, e.g. ``georef.frame``."""
        return {name: part for artifact in self.artifacts.values() for name, part in artifact.parts.items()}


@dataclass(frozen=True)
class RunFolder:
    """An OUT.

    Attributes:
        out: Its folder, absolute, without links.
        stages: The line that it was made with.
    """

    out: Path
    stages: Sequence[Stage]

    @property
    def store(self) -> Store:
        return Store(self.out)

    @property
    def name(self) -> str:
        """What people call it: its folder's name."""
        return self.out.name

    @property
    def at_work(self) -> bool:
        """Whether a splatpipe works in it now."""
        return is_locked(self.out)

    def settings(self) -> tuple[Path, Table]:
        """The photos' folder and the options as they were written.

        Raises:
            UsageError: if there are none.
        """
        path = self.out / CONFIG_FILE
        try:
            table = load_file(path)
        except UsageError as error:
            raise UsageError(error.message, hint=f"Run again: splatpipe run PHOTOS {self.out}") from error
        photos = table.pop("photos", None)
        table.pop("splatpipe", None)
        if not isinstance(photos, str) or not all(isinstance(section, Mapping) for section in table.values()):
            raise UsageError(f"{path} is not a valid file of a run.", hint="Run again: splatpipe run PHOTOS OUT")
        return Path(photos), table

    def config(self, model: type[Model], *above: Table) -> tuple[Path, Model]:
        """The photos' folder and the options that it ran with.

        Args:
            model: Of this version's configuration; options that it no longer has are passed over.
            above: What is to be otherwise.

        Raises:
            UsageError: if there are none, or they make no sense.
        """
        photos, table = self.settings()
        return photos, resolve(model, [known(model, table), *above])

    def contents(self, config: BaseModel | None, keys: Mapping[str, str], unfinished: Container[str] = ()) -> Contents:
        """Of each stage the artifact that the last run made or would reuse; none that an earlier stage's contradicts.

        Args:
            config: The options; None where they cannot be read.
            keys: The last known key of each stage, by its events; of one without the newest artifact is taken.
            unfinished: Stages that the last run began and did not end.
        """
        chosen: dict[str, Artifact] = {}
        working: dict[str, Path] = {}
        digests: dict[str, str] = {}
        given = {"source"}  # what left no artifact came from the user's folder, as a reconstruction in it does
        for stage in self.stages:
            key, artifacts = keys.get(stage.name, ""), self.store.artifacts(stage.name)
            if not artifacts and not key:
                given.add(stage.name)
            fitting = (
                artifact
                for artifact in artifacts
                if key in ("", artifact.key) and _fits(artifact, digests, given) and _agrees(artifact, config, stage)
            )
            artifact = None if stage.name in unfinished else next(fitting, None)
            folder = self.store.working_folder(stage, key)
            if artifact is not None:
                chosen[stage.name] = artifact
                digests |= {name: part.digest for name, part in artifact.parts.items()}
                continue
            if key and folder.is_dir():
                working[stage.name] = folder
            working |= self._shards_at_work(stage, keys)
        return Contents(chosen, working)

    def _shards_at_work(self, stage: Stage, keys: Mapping[str, str]) -> dict[str, Path]:
        """Where shards of a stage work, as far as events tell of them."""
        if stage.shards is None:
            return {}
        names = [name for name in keys if name != stage.name and stage_name(name) == stage.name]
        folders = {name: self.store.working_folder(replace(stage, name=name), keys[name]) for name in names}
        return {name: folder for name, folder in folders.items() if folder.is_dir()}

    def lineage(self, *stages: Stage) -> dict[str, Part]:
        """The parts behind what lies in OUT, found by digests alone, so in what another version left, too.

        Args:
            stages: Of the first that left anything, the artifact whose deliverables lie in OUT, or else the newest.

        Returns:
            Its parts, and those of all that it was made from, by full name; what is gone is left out.
        """
        made = next(filter(None, (_delivered(self.store, stage) for stage in stages)), None)
        if made is None:
            return {}
        found = dict(made.parts)
        asked = dict(made.manifest["inputs"]["reads"])
        while asked:
            name, digest = asked.popitem()
            if name in found:
                continue
            source = next((a for a in self.store.artifacts(name.split(".")[0]) if _has(a, name, digest)), None)
            if source is not None:
                found |= {part: where for part, where in source.parts.items() if part not in found}
                asked |= source.manifest["inputs"]["reads"]
        return found

    def deliverables(self) -> list[str]:
        """Files for people that are there and that any artifact delivers, relative to OUT, in POSIX form."""
        made = ((stage, artifact) for stage in self.stages for artifact in self.store.artifacts(stage.name))
        names = dict.fromkeys(name for stage, artifact in made for name in artifact.deliverables(stage))
        return [name.as_posix() for name in names if (self.out / name).is_file()]


def shard_events(out: Path, shard: str) -> Path:
    """Where a process that makes a shard alone tells of it.

    Args:
        out: The OUT.
        shard: By name, e.g. ``train.2``.
    """
    return Store(out).shards / f"{shard}.jsonl"


def open_run_folder(out: Path, stages: Sequence[Stage]) -> RunFolder:
    """The run in a folder.

    Args:
        out: The folder.
        stages: The line.

    Raises:
        UsageError: if there is none.
    """
    out = out.expanduser().resolve()
    open_store(out, create=False)
    return RunFolder(out, stages)


def _fits(artifact: Artifact, digests: Mapping[str, str], given: Container[str]) -> bool:
    """Whether it was made from parts of these digests, as far as the line made them."""
    reads = artifact.manifest["inputs"]["reads"]
    return all(name.split(".")[0] in given or digests.get(name) == digest for name, digest in reads.items())


def _agrees(artifact: Artifact, config: BaseModel | None, stage: Stage) -> bool:
    """Whether it was made with these options, as far as they can be told."""
    inputs = artifact.manifest["inputs"]
    if config is None or inputs["version"] != stage.version:  # an older version's options are not compared
        return True
    return (inputs["config"], inputs["borrowed"]) == settings_of(config, stage)


def _delivered(store: Store, stage: Stage) -> Artifact | None:
    """The artifact of a stage whose deliverables lie in OUT; the newest where none does, None without any."""
    artifacts = store.artifacts(stage.name)
    for artifact in artifacts:
        files = artifact.deliverables(stage)
        if files and all(is_copy(file, store.out / name) for name, file in files.items()):
            return artifact
    return artifacts[0] if artifacts else None


def _has(artifact: Artifact, name: str, digest: str) -> bool:
    part = artifact.parts.get(name)
    return part is not None and part.digest == digest
