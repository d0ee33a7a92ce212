"""What was done to a splat: in its file, in few words, and beside it with all that tells how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

from splatpipe.pipeline.edit.sources import SplatSource
from splatpipe.pipeline.engine.durable import write_durably
from splatpipe.pipeline.engine.json_file import json_text
from splatpipe.pipeline.splat.scene import MOST_EDITS, SceneFacts

FORMAT = 1
EARLIER = "earlier edits"

Edit = dict[str, Any]


def with_edits(facts: SceneFacts, edits: Sequence[Edit]) -> SceneFacts:
    """What a file says with what was done to it now; what was done first is counted only, where there is no room."""
    every: list[Mapping[str, Any]] = [*facts.edits, *edits]
    dropped = 0
    while True:
        told = replace(facts, edits=tuple([{"step": EARLIER, "count": dropped}, *every] if dropped else every))
        if len(told.edits) <= MOST_EDITS and _fits(told):
            return told
        first = every.pop(0)
        dropped += int(first.get("count", 1)) if first.get("step") == EARLIER else 1


def _fits(facts: SceneFacts) -> bool:
    try:
        facts.record()
    except ValueError:
        return not facts.edits  # then it is not the edits that are too long
    return True


def write_record(
    path: Path, source: SplatSource, digest: str, edits: Sequence[Edit], output: Mapping[str, Any]
) -> None:
    """Write `<stem>.edits.json`.

    Args:
        path: Where.
        source: What was edited.
        digest: sha256 of it.
        edits: What was done.
        output: What it became.

    Raises:
        OSError: if it cannot be written.
    """
    value = {
        "format": FORMAT,
        "splatpipe": metadata.version("splatpipe"),
        "input": {"name": source.name, "sha256": digest},
        "steps": list(edits),
        "output": dict(output),
    }
    write_durably(path, json_text(value))
