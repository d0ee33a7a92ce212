"""What OUT holds that belongs together: the artifacts of one line, and the files that were handed over from them."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.report.story import Story, read_story
from splatpipe.pipeline.engine.config import known, lookup
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.session import EVENTS_FILE, load_run
from splatpipe.pipeline.engine.stage import Stage
from splatpipe.pipeline.engine.store import Artifact, Store
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig

MAX_JSON_BYTES = 256 << 20  # an accuracy report of thousands of points is far below

BAD = ("failed", "stopped", "broken off", "running")


@dataclass(frozen=True)
class Deliverable:
    """A file in OUT for people.

    Attributes:
        name: Its path in OUT, in POSIX form.
        size: Bytes.
        current: Whether it was made by what the report tells of; else by an earlier run.
    """

    name: str
    size: int
    current: bool


@dataclass(frozen=True)
class Holdings:
    """All that a report is made from.

    Attributes:
        out: The run's folder.
        story: What happened.
        config: The options as they were; None where they cannot be read.
        photos_dir: The user's folder; None where nobody knows.
        artifacts: Those that belong together, by stage.
        deliverables: Files in OUT for people.
    """

    out: Path
    story: Story
    config: LineConfig | None
    photos_dir: Path | None
    artifacts: Mapping[str, Artifact]
    deliverables: Sequence[Deliverable]

    def part(self, name: str) -> Path | None:
        """Where a part lies, e.g. ``georef.frame``; None if it was not made."""
        artifact = self.artifacts.get(name.partition(".")[0])
        found = artifact.parts.get(name) if artifact is not None else None
        return None if found is None else found.path

    def read(self, name: str) -> Any:
        """A part that is a JSON file; an empty table where it was not made.

        Raises:
            OSError: if it cannot be read.
            ValueError: if it is no JSON, or far too large.
        """
        path = self.part(name)
        return {} if path is None else read_json(path)

    def read_in_part(self, name: str, file: str) -> Any:
        """A JSON file in a part that is a folder; an empty table where the part was not made.

        Raises:
            OSError: if it cannot be read.
            ValueError: if it is no JSON, or far too large.
        """
        path = self.part(name)
        return {} if path is None else read_json(path / file)

    def read_unfinished(self, stage: str, file: str) -> Any:
        """A JSON file that a stage had written when it was stopped; an empty table where there is none.

        Raises:
            ValueError: if it is no JSON, or far too large.
        """
        story = self.story.stages.get(stage)
        if story is None or not story.key:
            return {}
        path = Store(self.out).working_folder(next(each for each in LINE if each.name == stage), story.key) / file
        return read_json(path) if path.is_file() else {}

    def summary(self, stage: str) -> Mapping[str, Any]:
        """What a stage returned; empty where it did not finish."""
        artifact = self.artifacts.get(stage)
        return {} if artifact is None else artifact.summary


def read_json(path: Path) -> Any:
    """A JSON file of ours.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is no JSON, or far too large.
    """
    if path.stat().st_size > MAX_JSON_BYTES:
        raise ValueError(f"{path.name} is too large to be one of a run's")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError(f"{path.name} is nested too deeply") from error


def open_holdings(out: Path) -> Holdings:
    """Look at a run's folder, which may be that of a running, a stopped or a failed one.

    Args:
        out: The folder; it has `stages/`.
    """
    store = Store(out)
    story = read_story(out / EVENTS_FILE, running=_is_locked(store))
    config, photos_dir = _configuration(out)
    artifacts = _belonging(store, story, config)
    return Holdings(out, story, config, photos_dir, artifacts, _deliverables(store, artifacts))


def _configuration(out: Path) -> tuple[LineConfig | None, Path | None]:
    try:
        photos_dir, table = load_run(out)
        return LineConfig.model_validate(known(LineConfig, table)), photos_dir
    except (SplatpipeError, ValueError):
        return None, None


def _is_locked(store: Store) -> bool:
    try:
        with (store.stages / ".lock").open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _belonging(store: Store, story: Story, config: LineConfig | None) -> dict[str, Artifact]:
    """Of each stage the artifact that the last run made or would reuse; none that a later stage's inputs contradict."""
    chosen: dict[str, Artifact] = {}
    digests: dict[str, str] = {}
    for stage in LINE:
        happened = story.stages.get(stage.name)
        if happened is not None and happened.state in BAD:
            continue
        for artifact in store.artifacts(stage.name):
            key = story.keys.get(stage.name)
            if _belongs(artifact, stage, config, digests) and (not key or artifact.key == key):
                chosen[stage.name] = artifact
                digests |= {name: part.digest for name, part in artifact.parts.items()}
                break
    return chosen


def _belongs(artifact: Artifact, stage: Stage, config: LineConfig | None, digests: Mapping[str, str]) -> bool:
    inputs = artifact.manifest["inputs"]
    reads = {name: value for name, value in inputs["reads"].items() if not name.startswith("source.")}
    if any(digests.get(name) != value for name, value in reads.items()):
        return False
    if config is None or inputs["version"] != stage.version:  # an older version's options are not compared
        return True
    section = getattr(config, stage.name).model_dump(mode="json", exclude=set(stage.files))
    borrowed = {name: lookup(config, name) for name in stage.borrows}
    return bool(inputs["config"] == section and inputs["borrowed"] == borrowed)


def _deliverables(store: Store, chosen: Mapping[str, Artifact]) -> list[Deliverable]:
    found: dict[str, Deliverable] = {}
    for stage in LINE:
        for artifact in [*filter(None, [chosen.get(stage.name)]), *store.artifacts(stage.name)]:
            for name in artifact.deliverables(stage):
                path = store.out / name
                if name.as_posix() not in found and path.is_file():
                    current = artifact is chosen.get(stage.name)
                    found[name.as_posix()] = Deliverable(name.as_posix(), path.stat().st_size, current)
    return sorted(found.values(), key=lambda file: file.name)
