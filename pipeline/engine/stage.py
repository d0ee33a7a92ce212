"""Stage definitions: a name, a configuration, the parts read and written, and a body imported by name."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict

JSON = Any  # a value that json.dumps accepts; pydantic's JsonValue costs import time
Summary = Mapping[str, JSON]


class StageConfig(BaseModel):
    """Base class of stage configurations: everything that changes the result. Unknown keys are rejected.

    The docstring under each field is its help text. ``enabled = False`` turns a stage off: it then reads nothing, waits
    for no other stage, and its body writes empty parts.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False, strict=True
    )

    @property
    def is_off(self) -> bool:
        """Whether the stage is turned off."""
        return not getattr(self, "enabled", True)


@dataclass(frozen=True)
class Machine:
    """Settings that affect only speed; never part of a key.

    Attributes:
        device: ``auto``, ``cpu`` or ``cuda``.
        threads: Worker threads, at least 1.
        began_s: ``time.monotonic()`` at the start of the command, a clock that all processes on a machine share; 0 if
            unknown.
        memory_bytes: The user's limit on memory; 0 for none.
    """

    device: str = "auto"
    threads: int = 1
    began_s: float = 0.0
    memory_bytes: int = 0


@dataclass(frozen=True)
class NamedFile:
    """A user's file, found beside the photos or named by an option; it is an external part of its own.

    Attributes:
        part: The part, e.g. ``source.control``: the file's path, or one for which ``is_file()`` is false.
        names: The lower-case file names under which it is found in the photo folder or its parent folder.
    """

    part: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class Shard:
    """One piece of a stage's work.

    Attributes:
        number: Counted from 1.
        count: The number of shards.
    """

    number: int
    count: int

    @property
    def index(self) -> int:
        """The shard's index, counted from 0."""
        return self.number - 1

    def __str__(self) -> str:
        return f"shard {self.number} of {self.count}"


@dataclass(frozen=True)
class Shards:
    """How a stage's work is divided into pieces that any process may run, each an artifact of its own.

    Attributes:
        counted_by: The part, one that the stage reads, that gives their number: a JSON object with ``shards``. With 0,
            the stage's own body does all of the work.
        parts: What each shard writes: part name to the file or folder below the shard's own folder.
        entry: ``module:function`` of the body that runs one shard; ``Inputs.shard`` identifies it.
        resumable: A killed shard's partial folder is kept so that the body can resume from it.
    """

    counted_by: str
    parts: Mapping[str, str]
    entry: str
    resumable: bool = False


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline.

    Attributes:
        name: The stage's name; its parts are called ``<name>.<part>``.
        version: Raised whenever the body's result changes for the same config and inputs.
        config: Its configuration model.
        reads: Names of the parts it reads unless turned off, e.g. ``ingest.photos``; ``source.photos`` is the
            user's folder.
        parts: What it writes: part name to the file or folder below the stage's own folder.
        entry: ``module:function`` of the body, a ``Body``.
        borrows: Settings of other stages that its result depends on, e.g. ``train.time_budget_s``.
        resumable: Its partial folder is kept after a kill so that the body can resume from it.
        files: The user's files by the option that names them (``auto``, ``none`` or a path). Their content is in the
            key and the option is not: the body sees only the part.
        deliverables: Parts that are copied into OUT for people (of a folder part, its contents).
        shards: How its work is divided; its own body joins the shards. None: it is not divided.
    """

    name: str
    version: int
    config: type[StageConfig]
    reads: tuple[str, ...]
    parts: Mapping[str, str]
    entry: str
    borrows: tuple[str, ...] = ()
    resumable: bool = False
    files: Mapping[str, NamedFile] = field(default_factory=dict)
    deliverables: tuple[str, ...] = ()
    shards: Shards | None = None

    def shard(self, number: int) -> Stage:
        """The stage that produces one of this stage's shards, with the same options and inputs.

        Args:
            number: Counted from 1.
        """
        assert self.shards is not None
        return replace(
            self,
            name=f"{self.name}.{number}",
            parts=self.shards.parts,
            entry=self.shards.entry,
            resumable=self.shards.resumable,
            deliverables=(),
            shards=None,
        )


def stage_name(name: str) -> str:
    """The stage that a name belongs to: ``train`` for ``train`` and for ``train.2``, its second shard."""
    return name.partition(".")[0]


def shards_first(names: Iterable[str]) -> list[str]:
    """Order stage names as given, each stage's shards before it; a run names its shards only when they start."""
    listed = list(names)
    place = {name: at for at, name in enumerate(listed)}
    return sorted(listed, key=lambda name: (place.get(stage_name(name), len(listed)), name == stage_name(name)))


@dataclass(frozen=True)
class Inputs:
    """Everything a body may use besides its config.

    Attributes:
        parts: Absolute path of each part that the stage reads.
        photos_dir: The user's photo folder. Its content is pinned by the digests in ``ingest.photos``.
        settings: The borrowed settings by dotted name.
        machine: Device and threads.
        summaries: What earlier stages returned; outside the key, so only for what people read (timings).
        shard: The shard to run; None for a stage's own body.
        shards: Folders of the stage's shards in order, for its own body to join; empty if it has none.
    """

    parts: Mapping[str, Path]
    photos_dir: Path
    settings: Mapping[str, JSON] = field(default_factory=dict)
    machine: Machine = field(default_factory=Machine)
    summaries: Mapping[str, Summary] = field(default_factory=dict)
    shard: Shard | None = None
    shards: tuple[Path, ...] = ()

    def __getitem__(self, part: str) -> Path:
        return self.parts[part]


@runtime_checkable
class Reporter(Protocol):
    """How a body reports what it is doing. Calls are cheap; the receiver thins them out."""

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None:
        """Report ``done`` of ``total`` ``unit`` (photos, pairs, iterations); ``what`` names the work in a few words."""

    def metric(self, name: str, value: int | float, step: int | None = None) -> None:
        """Report a value worth plotting, e.g. ``loss`` at an iteration."""

    def note(self, message: str) -> None:
        """Report one line for everybody who watches the run, e.g. the training plan."""

    def warning(self, message: str, hint: str = "") -> None:
        """Report something the user should know about a result that is valid nevertheless."""


# The function behind ``Stage.entry``, called with (config, inputs, out, report); writes the stage's parts below out.
Body = Callable[[Any, Inputs, Path, Reporter], Summary]


def load_body(entry: str) -> Body:
    """Import and return a stage's body.

    Args:
        entry: ``module:function``.
    """
    module, _, function = entry.partition(":")
    body: Body = getattr(importlib.import_module(module), function)
    return body
