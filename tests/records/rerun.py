"""Runs stages of the tree in PYTHONPATH on an earlier run's output; a program for ``stage_comparison``.

Each stage reads the parts from the earlier run, whatever the other stages write now, so that differences are its own.
The input is a JSON object: ``earlier`` (that run's OUT), ``photos``, ``out``, ``threads``, ``stages`` (names). The
output is ``out/rerun.json``: for each stage its files' digests and whether an earlier artifact could be taken for its
own, or why it failed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.config import current_options, load_file, resolve
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.runner import Outcome, Runner
from splatpipe.pipeline.engine.runs.session import Request, open_session
from splatpipe.pipeline.engine.runs.store import Artifact, Part
from splatpipe.pipeline.engine.stage import Machine, Stage
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig


def main(job: Mapping[str, Any]) -> None:
    """Run the stages of a job, and those whose parts the earlier run lacks."""
    table = load_file(Path(job["earlier"]) / "config.toml")
    config = resolve(LineConfig, [_taken(current_options(LineConfig, table))])
    artifacts = _artifacts(Path(job["earlier"]))
    out = Path(job["out"])
    found = {}
    with open_session(
        Request(LINE, config, Path(job["photos"]), out, Machine("cpu", job["threads"])), _unseen
    ) as runner:
        parts = dict(runner.line.source)
        for artifact in artifacts.values():
            parts |= artifact.parts
        last = max(number for number, stage in enumerate(LINE) if stage.name in job["stages"])
        for stage in LINE[: last + 1]:
            lacking = any(f"{stage.name}.{name}" not in parts for name in stage.parts)
            if stage.name in job["stages"] or lacking:
                found[stage.name] = _run(stage, runner, parts, artifacts)
    (out / "rerun.json").write_text(json.dumps(found), encoding="utf-8")


def _taken(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration without options that no longer exist; their stages get defaults and new keys."""
    taken: dict[str, Any] = {}
    for section, options in table.items():
        for option, value in options.items():
            with suppress(UsageError):
                resolve(LineConfig, [{section: {option: value}}])
                taken.setdefault(section, {})[option] = value
    return taken


def _unseen(_event: Event) -> None:
    """Discard the event."""


def _artifacts(out: Path) -> dict[str, Artifact]:
    """Return the artifacts of the earlier run, by stage, in the order in which they were made."""
    manifests = {path.parent: json.loads(path.read_text("utf-8")) for path in (out / "stages").glob("*/manifest.json")}
    ordered = sorted(manifests.items(), key=lambda item: item[1]["finished_s"])
    return {manifest["stage"]: Artifact(folder, manifest) for folder, manifest in ordered}


def _run(stage: Stage, runner: Runner, parts: dict[str, Part], artifacts: Mapping[str, Artifact]) -> dict[str, Any]:
    """Run one stage; its parts join those of the earlier run, but replace none."""
    line = replace(runner.line, stages=(stage,), source=parts)
    earlier = artifacts.get(stage.name)
    inputs = asdict(line.inputs_of(stage, parts))
    reused = earlier is not None and _asked(earlier.manifest["inputs"], earlier.manifest["parts"]) == _asked(
        inputs, stage.parts
    )
    try:
        alone = replace(runner, jobs=replace(runner.jobs, line=line), outcome=Outcome(dict(artifacts)))
        done = alone.walk().artifacts[stage.name]
    except SplatpipeError as error:
        return {"reused": reused, "failed": error.message, "files": {}}
    for name, part in done.parts.items():
        parts.setdefault(name, part)
    files = {file["path"]: file["sha256"] for part in done.manifest["parts"].values() for file in part["files"]}
    return {"reused": reused, "files": files}


def _asked(inputs: Mapping[str, Any], parts: Iterable[str]) -> dict[str, Any]:
    """Return what a key is made of, except for the contents of the parts read, and what an artifact must have."""
    return {**inputs, "reads": sorted(inputs["reads"]), "parts": sorted(parts)}


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
