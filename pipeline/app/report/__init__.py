"""The report of a run: one page for the client, and a short PDF, built from events and manifests.

`write_report` writes it in this process; `make_report`, which the commands use, in a separate one: an error or crash
there can neither fail a good run nor delay its end, and the command need not load its libraries.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.engine.files.durable import remove_unfinished, write_durably
from splatpipe.pipeline.engine.files.output_file import appended_file
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.engine.heap import imports_outside_gc
from splatpipe.pipeline.engine.python_module import python_module

REPORT_FILE = "report.html"
PDF_FILE = "report.pdf"
RECORD_FILE = Path("stages", "last-report.json")  # what the next report can take over from this one
HEAD_BYTES = 4096  # beginning of the page, which contains the digest of its results
TIMEOUT_S = 600.0  # far more than hundreds of photos take
MIN_S = 2.0  # minimum time granted: enough for the report without images, even on a busy machine
POLL_S = 0.02


def write_report(out: Path, *, drawn: bool = True, anew: bool = False) -> Path:
    """Write OUT/report.html and, with images, OUT/report.pdf, each atomically.

    Args:
        out: The run's folder; the run may be finished, stopped, failed, or still running.
        drawn: Whether to include charts and images; without them there is no PDF.
        anew: Whether to make every chapter, also those that the report in OUT has already.

    Returns:
        The page's path.

    Raises:
        OSError: if it cannot be written.
        MachineError: if this installation lacks the page's script or style.
        RuntimeError: if the PDF cannot be set; the page is there.
    """
    with imports_outside_gc():
        from splatpipe.pipeline.app.report.facts.last_report import LastReport
        from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
        from splatpipe.pipeline.app.report.page import report_content, report_page, run_labels

    inputs = read_report_inputs(out)
    files = out / REPORT_FILE, out / RECORD_FILE
    last = LastReport.read(inputs, *files) if drawn and not anew else LastReport(inputs)
    content = report_content(inputs, drawn=drawn, last=last)
    page = report_page(inputs, content)
    (out / PDF_FILE).unlink(missing_ok=True)  # an earlier run's must not lie beside this page
    write_durably(out / REPORT_FILE, page)
    if drawn and content["geometry_trouble"] is None:
        last.keep(page, *files)
    if drawn:
        from splatpipe.pipeline.app.report.pdf import report_pdf

        pdf = report_pdf(content, run_labels(inputs))
        write_durably(out / PDF_FILE, lambda file: file.write(pdf))
    return out / REPORT_FILE


def is_current(out: Path) -> bool:
    """Whether OUT has the full report of a finished run's present results, so that another would be alike.

    Args:
        out: The run's folder.
    """
    from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs, results_digest

    try:
        with open_regular(out / REPORT_FILE) as file:
            head = file.read(HEAD_BYTES)
        digest = results_digest(read_report_inputs(out))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, SplatpipeError):
        return False
    is_whole = bool(digest) and (out / PDF_FILE).is_file()  # written last
    return is_whole and f'<meta name="splatpipe-results" content="{digest}">'.encode() in head


def make_report(out: Path, log: Path, *, until_s: float | None = None, anew: bool = False) -> Path:
    """Write OUT/report.html and OUT/report.pdf in a separate process.

    Args:
        out: The run's folder.
        log: File for its error output.
        until_s: ``time.monotonic()`` by which it must finish: a page without images is then written first, and kept
            if there is no time for the full one. None: no limit.
        anew: As for ``write_report``.

    Returns:
        The page's path.

    Raises:
        MachineError: if it could not be written.
    """
    flags = ["--hurry"] * (until_s is not None) + ["--anew"] * anew
    command = python_module("splatpipe.pipeline.app.report", str(out), str(os.getpid()), *flags)
    path = out / REPORT_FILE
    before = _stamp(path)
    began_s = time.monotonic()
    end_s = began_s + TIMEOUT_S if until_s is None else until_s

    def over() -> bool:
        now_s = time.monotonic()
        return now_s > end_s and (_stamp(path) != before or now_s > began_s + MIN_S)

    try:
        with appended_file(log) as stream:
            code = _run(command, stream, over, out)
    except OSError as error:
        raise MachineError(f"The report could not be written: {error.strerror}.") from error
    if _stamp(path) == before or (code != 0 and until_s is None):
        what = "The report" if _stamp(path) == before else PDF_FILE
        raise MachineError(f"{what} could not be written.", hint=f"{log} ends with the cause.")
    return path


def _run(command: Sequence[str], log: IO[bytes], over: Callable[[], bool], out: Path) -> int:
    """Run a process to its end or until its time is up; returns its exit code. An interrupted wait also kills it.

    Its unfinished files in OUT are removed; another process may be writing a report there at the same time.
    """
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    try:
        while process.poll() is None and not over():
            time.sleep(POLL_S)
    finally:
        process.kill()
        code = process.wait()
        for path in (out / REPORT_FILE, out / PDF_FILE, out / RECORD_FILE):
            remove_unfinished(path.parent, path.name, process.pid)
    return code


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        info = path.stat()
    except OSError:
        return None
    return info.st_mtime_ns, info.st_ino
