"""A run that is looked at: its configuration, what its stages left, and whether it is at work."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.app.view.files import is_inside
from splatpipe.pipeline.engine.config import known, resolve
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runner import survey
from splatpipe.pipeline.engine.session import Request, load_run, survey_line
from splatpipe.pipeline.engine.source import with_absolute_files
from splatpipe.pipeline.engine.stage import Machine
from splatpipe.pipeline.engine.store import Artifact, Part, Store, open_store
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig

LOCK = ".lock"
REPORT = "report.html"  # the one thing for people in OUT that no stage delivers


@dataclass(frozen=True)
class Opened:
    """What there is of a run.

    Attributes:
        artifacts: Of each stage that is done, by name: those of the present configuration or, where its photos are no
            longer there to tell, the newest.
        parts: What they left, and the user's files, by full name.
        working: Where a stage that is not done leaves what it has so far, by name.
    """

    artifacts: Mapping[str, Artifact]
    parts: Mapping[str, Part]
    working: Mapping[str, Path]


@dataclass(frozen=True)
class Run:
    """An OUT.

    Attributes:
        out: Its folder, absolute, without links.
    """

    out: Path

    @property
    def store(self) -> Store:
        return Store(self.out)

    @property
    def name(self) -> str:
        """What people call it: its folder's name."""
        return self.out.name

    def config(self) -> tuple[Path, LineConfig]:
        """The photos' folder and the options that it ran with.

        Raises:
            UsageError: if it has none.
        """
        photos, table = load_run(self.out)
        return photos, resolve(LineConfig, [known(LineConfig, table)])

    def look(self) -> Opened:
        """What there is now."""
        try:
            photos, config = self.config()
            request = Request(LINE, with_absolute_files(config, LINE), photos, self.out, Machine("cpu", 1))
            line, store = survey_line(request)
            standings = list(survey(line, store))
        except (SplatpipeError, OSError):
            return self._newest()
        artifacts = {each.stage.name: each.artifact for each in standings if each.artifact is not None}
        parts = dict(line.source)
        for artifact in artifacts.values():
            parts |= artifact.parts
        working = {
            each.stage.name: store.working_folder(each.stage, each.key)
            for each in standings
            if each.artifact is None and each.key
        }
        return Opened(artifacts, parts, working)

    def _newest(self) -> Opened:
        found = {stage.name: self.store.artifacts(stage.name)[:1] for stage in LINE}
        artifacts = {name: each[0] for name, each in found.items() if each}
        parts = {name: part for artifact in artifacts.values() for name, part in artifact.parts.items()}
        return Opened(artifacts, parts, {})

    def deliverables(self) -> tuple[str, ...]:
        """What may be fetched, relative to OUT: what stages deliver to people, and the report; only what is there."""
        names = [REPORT]
        for stage in LINE:
            for artifact in self.store.artifacts(stage.name)[:1] if stage.deliverables else []:
                names += [path.as_posix() for path in artifact.deliverables(stage)]
        return tuple(name for name in names if is_inside(self.out, name))

    def is_at_work(self) -> bool:
        """Whether a splatpipe works in it now: it holds the lock."""
        with suppress(OSError):
            descriptor = os.open(self.store.stages / LOCK, os.O_RDONLY | os.O_NOFOLLOW)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # a run that begins now waits for longer
            except BlockingIOError:
                return True
            finally:
                os.close(descriptor)
        return False


def open_run(out: Path) -> Run:
    """The run in a folder.

    Raises:
        UsageError: if there is none.
    """
    open_store(out, create=False)
    return Run(out.expanduser().resolve())
