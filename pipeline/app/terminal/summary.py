"""The end of a command: a summary for people, one JSON object for programs, a message and an exit code for errors."""

from __future__ import annotations

import json
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.app.library.commands import Watch, interrupted_again
from splatpipe.pipeline.app.library.user_errors import known_error
from splatpipe.pipeline.app.notice import TIME_LIMIT_S, State, check_command, notify
from splatpipe.pipeline.engine.errors import (
    SplatpipeError,
    StageError,
    StopSignal,
    exit_code,
)

if TYPE_CHECKING:
    from splatpipe.pipeline.app.report.verdict import Verdict
    from splatpipe.pipeline.app.terminal.console import RunConsole
    from splatpipe.pipeline.engine.events import Event
    from splatpipe.pipeline.engine.runs.line import StageStatus
    from splatpipe.pipeline.engine.runs.runner import Outcome

# After Ctrl-C the notification gets what the report leaves of this: the command promises to end within five seconds,
NOTICE_S = 4.7
MIN_NOTICE_S = 0.5  # but at least this


class TerminalWatch(Watch):
    """Shows a command's events and messages on the terminal."""

    def __init__(self) -> None:
        super().__init__()
        self._console: RunConsole | None = None

    def event(self, event: Event) -> None:
        """Show an event: a progress bar, or a line."""
        from splatpipe.pipeline.app.terminal.console import RunConsole

        if self._console is None:
            self._console = RunConsole()
        self._console(event)

    def message(self, text: str) -> None:
        """Print a line."""
        from splatpipe.pipeline.app.terminal.console import print_line

        print_line(text)

    def pause(self) -> None:
        """Remove the progress bar, so that further output starts on its own line."""
        if self._console is not None:
            self._console.close()


class CommandSummary:
    """Reports the success or failure of a command: a summary on stderr, one JSON object for programs.

    Attributes:
        watch: Shows the command's progress on the terminal, and has what came of it.
        details: Further entries of the JSON object.
        result_lines: Results of the command, one line each.
    """

    details: Mapping[str, Any] | None = None
    result_lines: Sequence[str] = ()
    _command: str | None = None

    def __init__(self, out: Path, as_json: bool) -> None:
        self._out, self._as_json = out, as_json
        self.watch = TerminalWatch()
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
        if error is None and self.watch.outcome is not None:
            self._show(self.watch.outcome, seconds)
        if self._as_json:
            print_json({**self._as_object(error, seconds), **(self.details or {})})
        if self._command is not None and not interrupted_again(error):
            self._notify(self._command, error)

    def _notify(self, command: str, error: BaseException | None) -> None:
        """Call the user's command; its problems are reported and do not affect the run."""
        from splatpipe.pipeline.app.terminal.console import print_line

        state: State = "done" if error is None else "failed"
        limit_s = TIME_LIMIT_S
        if isinstance(error, StopSignal | KeyboardInterrupt):
            state = "stopped"
            limit_s = max(MIN_NOTICE_S, getattr(error, "at_s", time.monotonic()) + NOTICE_S - time.monotonic())
        out, report = self._out.resolve(), self.watch.report
        trouble = notify(command, state, out.name, report and report.resolve(), out, limit_s)
        if trouble:
            print_line(trouble)

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
        from splatpipe.pipeline.app.report import PDF_FILE
        from splatpipe.stages.line import LINE

        made = [(stage, outcome.artifacts[stage.name]) for stage in LINE if stage.name in outcome.artifacts]
        files = [self._out / name for stage, artifact in made for name in artifact.deliverables(stage)]
        page = self.watch.report
        reports = [] if page is None else [page, page.with_name(PDF_FILE)]
        return [path for path in [*files, *reports] if path.is_file()]

    def _as_object(self, error: BaseException | None, seconds: float) -> dict[str, Any]:
        outcome = self.watch.outcome
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


def for_the_user(error: Exception) -> SplatpipeError:
    """The error to show; a bug is written to a file of its own, for a report."""
    if (known := known_error(error)) is not None:
        return known
    hint = "Please report it."
    with suppress(OSError):  # a container may have no writable folder for it
        with tempfile.NamedTemporaryFile("w", prefix="splatpipe-", suffix=".log", delete=False) as file:
            traceback.print_exception(error, file=file)
        hint = f"Please report it with {file.name}"
    return StageError(f"Internal error of splatpipe: {type(error).__name__}: {error}", hint)


def status_as_json(status: StageStatus) -> dict[str, Any]:
    """The status of a stage and of its shards, for ``status --json``."""
    from splatpipe.pipeline.engine.runs.needs import used_and_forecast

    artifact = status.artifact
    return {
        "name": status.stage.name,
        "state": status.state,
        "reason": status.reason,
        "seconds": artifact.manifest["seconds"] if artifact else None,
        "summary": artifact.summary if artifact else None,
        **(used_and_forecast(artifact.manifest) if artifact else {}),
        **({"shards": [status_as_json(shard) for shard in status.shards]} if status.shards else {}),
    }
