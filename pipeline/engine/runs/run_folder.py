"""An existing OUT: its settings, its consistent set of artifacts, and whether a splatpipe is working in it.

The photos are not needed, so results are found even if the photos are gone.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from splatpipe.pipeline.engine.config import Table, current_options, load_file, resolve, settings_of
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs.lock import is_locked
from splatpipe.pipeline.engine.runs.store import Artifact, Part, Store, is_copy, open_store
from splatpipe.pipeline.engine.stage import Stage, stage_name

CONFIG_FILE = "config.toml"
LOG_FILE = "splatpipe.log"
EVENTS_FILE = "events.jsonl"
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class Contents:
    """A consistent set of artifacts.

    Attributes:
        artifacts: Artifacts by stage.
        working: Working folders of unfinished stages by stage name, and of shards by shard name.
    """

    artifacts: Mapping[str, Artifact] = field(default_factory=dict)
    working: Mapping[str, Path] = field(default_factory=dict)

    @property
    def parts(self) -> dict[str, Part]:
        """The artifacts' parts by full name, e.g. ``georef.frame``."""
        return {name: part for artifact in self.artifacts.values() for name, part in artifact.parts.items()}


@dataclass(frozen=True)
class RunFolder:
    """An existing OUT.

    Attributes:
        out: Its folder, absolute, with links resolved.
        stages: The pipeline that it was made with.
    """

    out: Path
    stages: Sequence[Stage]

    @property
    def store(self) -> Store:
        return Store(self.out)

    @property
    def name(self) -> str:
        """The run's display name: its folder's name."""
        return self.out.name

    @property
    def is_running(self) -> bool:
        """Whether a splatpipe is working in it now."""
        return is_locked(self.out)

    def settings(self) -> tuple[Path, Table]:
        """The photo folder and the options as saved in ``config.toml``.

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
        """The photo folder and the options of the run.

        Args:
            model: This version's configuration model; options that no longer exist are ignored.
            above: Tables that override the run's options.

        Raises:
            UsageError: if there are none, or they are invalid.
        """
        photos, table = self.settings()
        return photos, resolve(model, [current_options(model, table), *above])

    def contents(self, config: BaseModel | None, keys: Mapping[str, str], unfinished: Container[str] = ()) -> Contents:
        """For each stage, the artifact the last run made or would reuse, if consistent with those of earlier stages.

        Args:
            config: The options; None if they cannot be read.
            keys: The last known key of each stage from its events; without a key, the newest artifact is used.
            unfinished: Stages that the last run started and did not finish.
        """
        chosen: dict[str, Artifact] = {}
        working: dict[str, Path] = {}
        digests: dict[str, str] = {}
        given = {"source"}  # stages whose parts come from the user's folder, e.g. a reconstruction in it
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
            if key and self._is_working_folder(folder):
                working[stage.name] = folder
            working |= self._shard_working_folders(stage, keys)
        return Contents(chosen, working)

    def _shard_working_folders(self, stage: Stage, keys: Mapping[str, str]) -> dict[str, Path]:
        """Working folders of a stage's shards that are known from events, by shard name."""
        if stage.shards is None:
            return {}
        names = [name for name in keys if name != stage.name and stage_name(name) == stage.name]
        folders = {name: self.store.working_folder(replace(stage, name=name), keys[name]) for name in names}
        return {name: folder for name, folder in folders.items() if self._is_working_folder(folder)}

    def _is_working_folder(self, folder: Path) -> bool:
        """Whether it exists, as a folder of ours: keys and shards' names are from events, which may say anything."""
        return folder.parent == self.store.partials and folder.is_dir() and not folder.is_symlink()

    def lineage(self, *stages: Stage) -> dict[str, Part]:
        """The parts from which the deliverables in OUT were made, traced by digest alone, across versions.

        Args:
            stages: The first with any artifact counts: the one whose deliverables are in OUT, else its newest.

        Returns:
            Its parts and those of everything it was made from, by full name; missing ones are left out.
        """
        made = next(filter(None, (_delivered_artifact(self.store, stage) for stage in stages)), None)
        if made is None:
            return {}
        found = dict(made.parts)
        pending = dict(made.manifest["inputs"]["reads"])
        while pending:
            name, digest = pending.popitem()
            if name in found:
                continue
            source = next((a for a in self.store.artifacts(name.split(".")[0]) if _has(a, name, digest)), None)
            if source is not None:
                found |= {part: where for part, where in source.parts.items() if part not in found}
                pending |= source.manifest["inputs"]["reads"]
        return found

    def deliverables(self) -> list[str]:
        """Existing deliverables of any artifact, as POSIX paths relative to OUT."""
        made = ((stage, artifact) for stage in self.stages for artifact in self.store.artifacts(stage.name))
        names = dict.fromkeys(name for stage, artifact in made for name in artifact.deliverables(stage))
        return [name.as_posix() for name in names if (self.out / name).is_file()]


def shard_events(out: Path, shard: str) -> Path:
    """The events file of a process that runs a single shard.

    Args:
        out: The OUT.
        shard: The shard's name, e.g. ``train.2``.
    """
    return Store(out).shards / f"{shard}.jsonl"


def open_run_folder(out: Path, stages: Sequence[Stage]) -> RunFolder:
    """Open the run in a folder.

    Args:
        out: The folder.
        stages: The pipeline.

    Raises:
        UsageError: if there is no run in it.
    """
    out = out.expanduser().resolve()
    open_store(out, create=False)
    return RunFolder(out, stages)


def _fits(artifact: Artifact, digests: Mapping[str, str], given: Container[str]) -> bool:
    """Whether it was made from parts with these digests; parts of ``given`` stages are not compared."""
    reads = artifact.manifest["inputs"]["reads"]
    return all(name.split(".")[0] in given or digests.get(name) == digest for name, digest in reads.items())


def _agrees(artifact: Artifact, config: BaseModel | None, stage: Stage) -> bool:
    """Whether it was made with these options; True if they cannot be compared."""
    inputs = artifact.manifest["inputs"]
    if config is None or inputs["version"] != stage.version:  # an older version's options are not compared
        return True
    return (inputs["config"], inputs["borrowed"]) == settings_of(config, stage)


def _delivered_artifact(store: Store, stage: Stage) -> Artifact | None:
    """The artifact of a stage whose deliverables are in OUT, else its newest; None without any."""
    artifacts = store.artifacts(stage.name)
    for artifact in artifacts:
        files = artifact.deliverables(stage)
        if files and all(is_copy(file, store.out / name) for name, file in files.items()):
            return artifact
    return artifacts[0] if artifacts else None


def _has(artifact: Artifact, name: str, digest: str) -> bool:
    part = artifact.parts.get(name)
    return part is not None and part.digest == digest
