"""Variants of the pipeline's configuration: named options on top of a base, validated before anything runs."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from comparison import BASE

from splatpipe.pipeline.engine.config import load_file, load_preset, parse_set, resolve, with_seed
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.stages.options import LineConfig

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,63}")  # also a folder's name
PRESET = "standard"  # default of `splatpipe run` without --preset
# Common to all variants: the dataset that they train on, and what they are measured against.
SHARED = ("features.", "matches.", "sparse.", "undistort.max_megapixels", "split.every", "split.views")


@dataclass(frozen=True)
class Variant:
    """A technique to be compared.

    Attributes:
        name: Its name.
        sets: ``SECTION.OPTION=VALUE``, on top of the base's.
        what: What it does, in a line.
    """

    name: str
    sets: tuple[str, ...] = ()
    what: str = ""


def choose(file: Path, extra: Sequence[str], only: Sequence[str] | None, base: Sequence[str]) -> list[Variant]:
    """Return the base and the selected variants, their options validated by the pipeline's configuration.

    Args:
        file: TOML file with variants.
        extra: Further variants, each ``NAME=SECTION.OPTION=VALUE …``.
        only: Names to select; None for all.
        base: Options shared by all.

    Raises:
        UsageError: names the variant and what is wrong with it.
    """
    found = {variant.name: variant for variant in read(file)}
    for text in extra:
        name, _, sets = text.partition("=")
        found[name] = checked_name(Variant(name, split(sets), "--variant"))
    if only is not None:
        if unknown := sorted({*only} - {*found, BASE}):
            raise UsageError(f"There is no variant {', '.join(unknown)}.", hint=f"There are: {', '.join(found)}.")
        found = {name: variant for name, variant in found.items() if name in only}
    chosen = [Variant(BASE, (), "the base alone"), *found.values()]
    for variant in chosen:
        try:
            check(variant, [*base, *variant.sets])
        except UsageError as error:
            raise UsageError(f"Variant {variant.name}: {error.message}", error.hint) from error
    return chosen


def base_of(path: Path) -> tuple[str, ...]:
    """Read the options of the table ``base`` of a TOML file of variants: shared by all of them and the base.

    Raises:
        UsageError: as ``read``.
    """
    return next((variant.sets for variant in tables_of(path) if variant.name == BASE), ())


def read(path: Path) -> list[Variant]:
    """Read variants from a TOML file: a table each, with ``set`` and ``what``.

    Raises:
        UsageError: if the file is invalid.
    """
    return [checked_name(variant) for variant in tables_of(path) if variant.name != BASE]


def tables_of(path: Path) -> list[Variant]:
    """Read all tables of the file, including the base's; names are not validated."""
    found = []
    for name, table in load_file(path).items():
        sets = table.get("set") if isinstance(table, dict) else None
        if not isinstance(sets, list) or not all(isinstance(each, str) for each in sets) or {*table} - {"set", "what"}:
            raise UsageError(
                f"{path}: the variant {name} is not understood.",
                hint=f'Write it as [{name}], and below it set = ["train.antialias=true"] and what = "a line".',
            )
        found.append(Variant(name, tuple(sets), str(table.get("what", ""))))
    return found


def checked_name(variant: Variant) -> Variant:
    """Return the variant if its name is valid.

    Raises:
        UsageError: if its name cannot be a folder's, or is the base's.
    """
    if variant.name == BASE or not NAME.fullmatch(variant.name):
        raise UsageError(
            f'"{variant.name}" cannot be a variant\'s name.', hint=f"Use letters, digits and _.+-; {BASE} is taken."
        )
    return variant


def check(variant: Variant, sets: Sequence[str]) -> None:
    """Reject options that the pipeline does not know, that change nothing, or that do not change only the variant.

    Raises:
        UsageError: says which.
    """
    if config_of(sets, 1).train.seed != 1:
        raise UsageError("train.seed is not a variant's.", hint="Say how many with --seeds.")
    for each in variant.sets:
        if each.partition("=")[0].strip().startswith(SHARED):
            raise UsageError(f"{each} would not act on this variant alone.", hint="Give it to all with --base.")


def split(text: str) -> tuple[str, ...]:
    """Split assignments at blanks; quotes keep blanks.

    Raises:
        UsageError: if a quote is not closed.
    """
    try:
        return tuple(shlex.split(text))
    except ValueError as error:
        raise UsageError(f"Cannot understand {text!r}: {error}.", hint='Write "train.NAME=VALUE …".') from error


def config_of(sets: Sequence[str], seed: int) -> LineConfig:
    """Return the complete configuration of a run, as ``splatpipe run`` resolves it."""
    assigned = [parse_set(each, LineConfig) for each in sets]
    return resolve(LineConfig, [load_preset(PRESET), with_seed(LineConfig, seed), *assigned])
