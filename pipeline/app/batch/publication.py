"""Writes where a batch stands into its folder: `batch.json`, `batch.csv` and `batch.html`, each whole or as before."""

from __future__ import annotations

import csv
import io
import json
import time
from pathlib import Path

from splatpipe.pipeline.app.batch.page import write_page
from splatpipe.pipeline.app.batch.state import BatchState, CaptureState, as_json
from splatpipe.pipeline.engine.durable import write_durably

JSON_FILE, TABLE_FILE, PAGE_FILE = "batch.json", "batch.csv", "batch.html"
FIGURES = ("registered", "gaussians", "psnr", "ssim", "check_rmse_3d_m")
COLUMNS = (
    *("capture", "state", "stage", "progress", "verdict", "level", "reason", "hint", "tries", "earlier", "seconds"),
    *("photos", *FIGURES, "report", "viewer", "as_of"),
)


def publish(state: BatchState, out: Path) -> None:
    """Write all three.

    Raises:
        OSError: if the disk is full or gone; what could not be written is as it was.
        MachineError: if this installation lacks the page's style.
    """
    write_durably(out / JSON_FILE, json.dumps(as_json(state), indent=1) + "\n")
    write_durably(out / TABLE_FILE, table_text(state))
    write_page(state, out / PAGE_FILE)


def table_text(state: BatchState) -> str:
    """A row a capture; the last column says when that was so."""
    when = time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(state.as_of_s))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(_row(capture, when) for capture in state.captures)
    return text.getvalue()


def _row(capture: CaptureState, when: str) -> list[str | int | float | None]:
    told = (capture.name, capture.state, capture.stage, capture.progress, capture.verdict, capture.level)
    why = (capture.reason, capture.hint, capture.tries, "; ".join(capture.earlier), capture.seconds, capture.photos)
    figures = [capture.figures.get(name) for name in FIGURES]
    return [_cell(value) for value in (*told, *why, *figures, capture.report, capture.viewer, when)]


def _cell(value: str | int | float | None) -> str | int | float | None:
    """Spreadsheets calculate a text that begins like a formula; a capture's name may."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t") else value
