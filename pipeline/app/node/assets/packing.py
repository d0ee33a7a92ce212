"""Packs a finished run into `all.zip`, and says what is in it and what is not."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.app.node.assets.archive import Entry, write_archive
from splatpipe.pipeline.app.node.assets.collecting import Contents, collect
from splatpipe.pipeline.app.node.assets.finished_run import open_finished_run
from splatpipe.pipeline.app.node.assets.layout import LOG
from splatpipe.pipeline.app.node.assets.outputs import chosen, unmatched
from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.engine.files.small_file import read_end
from splatpipe.pipeline.engine.files.text_lines import text_lines

MAX_LOG_BYTES = 8 << 20  # the end of a longer log is packed
SPARE_BYTES = 64 << 20  # of the disk: for what else is written meanwhile


@dataclass(frozen=True)
class Packing:
    """What has been packed.

    Attributes:
        size: Bytes of `all.zip`.
        entries: Paths in it, sorted.
        lines: For the task's log: what it lacks and why; the packed log ends with them.
    """

    size: int
    entries: tuple[str, ...]
    lines: tuple[str, ...]


def pack_run(out: Path, target: Path, outputs: Sequence[str] = (), log: Path | None = None) -> Packing:
    """Write `all.zip` of a finished run; it appears whole or not at all, and nothing in OUT changes.

    The same run, outputs and log give the same bytes. A killed call leaves a hidden folder beside the target, which the
    next one removes.

    Args:
        out: OUT of the run.
        target: Output file, outside of OUT.
        outputs: Paths that it is restricted to, from ``parse_outputs``; none for everything.
        log: The task's log so far; None for none.

    Raises:
        UsageError: if there is no run, or one that is running.
        MachineError: if there is no room on the disk.
        OSError: if a file cannot be read or written.
        ValueError: if an artifact of the run is broken.
    """
    run = open_finished_run(out)
    labels = PathLabels.of(run.inputs.out, run.inputs.photos_dir)
    with whole_file(target) as aside:
        contents = collect(run, aside.parent, outputs)
        lines = tuple(" ".join(labels.plain(line).split()) for line in _lines(contents, outputs))
        entries = [contents.entries[name] for name in chosen(contents.entries, outputs)]
        if not outputs or LOG in chosen([LOG], outputs) or _top_level(entries) < 2:  # WebODM unwraps a lone folder
            entries.append(Entry(LOG, _log(log, labels, lines)))
        _require_room(aside.parent, entries)
        write_archive(aside, entries)
        size = aside.stat().st_size
    return Packing(size, tuple(sorted(entry.name for entry in entries)), lines)


def _lines(contents: Contents, outputs: Sequence[str]) -> list[str]:
    missing = unmatched([*contents.entries, LOG], outputs)
    return [
        *contents.lines(),
        *(f"all.zip lacks {path}, which outputs names: the run has no such file." for path in missing),
    ]


def _top_level(entries: Sequence[Entry]) -> int:
    return len({entry.name.partition("/")[0] for entry in entries})


def _log(path: Path | None, labels: PathLabels, lines: Sequence[str]) -> bytes:
    """The task's log without this machine's folders, and the lines of the packing behind it."""
    before = b"" if path is None else read_end(path, MAX_LOG_BYTES)
    said = [labels.plain(line.rstrip()) for line in text_lines(before.decode("utf-8", "replace"))]
    return "".join(f"{line}\n" for line in (*said, *lines)).encode()


def _require_room(folder: Path, entries: Sequence[Entry]) -> None:
    """Check that the archive fits on the disk, compressed or not.

    Raises:
        MachineError: if it does not.
    """
    needed = sum(entry.size for entry in entries) + SPARE_BYTES
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise MachineError(
            f"The results do not fit on the disk: all.zip takes {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free.",
            "Free space, then restart the task: what is computed is kept.",
        )
