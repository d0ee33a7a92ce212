"""Reads the captures of a batch: a folder of folders, or a list in TOML or CSV with options for each."""

from __future__ import annotations

import csv
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.config import Table, load_file, merge, parse_set, parse_toml
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.quantities import parse_bytes, parse_duration
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.files.names import is_photo
from splatpipe.pipeline.survey.files.survey_text import TableKind, delimiter_of, read_lines, written_lines
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig

MAX_CAPTURES = 2000  # in a list: years of flights; with more, a folder was named by mistake
MAX_NAME = 100  # characters: with our suffixes still a valid file name everywhere
MAX_LIST_BYTES = 4 << 20
OWN_NAMES = ("batch.html", "batch.csv", "batch.json")
KEYS = ("name", "photos", "preset", "config", "time_budget", "max_memory", "set")
CSV_KIND = TableKind(
    "list of captures",
    "Its first line names the columns: photos, and if wanted name, preset, config, time_budget, max_memory, and "
    "options such as train.iterations.",
    MAX_LIST_BYTES,
    MAX_CAPTURES + 100,
)
TOML_HINT = 'Write a table [[capture]] for each, with photos = "folder" and, if wanted, name, preset, config, set.'


@dataclass(frozen=True)
class ListedCapture:
    """A capture as listed.

    Attributes:
        name: Name of its results folder.
        photos: Its photo folder.
        preset: Its preset's name; empty for the command's.
        tables: Option tables; later ones override earlier ones, the preset's and the command's.
        trouble: What is wrong with its options; only this capture then fails.
    """

    name: str
    photos: Path
    preset: str = ""
    tables: tuple[Table, ...] = ()
    trouble: SplatpipeError | None = None


def read_captures(captures: Path, out: Path) -> tuple[ListedCapture, ...]:
    """Read the captures of a batch, in the order of the list or sorted by name.

    Args:
        captures: A folder of photo folders, or a ``.toml`` or ``.csv`` list.
        out: The batch's folder, which is not treated as a capture.

    Raises:
        UsageError: if it is neither, has no captures, or has duplicate names.
    """
    path = captures.expanduser().resolve()
    if path.is_dir():
        found = _of_folder(path, out.expanduser().resolve())
    elif not path.exists():
        raise UsageError(f"There is no {captures}.", hint="Name a folder of capture folders, or a list (.toml, .csv).")
    elif path.suffix.casefold() == ".toml":
        found = [_entry(table, path.parent, {}) for table in _of_toml(path)]
    elif path.suffix.casefold() == ".csv":
        found = [_entry(row, path.parent, options) for row, options in _of_csv(path)]
    else:
        raise UsageError(
            f"{captures} is neither a folder nor a list of captures.", hint="A list's name ends in .toml or .csv."
        )
    if not found:
        raise UsageError(
            f"{captures} contains no captures.", hint="Put each capture's photos into a folder of its own."
        )
    _check_names(found, captures)
    _check_places(found, out.expanduser().resolve())
    return tuple(found)


def _of_folder(folder: Path, out: Path) -> list[ListedCapture]:
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise UsageError(
            f"The folder {folder} cannot be read: {error.strerror}.", hint="Check its permissions."
        ) from error
    if out == folder:
        raise UsageError(f"{out} is the folder of the captures.", hint="Choose an OUT beside it.")
    folders = [
        entry for entry in entries if entry.is_dir() and not entry.name.startswith(".") and entry.resolve() != out
    ]
    if not folders and any(map(is_photo, entries)):
        raise UsageError(
            f"{folder} has the photos of one capture.",
            hint=f"Name the folder above it, or run this one alone: splatpipe run {folder} OUT",
        )
    return [ListedCapture(entry.name, entry) for entry in folders]


def _of_toml(path: Path) -> list[Mapping[str, JSON]]:
    """The captures' tables, each overlaid on the defaults for all."""
    name = f"The list of captures {path.name}"
    try:
        table = parse_toml(read_small(path, MAX_LIST_BYTES))
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, or a number with thousands of digits
        raise UsageError(f"{name} is not valid TOML: {error}.", hint=TOML_HINT) from error
    except OSError as error:
        raise UsageError(f"{name} cannot be read: {error.strerror}.", hint="Check its permissions.") from error
    captures = table.pop("capture", [])
    if not isinstance(captures, list) or not all(isinstance(each, Mapping) for each in captures):
        raise UsageError(f"{name} has no tables [[capture]].", hint=TOML_HINT)
    for_all = _validate(table, name, ("preset", "config", "time_budget", "max_memory", "set"))
    own = [_validate(each, f"Capture {at} of {path.name}", KEYS) for at, each in enumerate(captures, 1)]
    return [{**for_all, **each, "set": [*for_all.get("set", []), *each.get("set", [])]} for each in own]


def _validate(table: Mapping[str, JSON], where: str, keys: Sequence[str]) -> dict[str, JSON]:
    """Validate a table's keys and value types."""
    result = dict(table)
    for key, value in result.items():
        if key not in keys:
            raise UsageError(f'{where}: there is no "{key}" here.', hint=f"Known are {', '.join(keys)}.")
        if key == "set" and isinstance(value, str):
            result[key] = [value]
        elif key == "set" and not (isinstance(value, list) and all(isinstance(text, str) for text in value)):
            raise UsageError(f"{where}: set is not a list of strings.", hint='Write set = ["train.iterations=3000"].')
        elif key != "set" and not isinstance(value, str):
            raise UsageError(f"{where}: {key} is not a string.", hint=f'Write {key} = "…".')
    return result


def _of_csv(path: Path) -> Iterator[tuple[Mapping[str, JSON], Mapping[str, str]]]:
    """Yield each row by our column names, and the options that have their own columns."""
    try:
        lines = written_lines(read_lines(path, CSV_KIND), path, CSV_KIND)
        rows = list(csv.reader([line for _, line in lines], delimiter=delimiter_of(lines[0][1]), strict=True))
    except SplatpipeError as error:
        raise UsageError(error.message, hint=error.hint) from error
    except csv.Error as error:
        raise UsageError(
            f"The list of captures {path.name} is not valid CSV: {error}.", hint=CSV_KIND.expected
        ) from error
    titles = [title.strip() if "." in title else title.strip().casefold().replace(" ", "_") for title in rows[0]]
    unknown = [title for title in titles if "." not in title and (title not in KEYS or title == "set")]
    if unknown or "photos" not in titles or len(set(titles)) < len(titles):
        what = f'has an unknown column "{unknown[0]}"' if unknown else "has a duplicate column, or no photos column"
        raise UsageError(f"The list of captures {path.name} {what}.", hint=CSV_KIND.expected)
    for (number, _), row in zip(lines[1:], rows[1:], strict=False):
        if len(row) > len(titles):
            raise UsageError(f"Line {number} of {path.name} has more cells than there are columns.", CSV_KIND.expected)
        cells = {title: cell.strip() for title, cell in zip(titles, row, strict=False) if cell.strip()}
        yield (
            {key: value for key, value in cells.items() if key in KEYS},
            {key: value for key, value in cells.items() if key not in KEYS},
        )


def _entry(entry: Mapping[str, JSON], folder: Path, options: Mapping[str, str]) -> ListedCapture:
    """Build a capture from its row or table; paths are relative to the list's folder."""
    if not entry.get("photos"):
        raise UsageError("A capture in the list has no photos.", hint="Set photos to its folder.")
    try:
        photos = _below(folder, str(entry["photos"]))
    except SplatpipeError as error:
        raise UsageError(error.message, hint=error.hint) from error
    name = str(entry.get("name") or photos.resolve().name)
    preset = str(entry.get("preset", ""))
    try:
        return ListedCapture(name, photos, preset, tuple(_tables(entry, folder, options)))
    except SplatpipeError as error:
        return ListedCapture(name, photos, preset, trouble=error)


def _tables(entry: Mapping[str, JSON], folder: Path, options: Mapping[str, str]) -> Iterator[Table]:
    if entry.get("config"):
        table = load_file(_below(folder, str(entry["config"])))
        table.pop("photos", None), table.pop("splatpipe", None)
        yield with_files_from(folder, table)
    if entry.get("time_budget"):
        yield {"train": {"time_budget_s": parse_duration(str(entry["time_budget"]), "time_budget")}}
    if entry.get("max_memory"):
        yield {"train": {"max_memory_bytes": parse_bytes(str(entry["max_memory"]), "max_memory")}}
    assignments = [*entry.get("set", []), *(f"{name}={value}" for name, value in options.items())]
    yield with_files_from(folder, merge(parse_set(text, LineConfig) for text in assignments))


def _below(folder: Path, text: str) -> Path:
    """Resolve a path relative to a folder.

    Raises:
        SplatpipeError: if it is not a valid path.
    """
    try:
        if "\0" in text:
            raise ValueError("a NUL")
        return folder / Path(text).expanduser()
    except (ValueError, RuntimeError) as error:  # ~nobody, or ~ without HOME
        raise SplatpipeError(
            f"{text!r} cannot be expanded to a path on this machine.", "Write the full path, without ~."
        ) from error


def with_files_from(folder: Path, table: Table) -> Table:
    """Make the file paths in options absolute; relative ones are relative to the given folder."""
    files = {(stage.name, option) for stage in LINE for option in stage.files}
    result = merge([table])
    for section, option in files:
        value = result.get(section, {}).get(option) if isinstance(result.get(section), Mapping) else None
        if isinstance(value, str) and value not in ("auto", "none"):
            result = merge([result, {section: {option: str(_below(folder, value))}}])
    return result


def _check_places(captures: Sequence[ListedCapture], out: Path) -> None:
    """Check that no capture's results lie among another's photos, where its images would be mistaken for photos."""
    around = {out, *out.parents}
    for capture in captures:
        if capture.photos.resolve() in around:
            raise UsageError(
                f'OUT lies inside the photos of the capture "{capture.name}".',
                hint="Choose an OUT beside the photos, not among them.",
            )


def _check_names(captures: Sequence[ListedCapture], listed: Path) -> None:
    """Check that each name is a valid, unique folder name on any file system."""
    if len(captures) > MAX_CAPTURES:
        raise UsageError(f"{listed} has {len(captures):,} captures.", hint=f"A batch takes at most {MAX_CAPTURES:,}.")
    seen: set[str] = set()
    for name in (capture.name for capture in captures):
        bad = not name.isprintable() or set(name) & set('/\\:*?"<>|') or name.startswith(".") or name != name.strip()
        if bad or not name or len(name) > MAX_NAME or name.casefold() in OWN_NAMES:
            raise UsageError(
                f"{name[:MAX_NAME]!r} cannot be used as the name of a results folder.",
                hint="Rename the capture's folder, or give the capture another name in a list.",
            )
        plain = unicodedata.normalize("NFC", name).casefold()  # some file systems equate both forms of é
        if plain in seen:
            raise UsageError(f'Two captures are called "{name}".', hint="Give one of them another name in a list.")
        seen.add(plain)
