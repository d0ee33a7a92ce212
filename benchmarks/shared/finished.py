"""Figures of finished pipeline runs, kept in a work folder so that no run is repeated."""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from commands import CommandEnd
from tables import Row

from splatpipe.pipeline.engine.errors import UsageError

METRICS = "metrics.json"


class ResultLog:
    """Rows by key, one JSON line each in `results.jsonl`; a line truncated by a crash is skipped.

    Args:
        work: The work folder.
    """

    def __init__(self, work: Path) -> None:
        self._path = work / "results.jsonl"
        self.rows: dict[str, Row] = {}
        text = self._path.read_bytes() if self._path.is_file() else b""
        for line in text.split(b"\n"):
            with contextlib.suppress(ValueError, KeyError, TypeError):
                found = json.loads(line)
                self.rows[str(found["key"])] = dict(found["row"])
        self._cut_off = bool(text) and not text.endswith(b"\n")

    def add(self, key: str, row: Row) -> None:
        """Store a row permanently: one write, flushed to disk before this returns."""
        line = json.dumps({"key": key, "row": row}, allow_nan=False).encode() + b"\n"
        with self._path.open("ab", buffering=0) as file:
            file.write(b"\n" + line if self._cut_off else line)
            os.fsync(file.fileno())
        self._cut_off = False
        self.rows[key] = row


def clear(out: Path) -> None:
    """Remove the output of an unfinished run: its figures would not include the time already spent."""
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(out)


def tidy(out: Path) -> None:
    """Keep only `metrics.json` of a run's `out/`, beside its log."""
    with contextlib.suppress(FileNotFoundError):
        (out / "out" / METRICS).replace(out / METRICS)
    clear(out / "out")


def figures(out: Path, end: CommandEnd, threads: int) -> Row:
    """Collect the figures of a run's OUT: every number of `metrics.json`, nested ones under dotted names.

    Args:
        out: The run's OUT.
        end: How its command ended.
        threads: Threads that it had.
    """
    metrics = dict(_numbers("", json.loads((out / METRICS).read_text(encoding="utf-8"))))
    row: Row = {
        "gaussians": metrics.pop("gaussians"),
        "megapixels": metrics.pop("train_megapixels"),
        "threads": threads,
    }
    row |= {
        "wall_s": round(end.wall_s, 3),
        "cpu_s": round(end.cpu_s, 3),
        "peak_bytes": metrics.pop("peak_memory_bytes"),
    }
    return row | metrics | {"loss": _last_loss(out)}


def best_and_end(path: Path) -> Row:
    """Return the highest held-out PSNR of a followed training, and how far below it the end is, dB."""
    curve = [row["psnr"] for row in json.loads(path.read_text(encoding="utf-8"))["rows"]]
    return {"best_psnr": max(curve), "below_best": max(curve) - curve[-1]}


def _numbers(prefix: str, table: dict[str, Any]) -> Iterator[tuple[str, float]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _numbers(f"{prefix}{key}.", value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{prefix}{key}", value


def _last_loss(out: Path) -> float | None:
    """Return the last loss of the training curve, if there is one."""
    for path in (out / "stages").glob("train-*/history.json"):
        curve = json.loads(path.read_text(encoding="utf-8"))["curve"]
        return float(curve[-1]["loss"]) if curve and math.isfinite(curve[-1]["loss"]) else None
    return None


@contextlib.contextmanager
def work_folder(wanted: Path | None) -> Iterator[Path]:
    """Yield the work folder, locked for this process; a new temporary one if none is given.

    Raises:
        UsageError: if another process uses the folder.
    """
    folder = wanted.resolve() if wanted is not None else Path(tempfile.mkdtemp(prefix="splatpipe-ablation-"))
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                f"Another run works in {folder}.", hint="Wait for it, or choose another --work."
            ) from error
        yield folder
