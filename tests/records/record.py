"""The record of the sources behind each stage's version: ``stages/versions.toml``."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import tomli_w
from sources import RECORD, Sources

LINE_FILE = Path("stages/line.py")
RECORD_FILE = Path("stages") / RECORD
HEAD = "# Which sources each stage's version stands for: written by `make versions`, checked by the tests.\n\n"


@dataclass(frozen=True)
class StageSources:
    """A stage's version, and the digest of the sources that its body reaches."""

    version: int
    sources: str


def present(root: Path) -> dict[str, StageSources]:
    """Return a tree's stages, in pipeline order, read without importing them."""
    sources = Sources(root)
    found = {}
    for node in ast.walk(ast.parse((root / LINE_FILE).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Stage":
            arguments = {keyword.arg: keyword.value for keyword in node.keywords}
            values = (node.args[0], arguments["version"], arguments["entry"])
            name, version, entry = (ast.literal_eval(value) for value in values)
            found[name] = StageSources(version, sources.digest(entry, *_shards_entry(arguments.get("shards"))))
    return found


def _shards_entry(call: ast.expr | None) -> list[str]:
    """Return the body of a stage's shards, if it has any."""
    if not isinstance(call, ast.Call):
        return []
    named = [keyword.value for keyword in call.keywords if keyword.arg == "entry"]
    return [ast.literal_eval(value) for value in (*call.args[2:3], *named)]


def recorded(root: Path) -> dict[str, StageSources]:
    """Return the recorded stages; empty if there is no record."""
    if not (root / RECORD_FILE).is_file():
        return {}
    table = tomllib.loads((root / RECORD_FILE).read_text(encoding="utf-8"))
    return {name: StageSources(**entry) for name, entry in table.items()}


def write(root: Path, stages: Mapping[str, StageSources]) -> None:
    """Write the record, one table per stage."""
    text = tomli_w.dumps({name: asdict(stage) for name, stage in stages.items()})
    (root / RECORD_FILE).write_text(HEAD + text, encoding="utf-8")


def differing(now: Mapping[str, StageSources], before: Mapping[str, StageSources]) -> list[str]:
    """Return the stages that differ, including those that one of the two lacks."""
    return [name for name in {**now, **before} if now.get(name) != before.get(name)]


def complaint(root: Path) -> str:
    """Return CI's message if sources or versions differ from the record; otherwise empty."""
    names = differing(present(root), recorded(root))
    if not names:
        return ""
    return (
        f"Sources or version changed of: {', '.join(names)}. What these stages left before may be reused although they "
        "would now leave something else. Run `make versions`, and commit stages/versions.toml."
    )
