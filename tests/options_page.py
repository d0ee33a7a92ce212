"""``make options-page``: writes the tables of ``docs/options.md`` and ``docs/node.md`` from the options' own help."""

from __future__ import annotations

import sys
import types
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from generated_pages import write
from pydantic.fields import FieldInfo

from splatpipe.pipeline.app.node.tasks.options import LISTED
from splatpipe.pipeline.engine.config import load_preset, lookup, option_help, preset_names, resolve
from splatpipe.stages.options import LineConfig

PAGE = Path(__file__).resolve().parents[1] / "docs" / "options.md"
MARK = "<!-- Below this line: make options-page -->"
NODE_PAGE = PAGE.with_name("node.md")
NODE_BEGIN, NODE_END = "<!-- options of a job: make options-page -->", "<!-- end of options -->"
KINDS = {bool: "`true`, `false`", str: "text", int: "whole number", float: "number"}


def written() -> str:
    """Return the whole page: the hand-written part above the mark, and the tables below it."""
    by_hand, mark, _ = PAGE.read_text(encoding="utf-8").partition(MARK)
    if not mark:
        raise ValueError(f"{PAGE} has no line {MARK}")
    return f"{by_hand}{MARK}\n\n{tables()}"


def node_page() -> str:
    """Return the page of the node, with the table of a job's options."""
    before, begin, rest = NODE_PAGE.read_text(encoding="utf-8").partition(NODE_BEGIN)
    _, end, after = rest.partition(NODE_END)
    if not begin or not end:
        raise ValueError(f"{NODE_PAGE} has no lines {NODE_BEGIN} and {NODE_END}")
    lines = ["| option | default | what it does |", "|---|---|---|"]
    for option in LISTED:
        choices = ", ".join(option.domain) if isinstance(option.domain, tuple) else ""
        text = option.help.partition(" Can be one of:")[0].partition(" Default:")[0]
        default = {"": "", "0": "", "false": "off"}.get(option.default, f"`{option.default}`")
        lines.append(f"| `{option.name}` | {default} | {text}{f' ({choices})' if choices else ''} |")
    table = "\n".join(lines)
    return f"{before}{begin}\n\n{table}\n\n{end}{after}"


def tables() -> str:
    """Return a section for each stage with a row for each of its options, in Markdown."""
    presets = {name: resolve(LineConfig, [load_preset(name)]) for name in preset_names()}
    texts = dict(option_help(LineConfig))
    sections = []
    for section, info in LineConfig.model_fields.items():
        fields: dict[str, FieldInfo] = info.annotation.model_fields  # type: ignore[union-attr]
        lines = [f"## {section}", ""]
        if fields:
            lines += ["| option | takes | default | presets | what it does |", "|---|---|---|---|---|"]
        else:
            lines.append("No options.")
        for option, field in fields.items():
            name = f"{section}.{option}"
            default = field.get_default(call_default_factory=True)
            others = [(preset, lookup(config, name)) for preset, config in presets.items()]
            differing = "; ".join(f"{preset} {value_text(value)}" for preset, value in others if value != default)
            cells = (f"`{name}`", kind(field), value_text(default), differing, texts[name])
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        sections.append("\n".join(lines))
    return "\n\n".join(sections) + "\n"


def kind(field: FieldInfo) -> str:
    """Describe in words the values that an option accepts."""
    return " or ".join(_kinds(field.annotation, field.metadata))


def value_text(value: Any) -> str:
    """Format a value as after ``--set``."""
    if value == "":
        return "empty"
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _kinds(annotation: Any, limits: Sequence[Any]) -> Iterator[str]:
    """Describe in words what a type accepts; limits are annotated-types' ``Ge``, ``Gt``, ``Le``, ``Lt``."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        inner, *inner_limits = typing.get_args(annotation)
        yield from _kinds(inner, [*limits, *inner_limits])
    elif origin in (typing.Union, types.UnionType):
        for each in typing.get_args(annotation):
            yield from _kinds(each, limits)
    elif origin is Literal:
        yield ", ".join(f"`{choice}`" for choice in typing.get_args(annotation))
    else:
        flat = [part for limit in limits for part in getattr(limit, "metadata", [limit])]
        yield ", ".join([KINDS[annotation], *_limits(flat)])


def _limits(limits: Sequence[Any]) -> Iterator[str]:
    for attribute, words in (("ge", "at least"), ("gt", "above"), ("le", "at most"), ("lt", "below")):
        for limit in limits:
            if (bound := getattr(limit, attribute, None)) is not None:
                yield f"{words} {int(bound) if bound == int(bound) else bound:,}"


if __name__ == "__main__":
    sys.exit(write({PAGE: written(), NODE_PAGE: node_page()}))
