"""What a stage is: a name, a configuration, the parts it reads and leaves, and a body loaded by string."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict

JSON = Any  # a value that json.dumps takes: pydantic's JsonValue costs import time
Summary = Mapping[str, JSON]


class StageConfig(BaseModel):
    """Base of every stage's configuration: what changes the answer. Unknown keys are refused.

    The docstring under each field is its help text. A field ``enabled`` turns a stage off: it reads nothing then, waits
    for no other stage, and its body leaves its parts empty.

    Attributes:
        gone: Options that there were, by their dotted names, with a sentence on what takes their place.
    """

    gone: ClassVar[Mapping[str, str]] = {}

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False, strict=True
    )

    @property
    def is_off(self) -> bool:
        """Whether the stage is turned off."""
        return not getattr(self, "enabled", True)


@dataclass(frozen=True)
class Machine:
    """What changes only speed; never part of a key.

    Attributes:
        device: ``auto``, ``cpu`` or ``cuda``.
        threads: Worker threads, at least 1.
        began_s: ``time.monotonic()`` when the command began, which all processes of a machine share; 0 where not known.
    """

    device: str = "auto"
    threads: int = 1
    began_s: float = 0.0


@dataclass(frozen=True)
class NamedFile:
    """A file of the user's that lies with the photos or is named by an option: an external part of its own.

    Attributes:
        part: The part, e.g. ``source.control``: the file, or a path that is none (``is_file()`` is false).
        names: What it is called where it lies in the photo folder or beside it, in small letters.
    """

    part: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class Shard:
    """Which piece of a stage's work.

    Attributes:
        number: From 1 on.
        count: How many there are.
    """

    number: int
    count: int

    @property
    def index(self) -> int:
        """Its place in a list of them."""
        return self.number - 1

    def __str__(self) -> str:
        return f"shard {self.number} of {self.count}"


@dataclass(frozen=True)
class Shards:
    """How a stage's work is divided: into pieces that any process may make, each an artifact of its own.

    Attributes:
        counted_by: The part, one that the stage reads, that says how many: a JSON object with ``shards``. With 0 the
            stage's own body does all of it.
        parts: What each leaves: part name to the file or folder below the shard's own folder.
        entry: ``module:function`` of the body that makes one; ``Inputs.shard`` says which.
        resumable: A shard's partial folder is kept after a kill, for the body to go on from.
    """

    counted_by: str
    parts: Mapping[str, str]
    entry: str
    resumable: bool = False


@dataclass(frozen=True)
class Stage:
    """One step of the line.

    Attributes:
        name: The stage's name; its parts are called ``<name>.<part>``.
        version: Raised whenever the body's answer changes for the same config and inputs.
        config: Its configuration model.
        reads: Names of the parts it reads unless it is turned off, e.g. ``ingest.photos``; ``source.photos`` is the
            user's folder.
        parts: What it leaves: part name to the file or folder below the stage's own folder.
        entry: ``module:function`` of the body, a ``Body``.
        borrows: Settings of other stages that its answer depends on, e.g. ``train.time_budget_s``.
        resumable: Its partial folder is kept after a kill, for the body to go on from.
        files: Files of the user's by the option that names them (``auto``, ``none`` or a path). Their content is in the
            key and the option is not: the body knows the part alone.
        deliverables: Parts that are copied into OUT for people (a folder part: what is in it).
        shards: How its work is divided; its own body joins them. None: it is one piece.
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
        """What makes one of its shards: a stage as any other, of the same options and inputs.

        Args:
            number: From 1 on.
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
    """The stage that a name belongs to: of ``train.2``, its second shard, as of ``train`` that is ``train``."""
    return name.partition(".")[0]


def shards_first(names: Iterable[str]) -> list[str]:
    """Names of stages in their order, each shard's before its stage's: it is heard of when it begins."""
    listed = list(names)
    place = {name: at for at, name in enumerate(listed)}
    return sorted(listed, key=lambda name: (place.get(stage_name(name), len(listed)), name == stage_name(name)))


@dataclass(frozen=True)
class Inputs:
    """All that a body may look at besides its config.

    Attributes:
        parts: Absolute path of each part that the stage reads.
        photos_dir: The user's photo folder. Its content is pinned by the digests in ``ingest.photos``.
        settings: The borrowed settings, by their dotted names.
        machine: Device and threads.
        summaries: What the stages before it returned; outside the key, so only for what people read (timings).
        shard: Which one to make; None for a stage's own body.
        shards: Folders of the stage's shards in order, for its own body to join; empty where it has none.
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
    """How a body tells what it does. Calls are cheap; the receiver thins them out."""

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None:
        """``done`` of ``total`` ``unit`` (photos, pairs, iterations); ``what`` is being done, in a few words."""

    def metric(self, name: str, value: int | float, step: int | None = None) -> None:
        """A figure worth a curve, e.g. ``loss`` at an iteration."""

    def note(self, message: str) -> None:
        """One line that everybody who watches wants to read, e.g. the plan of a training."""

    def warning(self, message: str, hint: str = "") -> None:
        """Something the user should know about a result that is right all the same."""


# The function behind ``Stage.entry``, as (config, inputs, out, report): writes all of the stage's parts below out.
Body = Callable[[Any, Inputs, Path, Reporter], Summary]


def load_body(entry: str) -> Body:
    """Import a stage's body.

    Args:
        entry: ``module:function``.
    """
    module, _, function = entry.partition(":")
    body: Body = getattr(importlib.import_module(module), function)
    return body
