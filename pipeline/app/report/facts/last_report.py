"""What the last report shows, for the next: most commands change little of it, and drawing is most of a report's work.

``stages/last-report.json`` has the chapters' content and a key of all that each was made from; a picture in it is a
place in ``report.html``, which shows it anyway. Only a report of this program on this disk is taken over, never one
in a folder from elsewhere: the page has to be the same file, with the same ctime, which no program can set.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from markupsafe import Markup

from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs, measured_files, results_digest
from splatpipe.pipeline.app.report.facts.run_history import RunHistory
from splatpipe.pipeline.engine.digests import digest
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import own_folder
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.engine.runs.run_folder import Contents
from splatpipe.pipeline.engine.runs.store import Artifact
from splatpipe.pipeline.engine.stage import JSON

SEEN = {  # the stages from which each chapter with pictures is made; it is shown no other
    "capture": ("ingest", "sparse", "georef", "split"),
    "registration": ("ingest", "features", "matches", "sparse", "georef"),
    "georeferencing": ("ingest", "sparse", "georef", "evaluate", "export"),
    "training": ("split", "initialize", "blocks", "train", "clean"),
    "views": ("ingest", "evaluate"),
    "surfaces": ("dsm", "dtm", "ortho", "facades", "cloud", "mesh"),
}
SHOWN_OF_EXPORT = "georef"  # the only part that a chapter is shown: its others are new with every format
CODE = Path(__file__).resolve().parents[1]
LIBRARIES = ("splatpipe", "matplotlib", "numpy", "opencv-contrib-python-headless", "pillow", "pycolmap")
PICTURE = "picture-at"  # key of an object that stands for a picture: first byte and number of bytes

Chapter = dict[str, Any]


@dataclass
class LastReport:
    """The last report of a run.

    Attributes:
        inputs: Those of the report that is now written.
        page: The bytes of ``report.html``; empty if nothing can be taken over.
        kept: Key and content of its chapters by name.
        shown: Those of the report that is now written.
    """

    inputs: ReportInputs
    page: bytes = b""
    kept: Mapping[str, Any] = field(default_factory=dict)
    shown: dict[str, tuple[str, Chapter | None]] = field(default_factory=dict)

    @classmethod
    def read(cls, inputs: ReportInputs, page_file: Path, record_file: Path) -> LastReport:
        """The report that is in OUT; an empty one if this program did not write it there.

        Args:
            inputs: Those of the report that is now written.
            page_file: ``report.html``.
            record_file: Its record.
        """
        with suppress(OSError, ValueError, LookupError, TypeError):
            record = read_json(record_file)
            with open_regular(page_file) as file:
                is_same = record["file"] == _stamp(os.fstat(file.fileno()))
                page = file.read() if is_same else b""
            if is_same and record["sha256"] == hashlib.sha256(page).hexdigest():
                return cls(inputs, page, dict(record["chapters"]))
        return cls(inputs)

    def chapter(self, name: str, make: Callable[[ReportInputs], Chapter | None]) -> Chapter | None:
        """Make a chapter, unless the last report has it.

        Args:
            name: Its name.
            make: Makes it from the inputs that it is given, and from nothing else.
        """
        if not self._is_finished:
            return make(self.inputs)  # also from the history
        seen = _limited(self.inputs, SEEN[name])
        key = digest([name, _program_facts(), _input_facts(seen)])
        made: Chapter | None
        with suppress(LookupError, ValueError, TypeError):
            known, content = self.kept[name]
            if known == key:
                made = self._with_pictures(content)
                self.shown[name] = key, made
                return made
        made = make(seen)
        self.shown[name] = key, made
        return made

    @cached_property
    def _is_finished(self) -> bool:
        return "train" in self.inputs.artifacts and bool(results_digest(self.inputs))

    def keep(self, page: str, page_file: Path, record_file: Path) -> None:
        """Record the report that was now written; without a record the next one is drawn whole.

        Args:
            page: Its text.
            page_file: The file that it was written to.
            record_file: The record.
        """
        data = page.encode()
        chapters = {}
        for name, (key, chapter) in self.shown.items():
            with suppress(ValueError, TypeError):  # it has a picture that the page does not show, or no plain value
                content = _Places(data).plain(chapter)
                json.dumps(content)
                chapters[name] = [key, content]
        with suppress(OSError, SplatpipeError):
            record = {"file": _stamp(page_file.stat()), "sha256": hashlib.sha256(data).hexdigest()}
            own_folder(self.inputs.out, record_file.parent.name)
            write_durably(record_file, json.dumps({**record, "chapters": chapters}))

    def _with_pictures(self, value: Any) -> Any:
        if isinstance(value, dict):
            if PICTURE not in value:
                return {name: self._with_pictures(each) for name, each in value.items()}
            first, size = value[PICTURE]
            return Markup(self.page[first : first + size].decode())  # as it stands in the page
        return [self._with_pictures(each) for each in value] if isinstance(value, list) else value


class _Places:
    """Turns content into plain values; a picture becomes its place in the page.

    Args:
        page: The page.
    """

    def __init__(self, page: bytes) -> None:
        self._page, self._at = page, 0

    def plain(self, value: Any) -> Any:
        if isinstance(value, Markup):
            data = value.encode()
            place = self._page.find(data, self._at)  # mostly the next one
            self._at = place if place >= 0 else self._page.index(data)
            return {PICTURE: [self._at, len(data)]}
        if is_dataclass(value) and not isinstance(value, type):
            return {each.name: self.plain(getattr(value, each.name)) for each in fields(value)}
        if isinstance(value, Mapping):
            return {name: self.plain(each) for name, each in value.items()}
        if isinstance(value, Sequence) and not isinstance(value, str):
            return [self.plain(each) for each in value]
        return value


def _limited(inputs: ReportInputs, stages: Sequence[str]) -> ReportInputs:
    """The inputs as if there were only these stages."""
    artifacts = {name: inputs.artifacts[name] for name in stages if name in inputs.artifacts}
    if export := artifacts.get("export"):
        parts = {name: part for name, part in export.manifest["parts"].items() if name == SHOWN_OF_EXPORT}
        artifacts["export"] = Artifact(export.folder, {"stage": "export", "key": "", "summary": {}, "parts": parts})
    return replace(inputs, history=RunHistory(), contents=Contents(artifacts), deliverables=())


def _input_facts(inputs: ReportInputs) -> JSON:
    """What identifies limited inputs. The photos themselves are those of ``ingest``: each command checks that first."""
    config = None if inputs.config is None else inputs.config.train.model_dump(mode="json")
    artifacts = {
        name: [part.digest for part in artifact.parts.values()] if name == "export" else _file_facts(artifact.folder)
        for name, artifact in inputs.artifacts.items()
    }
    measured = [[path.name, *_stamp(path.stat())] for path in measured_files(inputs)]
    return [str(inputs.photos_dir), config, artifacts, measured]


@cache
def _program_facts() -> JSON:
    code = [[path.name, *_stamp(path.stat())] for path in sorted(CODE.rglob("*.py"))]
    return [code, [importlib.metadata.version(name) for name in LIBRARIES]]


def _file_facts(folder: Path) -> JSON:
    """Without the ctime, which changes when a file is linked to as a deliverable."""
    files = (path for path in sorted(folder.rglob("*")) if not path.is_dir())
    found = [(path.relative_to(folder).as_posix(), path.lstat()) for path in files]
    return [[name, status.st_size, status.st_mtime_ns, status.st_ino] for name, status in found]


def _stamp(status: os.stat_result) -> list[JSON]:
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]
