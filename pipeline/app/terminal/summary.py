"""The end of a command: a summary for people, one JSON object for programs, a message and an exit code for errors."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.app.notice import TIME_LIMIT_S, State, check_command, notify
from splatpipe.pipeline.engine.errors import (
    MachineError,
    SplatpipeError,
    StageError,
    StopSignal,
    card_fault,
    exit_code,
)

if TYPE_CHECKING:
    from splatpipe.pipeline.app.report.verdict import Verdict
    from splatpipe.pipeline.engine.runs.runner import Outcome

PART_VARIABLE = "SPLATPIPE_PART"  # set if further commands run more stages at once: success needs no report yet
STOP_S = 4.0  # after Ctrl-C the report is limited to this: the command promises to end within five seconds

NOTICE_S = 4.7  # and the notification gets what is left of this,
MIN_NOTICE_S = 0.5  # but at least this


class CommandSummary:
    """Reports the success or failure of a command: a summary on stderr, one JSON object for programs."""

    outcome: Outcome | None = None
    writes_report: bool = True  # false for a single shard: others may be running in OUT, and the report covers them all
    details: Mapping[str, Any] | None = None
    result_lines: Sequence[str] = ()
    _report_path: Path | None = None
    _command: str | None = None

    def __init__(self, out: Path, as_json: bool) -> None:
        self._out, self._as_json = out, as_json
        self._started_s = time.monotonic()

    def __enter__(self) -> CommandSummary:
        return self

    def notify_by(self, command: str | None) -> None:
        """Register the user's command, if any, to be called at the end.

        Raises:
            UsageError: if it cannot be called.
        """
        if command is not None:
            check_command(command)
            self._command = command

    def __exit__(self, _kind: Any, error: BaseException | None, _traceback: Any) -> None:
        seconds = time.monotonic() - self._started_s
        if isinstance(error, GeneratorExit | SystemExit):
            return
        step = error is None and PART_VARIABLE in os.environ
        if self.outcome is not None and self.writes_report and not step and not _interrupted_again(error):
            self._report(error)
        if error is None and self.outcome is not None:
            self._show(self.outcome, seconds)
        if self._as_json:
            print_json({**self._as_object(error, seconds), **(self.details or {})})
        if self._command is not None and not _interrupted_again(error):
            self._notify(self._command, error)

    def _notify(self, command: str, error: BaseException | None) -> None:
        """Call the user's command; its problems are reported and do not affect the run."""
        from splatpipe.pipeline.app.terminal.console import print_line

        state: State = "done" if error is None else "failed"
        limit_s = TIME_LIMIT_S
        if isinstance(error, StopSignal | KeyboardInterrupt):
            state = "stopped"
            limit_s = max(MIN_NOTICE_S, getattr(error, "at_s", time.monotonic()) + NOTICE_S - time.monotonic())
        out = self._out.resolve()
        trouble = notify(command, state, out.name, self._report_path and self._report_path.resolve(), out, limit_s)
        if trouble:
            print_line(trouble)

    def _report(self, error: BaseException | None) -> None:
        """Write the report, unless it is there and no stage ran; its problems do not affect the run."""
        from splatpipe.pipeline.app.report import REPORT_FILE, is_current, make_report
        from splatpipe.pipeline.app.terminal.console import print_line
        from splatpipe.pipeline.engine.runs.run_folder import LOG_FILE

        if error is None and self.outcome is not None and not self.outcome.ran and is_current(self._out):
            self._report_path = self._out / REPORT_FILE
            return
        until_s = error.at_s + STOP_S if isinstance(error, StopSignal) else None
        try:
            self._report_path = make_report(self._out, self._out / LOG_FILE, until_s=until_s)
        except SplatpipeError as trouble:
            print_line(f"{trouble.message} {trouble.hint}".strip())

    def _show(self, outcome: Outcome, seconds: float) -> None:
        from splatpipe.pipeline.app.terminal.console import show_accuracy, show_bad_cameras, show_outputs, show_verdict

        if (verdict := _verdict(self._out)) is not None:
            show_verdict(verdict)
        show_accuracy(*_accuracy(outcome))
        took = seconds if outcome.ran or self.result_lines else None
        show_outputs(self._out, took, self._files(outcome), self.result_lines)
        if "sparse" in outcome.artifacts:
            show_bad_cameras(outcome.artifacts["sparse"].summary.get("verdict") or {})

    def _files(self, outcome: Outcome) -> list[Path]:
        from splatpipe.stages.line import LINE

        made = [(stage, outcome.artifacts[stage.name]) for stage in LINE if stage.name in outcome.artifacts]
        files = [self._out / name for stage, artifact in made for name in artifact.deliverables(stage)]
        return [path for path in [*files, *filter(None, [self._report_path])] if path.is_file()]

    def _as_object(self, error: BaseException | None, seconds: float) -> dict[str, Any]:
        outcome = self.outcome
        artifacts = outcome.artifacts if outcome else {}
        return {
            "out": str(self._out),
            "exit_code": exit_code(error),
            "error": None if error is None else {"message": str(error), "hint": getattr(error, "hint", "")},
            "seconds": round(seconds, 3),
            "stages": [
                {
                    "name": name,
                    "state": "ran" if outcome and name in outcome.ran else "reused",
                    "seconds": artifact.manifest["seconds"],
                    "summary": artifact.summary,
                }
                for name, artifact in artifacts.items()
            ],
            "failed": outcome.failed if outcome else "",
            "outputs": [str(path) for path in self._files(outcome)] if outcome else [],
        }


def _interrupted_again(error: BaseException | None) -> bool:
    """Whether the user pressed Ctrl-C again during the shutdown: then nothing is waited for."""
    before = None if error is None else error.__context__
    while before is not None and not isinstance(before, StopSignal):
        before = before.__context__
    return isinstance(error, StopSignal) and before is not None


def _accuracy(outcome: Outcome) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The accuracy report, with the splat's own if measured, and the surveyed points; empty if not computed."""
    from splatpipe.pipeline.engine.files.json_file import read_json

    artifacts = outcome.artifacts.values()
    parts = {name: part.path for artifact in artifacts for name, part in artifact.parts.items()}
    report: dict[str, Any] = {}
    points: list[dict[str, Any]] = []
    with suppress(OSError, ValueError, KeyError, TypeError):  # ``status`` reports damaged files
        if "evaluate.metrics" in parts:
            report = dict(read_json(parts["evaluate.metrics"])["accuracy"])
        elif "georef.accuracy" in parts:
            report = dict(read_json(parts["georef.accuracy"]))
        if "georef.control" in parts:
            points = list(read_json(parts["georef.control"])["points"])
    return report, points


def _verdict(out: Path) -> Verdict | None:
    """The report's verdict; None if the run's record cannot be read, which must not fail the command."""
    from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
    from splatpipe.pipeline.app.report.verdict import judge

    try:
        return judge(read_report_inputs(out))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, SplatpipeError):
        return None


def print_json(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def _is_undecoded(error: UnicodeEncodeError) -> bool:
    """Whether a text has bytes of a file's name that are not of the encoding of names."""
    return any("\udc80" <= sign <= "\udcff" for sign in error.object[error.start : error.end])


def for_the_user(error: Exception) -> SplatpipeError:
    if isinstance(error, SplatpipeError):
        return error
    if isinstance(error, OSError):
        return MachineError(str(error), "Check the free space and the permissions.")
    if isinstance(error, UnicodeEncodeError) and (sys.getfilesystemencoding() != "utf-8" or _is_undecoded(error)):
        return MachineError(
            "A name of a file or folder has letters that this environment cannot write: its encoding is "
            f"{sys.getfilesystemencoding()}.",
            "Unset PYTHONUTF8, or set LC_ALL=C.UTF-8; or rename the file or folder.",
        )
    if (fault := card_fault(error)) is not None:
        return fault
    hint = "Please report it."
    with suppress(OSError):  # a container may have no writable folder for it
        with tempfile.NamedTemporaryFile("w", prefix="splatpipe-", suffix=".log", delete=False) as file:
            traceback.print_exception(error, file=file)
        hint = f"Please report it with {file.name}"
    return StageError(f"Internal error of splatpipe: {type(error).__name__}: {error}", hint)
