"""Configuration: defaults < preset < file < ``--set``; determines the result and is checked before anything runs."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TypeVar

import tomli_w
from pydantic import BaseModel, ValidationError

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.stage import JSON, Stage

Table = dict[str, JSON]
Model = TypeVar("Model", bound=BaseModel)
MAX_CONFIG_BYTES = 1 << 20  # a configuration is a page of text
MAX_DOTS = 20_000_000  # squares of the dots in each line: of a key with so many, tomllib keeps all beginnings


def preset_names() -> list[str]:
    """Sorted names of the presets that ship with the package."""
    folder = resources.files("splatpipe.configs")
    return sorted(entry.name[: -len(".toml")] for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_preset(name: str) -> Table:
    """Read a preset.

    Raises:
        UsageError: if there is no preset of that name.
    """
    if name not in preset_names():
        raise UsageError(f'There is no preset "{name}".', hint=f"Choose one of: {', '.join(preset_names())}.")
    return tomllib.loads((resources.files("splatpipe.configs") / f"{name}.toml").read_text(encoding="utf-8"))


def parse_toml(data: bytes) -> Table:
    """The table of TOML text in UTF-8, with or without a byte order mark.

    Raises:
        ValueError: if it is not TOML, or could have keys of thousands of parts.
        RecursionError: if it is nested too deeply.
    """
    if sum(line.count(b".") ** 2 for line in data.split(b"\n")) > MAX_DOTS:
        raise ValueError("it has lines with thousands of dots")
    return tomllib.loads(data.decode("utf-8-sig"))


def load_file(path: Path) -> Table:
    """Read a TOML file.

    Raises:
        UsageError: if it cannot be read or is not TOML; the message includes the line.
    """
    try:
        return parse_toml(read_small(path, MAX_CONFIG_BYTES))
    except OSError as error:
        raise UsageError(
            f"Cannot read {path}: {error.strerror}.", hint="Check the path given with --config."
        ) from error
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, or a number with thousands of digits
        raise UsageError(
            f"{path} is not valid TOML: {error}.",
            hint='Write it like: [train] and below it "iterations = 7000".',
        ) from error


def current_options(model: type[BaseModel], table: Mapping[str, JSON]) -> Table:
    """The entries of an OUT's options that this version has; invalid values are kept, to be rejected later."""
    result: Table = {}
    for name, value in table.items():
        if name in model.model_fields:
            section = model.model_fields[name].annotation
            nested = isinstance(section, type) and issubclass(section, BaseModel) and isinstance(value, Mapping)
            result[name] = current_options(section, value) if nested else value  # type: ignore[arg-type]
    return result


def _nested(keys: Sequence[str], value: JSON) -> Table:
    """Nest a value: ``train``, ``seed`` and 3 become ``{"train": {"seed": 3}}``."""
    table: JSON = value
    for key in reversed(keys):
        table = {key: table}
    result: Table = table
    return result


def parse_set(assignment: str, model: type[BaseModel]) -> Table:
    """Turn ``train.iterations=7000`` into ``{"train": {"iterations": 7000}}``.

    Args:
        assignment: The argument of ``--set``; text options take the value verbatim, others as TOML.
        model: The configuration model.

    Raises:
        UsageError: if there is no ``=`` or no section.
    """
    dotted, equals, raw = assignment.partition("=")
    keys = _keys(dotted)
    if not equals or not keys:
        raise UsageError(
            f'Cannot understand --set "{assignment}".',
            hint="Write it as --set SECTION.OPTION=VALUE, e.g. train.iterations=7000.",
        )
    return _nested(keys, raw.strip() if _takes_text(model, keys) else _parse_value(raw.strip()))


def table_of(dotted: str, value: JSON) -> Table:
    """Turn ``train.iterations`` and 7000 into ``{"train": {"iterations": 7000}}``.

    Args:
        dotted: The option's name.
        value: Its value; a path counts as text.

    Raises:
        UsageError: if the name has no section.
    """
    keys = _keys(dotted)
    if not keys:
        raise UsageError(
            f'Cannot understand the option "{dotted}".',
            hint='Write it as "SECTION.OPTION": VALUE, e.g. "train.iterations": 7000.',
        )
    return _nested(keys, str(value) if isinstance(value, Path) else value)


def _keys(dotted: str) -> list[str]:
    """The parts of a dotted name; empty if it has no section."""
    keys = dotted.strip().split(".")
    return keys if len(keys) >= 2 and all(keys) else []


def _takes_text(model: type[BaseModel], keys: Sequence[str]) -> bool:
    annotation: JSON = model
    for key in keys:
        fields = getattr(annotation, "model_fields", {})
        annotation = fields[key].annotation if key in fields else None
    return annotation is str


def _parse_value(raw: str) -> JSON:
    try:
        return tomllib.loads(f"value = {raw}")["value"]
    except (ValueError, RecursionError, KeyError):  # not TOML, or a number with thousands of digits
        return raw


def merge(layers: Iterable[Mapping[str, JSON]]) -> Table:
    """Overlay tables: later ones take precedence, and sections are merged key by key."""
    result: Table = {}
    for layer in layers:
        for key, value in layer.items():
            below = result.get(key)
            result[key] = merge([below, value]) if isinstance(below, dict) and isinstance(value, Mapping) else value
    return result


def resolve(model: type[Model], layers: Iterable[Mapping[str, JSON]]) -> Model:
    """Merge tables and validate them against the configuration model.

    Raises:
        UsageError: names every wrong key and value, with the nearest known name.
    """
    try:
        return model.model_validate(merge(layers))
    except ValidationError as error:
        problems = [
            _describe(model, ".".join(map(str, problem["loc"])), problem["type"], problem["msg"], problem["input"])
            for problem in _merged_by_option(model, error)
        ]
        raise UsageError(" ".join(problems), hint="`splatpipe options` lists every option with its default.") from error


def _merged_by_option(model: type[BaseModel], error: ValidationError) -> Iterable[dict[str, JSON]]:
    """The problems, with those of an option that accepts several types merged into one."""
    known, found = set(option_names(model)), dict[tuple[JSON, ...], dict[str, JSON]]()
    for problem in error.errors():
        place = problem["loc"]
        while len(place) > 1 and ".".join(map(str, place)) not in known and ".".join(map(str, place[:-1])) in known:
            if problem["type"] == "extra_forbidden":
                break
            place = place[:-1]
        before = found.get(place)
        message = problem["msg"]
        text = message if before is None else f"{before['msg']}, or {message[0].lower()}{message[1:]}"
        found[place] = {**problem, "loc": place, "msg": text}
    return found.values()


def _describe(model: type[BaseModel], dotted: str, kind: str, message: str, value: JSON) -> str:
    if kind == "extra_forbidden":
        close = difflib.get_close_matches(dotted, list(option_names(model)), n=1, cutoff=0.5)
        return f"There is no option {dotted}." + (f" Did you mean {close[0]}?" if close else "")
    return f"{dotted} = {value!r}: {message[0].lower()}{message[1:]}."


def option_names(model: type[BaseModel], prefix: str = "") -> Iterable[str]:
    """Dotted names of all options and sections."""
    for name, info in model.model_fields.items():
        yield prefix + name
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            yield from option_names(info.annotation, f"{prefix}{name}.")


def option_help(model: type[BaseModel]) -> Iterable[tuple[str, str]]:
    """Dotted name and help text of every option."""
    for name, info in model.model_fields.items():
        section = info.annotation
        if isinstance(section, type) and issubclass(section, BaseModel):
            for option, field in section.model_fields.items():
                yield f"{name}.{option}", " ".join((field.description or "").split())


def with_seed(model: type[BaseModel], seed: int) -> Table:
    """A table that sets ``seed`` in every section that has it."""
    return {
        name: {"seed": seed}
        for name, info in model.model_fields.items()
        if isinstance(info.annotation, type) and "seed" in getattr(info.annotation, "model_fields", {})
    }


def lookup(config: BaseModel, dotted: str) -> JSON:
    """The value of ``section.option``."""
    section, _, option = dotted.partition(".")
    return getattr(getattr(config, section), option)


def settings_of(config: BaseModel, stage: Stage) -> tuple[Table, Table]:
    """A stage's own options except those that name files, and the options it borrows by dotted name."""
    section: BaseModel = getattr(config, stage.name)
    own = section.model_dump(mode="json", exclude=set(stage.files))
    return own, {name: lookup(config, name) for name in stage.borrows}


def dump(table: Mapping[str, JSON]) -> str:
    """A table as TOML; options that are None are omitted, since a missing option means None."""

    def without_none(value: JSON) -> JSON:
        if isinstance(value, Mapping):
            return {key: without_none(item) for key, item in value.items() if item is not None}
        return value

    return tomli_w.dumps(without_none(table))
