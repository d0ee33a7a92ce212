"""Reads a report's inputs from OUT: a consistent set of artifacts and the deliverables made from them."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.measurements import SECTIONS, VOLUMES
from splatpipe.pipeline.app.report.facts.run_history import RunHistory, read_history
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE, Contents, RunFolder, open_run_folder
from splatpipe.pipeline.engine.runs.store import Artifact
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig

BAD = ("failed", "stopped", "interrupted", "running")


@dataclass(frozen=True)
class Deliverable:
    """A deliverable in OUT.

    Attributes:
        name: Its POSIX path relative to OUT.
        size: Bytes.
        current: Whether it was made from the report's artifacts; else by an earlier run.
    """

    name: str
    size: int
    current: bool


@dataclass(frozen=True)
class ReportInputs:
    """Everything that a report is made from.

    Attributes:
        out: The run's folder.
        history: The history of the last run.
        config: The run's options; None if they cannot be read.
        photos_dir: The user's folder; None if unknown.
        contents: The consistent set of artifacts.
        deliverables: The deliverables in OUT.
    """

    out: Path
    history: RunHistory
    config: LineConfig | None
    photos_dir: Path | None
    contents: Contents
    deliverables: Sequence[Deliverable]

    @property
    def artifacts(self) -> Mapping[str, Artifact]:
        """The consistent set of artifacts by stage."""
        return self.contents.artifacts

    def part(self, name: str) -> Path | None:
        """The path of a part, e.g. ``georef.frame``; None if it does not exist."""
        found = self.contents.parts.get(name)
        return None if found is None else found.path

    def read(self, name: str) -> Any:
        """Read a part that is a JSON file; an empty dict if it does not exist.

        Raises:
            OSError: if it cannot be read.
            ValueError: if it is not JSON, or far too large.
        """
        path = self.part(name)
        return {} if path is None else read_json(path)

    def read_in_part(self, name: str, file: str) -> Any:
        """Read a JSON file in a folder part; an empty dict if the part does not exist.

        Raises:
            OSError: if it cannot be read.
            ValueError: if it is not JSON, or far too large.
        """
        path = self.part(name)
        return {} if path is None else read_json(path / file)

    def summary(self, stage: str) -> Mapping[str, Any]:
        """A stage's summary; empty if it did not finish."""
        artifact = self.artifacts.get(stage)
        return {} if artifact is None else artifact.summary


def read_report_inputs(out: Path) -> ReportInputs:
    """Read the inputs from the folder of a run, which may be running, stopped or failed.

    Args:
        out: The folder.

    Raises:
        UsageError: if there is no run in it.
    """
    run = open_run_folder(out, LINE)
    history = read_history(run.out / EVENTS_FILE, running=run.is_running)
    config, photos_dir = _configuration(run)
    unfinished = {name for name, stage in history.stages.items() if stage.state in BAD}
    contents = run.contents(config, history.keys, unfinished)
    return ReportInputs(run.out, history, config, photos_dir, contents, _deliverables(run, contents))


def results_digest(inputs: ReportInputs) -> str:
    """Digest of the results that a report shows, whichever command last found them finished; empty if it did not.

    Args:
        inputs: The report's inputs.
    """
    history = inputs.history
    if history.exit_code or not all(stage.state in ("finished", "reused") for stage in history.stages.values()):
        return ""
    facts = [
        importlib.metadata.version("splatpipe"),
        inputs.out.resolve().name,
        str(inputs.photos_dir),
        None if inputs.config is None else inputs.config.model_dump(mode="json"),
        {name: artifact.key for name, artifact in inputs.artifacts.items()},
        [(file.name, file.size, file.current) for file in inputs.deliverables],
        [(path.name, path.stat().st_mtime_ns) for path in measured_files(inputs)],
    ]
    return hashlib.sha256(json.dumps(facts).encode("utf-8", "surrogatepass")).hexdigest()


def measured_files(inputs: ReportInputs) -> list[Path]:
    """The files of the measurements in OUT, which no stage made."""
    places = [inputs.out / VOLUMES, *sorted((inputs.out / SECTIONS).glob("*"))]
    return [path for path in places if path.is_file()]


def _configuration(run: RunFolder) -> tuple[LineConfig | None, Path | None]:
    try:
        photos_dir, config = run.config(LineConfig)
    except SplatpipeError:
        return None, None
    return config, photos_dir


def _deliverables(run: RunFolder, contents: Contents) -> list[Deliverable]:
    made = [(stage, contents.artifacts[stage.name]) for stage in LINE if stage.name in contents.artifacts]
    current = {name.as_posix() for stage, artifact in made for name in artifact.deliverables(stage)}
    return [Deliverable(name, (run.out / name).stat().st_size, name in current) for name in sorted(run.deliverables())]
