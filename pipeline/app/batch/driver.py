"""Runs a batch call: locks the batch's folder, starts Snakemake and the guard, and reports the status to the end."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from splatpipe.pipeline.app.batch.jobs.plan import BATCH_FOLDER, BatchPlan, Call, PlannedCapture
from splatpipe.pipeline.app.batch.jobs.slurm_queue import ASK_INTERVAL_S, store_queue
from splatpipe.pipeline.app.batch.jobs.snakemake_process import (
    Profile,
    end_group,
    last_error_line,
    snakemake_command,
    snakemake_environment,
    start_snakemake,
)
from splatpipe.pipeline.app.batch.jobs.workflow import write_workflow
from splatpipe.pipeline.app.batch.monitor import BatchMonitor
from splatpipe.pipeline.app.batch.pages.publication import PAGE_FILE, publish
from splatpipe.pipeline.app.batch.pages.state import UPDATE_INTERVAL_S, BatchState, CaptureState
from splatpipe.pipeline.app.notice import TIME_LIMIT_S, notify
from splatpipe.pipeline.app.report import REPORT_FILE
from splatpipe.pipeline.app.report.facts.wording import roughly
from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_STAGE, MachineError, StopSignal, UsageError, exit_code
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import own_folder, require_own_files
from splatpipe.pipeline.engine.python_module import python_module
from splatpipe.pipeline.engine.runs.lock import locked
from splatpipe.pipeline.engine.runs.store import write_error
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.stages.line import LINE

POLL_S = 1.0
STOPPED_NOTICE_S = 1.5  # after a signal: the jobs may have taken eight seconds to end, and Docker kills after ten
CHANGE_INTERVAL_S = 5.0  # between progress updates; a capture's change of state is reported at once
LOCK_TIMEOUT_S = 15.0  # a killed call's guard ends its jobs within this time
NAMES_FILE = "captures.json"  # below BATCH_FOLDER: every capture that was ever listed
ENDS = {"done": "done", "failed": "failed", "stopped": "stopped"}


def check_folder(out: Path) -> None:
    """Check that an OUT can be a batch's folder.

    Raises:
        UsageError: if it is a file, or the folder of one run.
    """
    if (out / "stages").exists():
        raise UsageError(f"{out} is the folder of one run.", hint="Choose another OUT for the batch.")
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file.", hint="Name a folder for the results; it is created if missing.")


@contextmanager
def lock_folder(out: Path) -> Iterator[int]:
    """Lock a batch's folder; two concurrent calls would report different states.

    Yields:
        The lock's file descriptor, for the guard to inherit.

    Raises:
        UsageError: if it is not a batch's folder, or another call is working in it.
        MachineError: if it cannot be written.
    """
    check_folder(out)
    _own_folder(out)
    with ExitStack() as stack:
        deadline = time.monotonic() + LOCK_TIMEOUT_S
        while True:
            try:
                held = stack.enter_context(locked(out, folder=BATCH_FOLDER))
                break
            except UsageError:
                if time.monotonic() > deadline:
                    raise
        yield held.descriptors[0]


def fresh_call(out: Path, name: str = "call") -> Call:
    """Create an empty folder for a call; that of an earlier call is deleted.

    Raises:
        UsageError: if it or the folder above it is a link; nothing is deleted then.
        MachineError: if it cannot be made.
    """
    folder = _own_folder(out.resolve()) / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return Call(folder)


def _own_folder(out: Path) -> Path:
    """The folder of the command's own files, made if it is missing.

    Raises:
        UsageError: if it is a link, or has a link or the like.
        MachineError: if it cannot be made.
    """
    try:
        folder = own_folder(out, BATCH_FOLDER)
        require_own_files(folder.iterdir())
    except OSError as error:
        raise write_error(out, error) from error
    return folder


def with_unlisted(plan: BatchPlan) -> BatchPlan:
    """Add to the plan the captures of earlier calls that are no longer listed, and save this call's names."""
    path = Path(plan.out) / BATCH_FOLDER / NAMES_FILE
    known: JSON = []
    with suppress(OSError, ValueError):
        known = read_json(path)
    names = [capture.name for capture in plan.captures]
    unlisted = (
        [name for name in known if name not in names and _is_capture(Path(plan.out), name)]
        if isinstance(known, list)
        else []
    )
    write_durably(path, json.dumps([*names, *unlisted]))
    return replace(plan, unlisted=tuple(unlisted))


def _is_capture(out: Path, name: JSON) -> bool:
    """Whether a name in the batch's own list is that of a run's folder in it; the list may be somebody else's."""
    if not isinstance(name, str) or "\0" in name or name in (".", "..") or Path(name).name != name:
        return False
    return not (out / name).is_symlink() and (out / name / "stages").is_dir()


@dataclass(frozen=True)
class Notifications:
    """Where changes are reported besides the files.

    Attributes:
        print_line: Prints a line on the terminal.
        command: The command of ``--notify``; empty for none.
    """

    print_line: Callable[[str], None]
    command: str = ""


class Driver:
    """Runs a call to completion.

    Args:
        call: The call, whose plan is written already.
        profile: Where Snakemake runs jobs.
        notifications: Where changes are reported.
    """

    def __init__(self, call: Call, profile: Profile, notifications: Notifications) -> None:
        self._call, self._profile, self._notifications = call, profile, notifications
        self._plan = call.plan()
        self._monitor = BatchMonitor(call)
        self._before: dict[str, CaptureState] = {}
        self._published_s = 0.0
        self._asked_s = 0.0
        self._last: BatchState | None = None
        self._unwritten = ""
        self._notice_s = TIME_LIMIT_S

    def run(self, lock: int) -> BatchState:
        """Run the call.

        Args:
            lock: File descriptor of the batch's lock, for the guard.

        Returns:
            The final state.

        Raises:
            SplatpipeError: if the workflow itself could not run; the captures' states are reported correctly anyway.
            StopSignal: if stopped by a signal, once all jobs have ended.
        """
        try:
            self._report(self._monitor.state())
            if any(capture.jobs for capture in self._plan.captures):
                self._work(lock)
            self._call.write_end(time.time(), None, "")
            succeeded = self._monitor.state().all_succeeded
            return self._finish(0 if succeeded else EXIT_INPUT, "")
        except BaseException as error:
            if isinstance(error, StopSignal | KeyboardInterrupt):
                self._notice_s = STOPPED_NOTICE_S
            self._finish(exit_code(error), str(error))
            raise

    def _finish(self, code: int, message: str) -> BatchState:
        with suppress(OSError):  # on a full disk
            self._call.write_end(time.time(), code, message)
        state = self._monitor.state()
        self._report(state)
        self._notify("stopped" if code > 128 else "done" if code == 0 else "failed", state.name, PAGE_FILE)
        return state

    def _work(self, lock: int) -> None:
        write_workflow(self._call, self._plan, LINE)
        with _guarded(self._call, lock) as send:
            process = start_snakemake(self._call, self._plan, self._profile)
            send({"group": process.pid, "local": self._profile.local})
            try:
                while process.poll() is None:
                    self._ask_engine()
                    self._report(self._monitor.state())
                    time.sleep(POLL_S)
            except BaseException:
                self._notifications.print_line(
                    "Stopping the batch: running jobs are asked to stop and keep their progress."
                )
                end_group(
                    self._call, process.pid, local=self._profile.local, has_ended=lambda: process.poll() is not None
                )
                process.wait()
                raise
        self._check(process.returncode)

    def _ask_engine(self) -> None:
        """Ask now and then why jobs are waiting."""
        if self._profile.executor == "slurm" and time.monotonic() - self._asked_s > ASK_INTERVAL_S:
            store_queue(self._call.folder)
            self._asked_s = time.monotonic()

    def _check(self, code: int) -> None:
        """Raise an error if Snakemake failed and no capture's failure explains it."""
        state = self._monitor.state()
        if code == 0 or any(capture.state == "failed" for capture in state.captures):
            over = all(capture.state in ("done", "reused", "failed") for capture in state.captures)
            if over or code == 0:
                return
        raise WorkflowError(code, last_error_line(self._call), self._call.snakemake_log)

    def _report(self, state: BatchState) -> None:
        """Report changes: on the terminal and by notification at once, in the files periodically."""
        changed = [capture for capture in state.captures if _has_changed(self._before.get(capture.name), capture)]
        for capture in changed:
            if capture.state != "waiting":
                self._notifications.print_line(_change_text(capture))
        waited_s = time.time() - self._published_s
        other = self._last is None or replace(state, as_of_s=0.0) != replace(self._last, as_of_s=0.0)
        if changed or not state.at_work or waited_s >= (CHANGE_INTERVAL_S if other else UPDATE_INTERVAL_S):
            self._publish(state)
        for capture in changed if self._notice_s == TIME_LIMIT_S else ():  # after a signal, only for the batch
            before = self._before.get(capture.name)
            if capture.state in ENDS and (before is None or before.state != capture.state):
                self._notify(ENDS[capture.state], capture.name, f"{capture.name}/{REPORT_FILE}")
        self._before = {capture.name: capture for capture in state.captures}

    def _publish(self, state: BatchState) -> None:
        """Write the status files; a full disk is ignored here: the jobs report it, and space may be freed."""
        try:
            publish(state, self._call.out)
            self._unwritten = ""
        except (OSError, MachineError) as error:
            if str(error) != self._unwritten:
                self._unwritten = str(error)
                self._notifications.print_line(f"Cannot write the status of the batch: {error}")
        self._published_s, self._last = time.time(), state

    def _notify(self, state: str, name: str, page: str) -> None:
        if not self._notifications.command:
            return
        path = self._call.out / page
        report = path if path.is_file() else None
        trouble = notify(self._notifications.command, state, name, report, self._call.out, self._notice_s)  # type: ignore[arg-type]
        if trouble:
            self._notifications.print_line(trouble)


class WorkflowError(MachineError):
    """Snakemake failed for a reason other than a capture."""

    exit_code = EXIT_STAGE

    def __init__(self, code: int, last_line: str, log: Path) -> None:
        super().__init__(
            f"Snakemake ended with exit code {code} before the batch had finished. {last_line}".strip(),
            hint=f"Its log has the details: {log}. Repeat the command to resume.",
        )


@contextmanager
def _guarded(call: Call, lock: int) -> Iterator[Callable[[JSON], None]]:
    """Run a guard process for this call.

    Yields:
        A function that sends the guard a message.
    """
    guard = subprocess.Popen(
        python_module("splatpipe.pipeline.app.batch.guard", str(call.folder)),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=(lock,),
        start_new_session=True,
    )
    assert guard.stdin is not None
    pipe = guard.stdin

    def send(message: JSON) -> None:
        with suppress(BrokenPipeError):  # the guard was killed: the batch continues without it
            pipe.write(json.dumps(message).encode() + b"\n")
            pipe.flush()

    try:
        yield send
    finally:
        send({"done": True})
        with suppress(BrokenPipeError):
            pipe.close()
        guard.wait()


def dry_run(call: Call, profile: Profile) -> int:
    """Print on stderr which stages of each capture would run, then Snakemake's own count of jobs by kind.

    Returns:
        Snakemake's exit code.
    """
    plan = call.plan()
    write_workflow(call, plan, LINE)
    sys.stderr.write("".join(f"{plan_text(capture)}\n" for capture in plan.captures))
    sys.stderr.flush()
    command = [*snakemake_command(call, plan, profile), "--dry-run", "--quiet", "rules", "host", "reason"]
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=2, cwd=call.folder, env=snakemake_environment(call), check=False
    )
    return done.returncode


def plan_text(capture: PlannedCapture) -> str:
    """What a capture would run, with the forecast of its working time, in one line."""
    if capture.message:
        return f"{capture.name}: fails before it starts. {capture.message} {capture.hint}".rstrip()
    if not capture.jobs:
        return f"{capture.name}: nothing to do, all stages are valid"
    stages = ", ".join(job.stage for job in capture.jobs)
    return f"{capture.name}: {stages} ({roughly(sum(job.seconds for job in capture.jobs))} forecast)"


def _has_changed(before: CaptureState | None, now: CaptureState) -> bool:
    return before is None or (before.state, before.stage, before.tries) != (now.state, now.stage, now.tries)


def _change_text(capture: CaptureState) -> str:
    """A capture's change of state in one line."""
    where = f" {capture.stage}" if capture.stage and capture.state != "failed" else ""
    again = f" (attempt {capture.tries})" if capture.tries > 1 else ""
    why = " ".join(filter(None, [f"in {capture.stage}:" if capture.stage else "", capture.reason, capture.hint]))
    detail = {"failed": why, "stopped": "", "done": capture.verdict, "reused": capture.verdict}.get(capture.state, "")
    return f"{capture.name}: {capture.state}{where}{again}{'. ' if detail else ''}{detail}"


def summary(states: Sequence[CaptureState]) -> str:
    """The number of captures by outcome, as text."""
    counts = {name: sum(state.state == name for state in states) for name in ("done", "reused", "failed", "stopped")}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)
