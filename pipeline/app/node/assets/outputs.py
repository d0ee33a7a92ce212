"""The field `outputs` of a task: which paths `all.zip` contains instead of everything. Light to import."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from splatpipe.pipeline.app.node.assets.layout import is_safe
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.files.json_file import parse_json

MAX_BYTES = 1 << 18
MAX_PATHS = 1000
HINT = 'Give paths inside of all.zip, as in ["odm_orthophoto/odm_orthophoto.tif", "odm_dem"].'


def parse_outputs(text: str) -> tuple[str, ...]:
    """The paths in a JSON array, without slashes at their ends.

    Args:
        text: The field; if it is empty, so is the result, and all.zip has everything.

    Raises:
        UsageError: if it is not an array of relative paths that stay inside of all.zip.
    """
    if not text.strip():
        return ()
    data = text.encode("utf-8", "surrogatepass")
    if len(data) > MAX_BYTES:
        raise UsageError("outputs is too long.", hint=HINT)
    try:
        value = parse_json(data)
    except ValueError as error:
        raise UsageError(f"outputs is not JSON: {error}.", hint=HINT) from error
    if not isinstance(value, list) or len(value) > MAX_PATHS or not all(isinstance(each, str) for each in value):
        raise UsageError(f"outputs is not an array of at most {MAX_PATHS:,} paths.", hint=HINT)
    paths = tuple(dict.fromkeys(each.removesuffix("/") for each in value))
    for path in paths:
        if not is_safe(path):
            raise UsageError(f"outputs has a path that leads out of all.zip: {path[:60]!a}.", hint=HINT)
    return paths


def chosen(entries: Iterable[str], outputs: Sequence[str]) -> list[str]:
    """The entries that are one of the paths, or below one; all if there are no paths."""
    if not outputs:
        return list(entries)
    wanted = set(outputs)
    return [entry for entry in entries if not wanted.isdisjoint(_with_parents(entry))]


def unmatched(entries: Iterable[str], outputs: Sequence[str]) -> list[str]:
    """The paths that no entry is, or is below of."""
    there = {path for entry in entries for path in _with_parents(entry)}
    return [path for path in outputs if path not in there]


def _with_parents(entry: str) -> list[str]:
    names = entry.split("/")
    return ["/".join(names[:count]) for count in range(1, len(names) + 1)]
