"""Writes a batch's state into its folder: `batch.json`, `batch.csv` and `batch.html`, each atomically."""

from __future__ import annotations

import csv
import io
import json
import time
from pathlib import Path

from splatpipe.pipeline.app.batch.pages.page import write_page
from splatpipe.pipeline.app.batch.pages.state import BatchState, CaptureState, as_json
from splatpipe.pipeline.engine.files.durable import write_durably

JSON_FILE, TABLE_FILE, PAGE_FILE = "batch.json", "batch.csv", "batch.html"
FIGURES = ("registered", "gaussians", "psnr", "ssim", "check_rmse_3d_m")
COLUMNS = (
    *("capture", "state", "stage", "progress", "verdict", "level", "reason", "hint", "tries", "earlier", "seconds"),
    *("photos", *FIGURES, "report", "viewer", "as_of"),
)


def publish(state: BatchState, out: Path) -> None:
    """Write all three files.

    Raises:
        OSError: if the disk is full or gone; files that could not be written are unchanged.
        MachineError: if this installation lacks the page's style.
    """
    write_durably(out / JSON_FILE, json.dumps(as_json(state), indent=1) + "\n")
    write_durably(out / TABLE_FILE, table_text(state))
    write_page(state, out / PAGE_FILE)


def table_text(state: BatchState) -> str:
    """The table as CSV, one row per capture; the last column is the time of the state."""
    when = time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(state.as_of_s))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(_row(capture, when) for capture in state.captures)
    return text.getvalue()


def _row(capture: CaptureState, when: str) -> list[str | int | float | None]:
    identity = (capture.name, capture.state, capture.stage, capture.progress, capture.verdict, capture.level)
    outcome = (capture.reason, capture.hint, capture.tries, "; ".join(capture.earlier), capture.seconds, capture.photos)
    figures = [capture.figures.get(name) for name in FIGURES]
    return [_cell(value) for value in (*identity, *outcome, *figures, capture.report, capture.viewer, when)]


def _cell(value: str | int | float | None) -> str | int | float | None:
    """Escape text that a spreadsheet would evaluate as a formula, as a capture's name might be."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t") else value
