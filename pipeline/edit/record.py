"""The record of edits: briefly in the splat's file, and in full in a file beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

from splatpipe.pipeline.edit.sources import SplatSource
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import json_text
from splatpipe.pipeline.splat.model.scene import MAX_EDITS, SceneFacts

FORMAT = 1
EARLIER = "earlier edits"

Edit = dict[str, Any]


def with_edits(facts: SceneFacts, edits: Sequence[Edit]) -> SceneFacts:
    """The facts with new edits appended; if there is not enough room, the oldest are only counted."""
    every: list[Mapping[str, Any]] = [*facts.edits, *edits]
    dropped = 0
    while True:
        shortened = replace(facts, edits=tuple([{"step": EARLIER, "count": dropped}, *every] if dropped else every))
        if len(shortened.edits) <= MAX_EDITS and _fits(shortened):
            return shortened
        first = every.pop(0)
        dropped += int(first.get("count", 1)) if first.get("step") == EARLIER else 1


def _fits(facts: SceneFacts) -> bool:
    try:
        facts.record()
    except ValueError:
        return not facts.edits  # without any, it is not the edits that are too long
    return True


def write_record(
    path: Path, source: SplatSource, digest: str, edits: Sequence[Edit], output: Mapping[str, Any]
) -> None:
    """Write `<stem>.edits.json`.

    Args:
        path: The file to write.
        source: The splat that was edited.
        digest: Its sha256.
        edits: The steps.
        output: Facts about the output.

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
