"""The process of a workflow job: runs its stages of one capture by one `splatpipe run --until`, or one shard.

    python -m splatpipe.pipeline.app.batch.jobs.job CALL CAPTURE JOB THREADS MARKER ATTEMPT

It sits between Snakemake and the run so that every outcome is recorded, a capture that cannot succeed is not retried,
and a signal reaches the run exactly once, whoever sent it to which process.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from splatpipe.pipeline.app.batch.jobs.attempts import (
    PERMANENT_FAILURES,
    AttemptLog,
    AttemptResult,
    read_attempts,
    spent_s,
)
from splatpipe.pipeline.app.batch.jobs.plan import BatchPlan, Call, PlannedCapture, StageJob, workflow_jobs
from splatpipe.pipeline.app.batch.jobs.shards import counts_shards, store_shard_jobs
from splatpipe.pipeline.app.library.commands import PART_VARIABLE
from splatpipe.pipeline.app.library.requests import IN_TURN_VARIABLE, SPENT_VARIABLE
from splatpipe.pipeline.app.report.facts.run_history import read_history
from splatpipe.pipeline.engine.errors import EXIT_MACHINE, EXIT_STAGE, EXIT_TERMINATED
from splatpipe.pipeline.engine.files.output_file import appended_file, write_file
from splatpipe.pipeline.engine.python_module import python_module
from splatpipe.pipeline.engine.runs.children import PR_SET_PDEATHSIG
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE, shard_events
from splatpipe.pipeline.engine.stage import JSON, stage_name
from splatpipe.stages.line import LINE

SPLATPIPE = tuple(python_module("splatpipe.pipeline.app.cli.main"))
FOLLOW_S = 0.5
RESERVE_BYTES = 256 << 20  # disk space kept free for what other captures' stages write meanwhile


def main() -> None:
    """Run the job given on the command line."""
    end_with_parent()
    call = Call(Path(sys.argv[1]))
    key, name, threads, marker, number = sys.argv[2], sys.argv[3], int(sys.argv[4]), Path(sys.argv[5]), int(sys.argv[6])
    capture = call.plan().capture(key)
    log = AttemptLog(call.attempts_file(key, name))
    stages = workflow_jobs(call.jobs(capture))[name]
    before = {each.stage: each for each in log.read()}
    left = [stage for stage in stages if stage.stage not in before or not before[stage.stage].succeeded]
    if left:
        earlier = before.get(left[0].stage)
        if earlier is not None and earlier.final:
            sys.exit(earlier.exit_code)
        signals = _Signals()
        if call.stop_file.exists():
            sys.exit(EXIT_TERMINATED)
        progress = _StageProgress(log, [stage.stage for stage in left], number)
        ending = _disk_shortage(call.out, left) or _run(call, capture, left[-1], threads, signals, progress)
        progress.end(ending)
        if ending.exit_code:
            sys.exit(ending.exit_code)
    if counts_shards(name, LINE):
        store_shard_jobs(call, key, threads)
    marker.parent.mkdir(parents=True, exist_ok=True)
    write_file(marker, "")


class _StageProgress:
    """Records the attempts at a job's stages, as the events of its one command tell them, one after the other.

    Args:
        log: The log of the attempts; the first one begins now.
        stages: The stages that the command will run.
        number: Snakemake's number of the attempt.
    """

    def __init__(self, log: AttemptLog, stages: Sequence[str], number: int) -> None:
        self._log, self._left, self._number = log, list(stages), number
        self._over = threading.Event()
        self._log.begin(self._left[0], number)

    @contextmanager
    def following(self, events: Path) -> Iterator[None]:
        """Follow the events that a command appends to a file."""
        if len(self._left) == 1:
            yield
            return
        offset = events.stat().st_size if events.exists() else 0
        follower = threading.Thread(target=self._follow, args=(events, offset))
        follower.start()
        try:
            yield
        finally:
            self._over.set()
            follower.join()

    def end(self, ending: AttemptResult) -> None:
        """Record the end of the command: of all its stages if it succeeded, else of the one that was running."""
        self._log.end(ending)
        for stage in self._left[1:] if ending.exit_code == 0 else ():
            self._log.begin(stage, self._number)
            self._log.end(ending)

    def _follow(self, events: Path, offset: int) -> None:
        with suppress(OSError, ValueError, KeyError):  # a disk that is full or gone: the command itself reports it
            while True:
                over = self._over.wait(FOLLOW_S)
                if events.exists():
                    with events.open("rb") as file:
                        file.seek(offset)
                        whole = file.read().rpartition(b"\n")[0]
                    offset += len(whole) + 1 if whole else 0
                    for line in whole.splitlines():
                        self._take(line)
                if over:
                    return

    def _take(self, line: bytes) -> None:
        event = json.loads(line)
        if event["kind"] == "stage_started" and event["stage"] in self._left[1:]:
            while self._left[0] != event["stage"]:  # those between were reused
                self._log.end(AttemptResult(0))
                self._left.pop(0)
                self._log.begin(self._left[0], self._number)


def _disk_shortage(out: Path, stages: Sequence[StageJob]) -> AttemptResult | None:
    """The failure if the stages must not start, e.g. for lack of disk space; None if they may."""
    free = shutil.disk_usage(out).free
    needed = (sum(stage.disk_bytes for stage in stages) + RESERVE_BYTES) / 1e9
    if free >= 1e9 * needed:
        return None
    what = f"the stage {stages[0].stage} needs" if len(stages) == 1 else f"the stages to {stages[-1].stage} need"
    return AttemptResult(
        EXIT_MACHINE,
        f"The disk has {free / 1e9:.1f} GB free, and {what} about {needed:.1f}.",
        "Make room, then repeat the command: finished work is kept.",
        final=True,
    )


def _run(
    call: Call, capture: PlannedCapture, job: StageJob, threads: int, signals: _Signals, progress: _StageProgress
) -> AttemptResult:
    """Run the command of a job's last stage, which runs those before it as well."""
    plan = call.plan()
    log = call.log(capture.name, job.stage)
    log.parent.mkdir(parents=True, exist_ok=True)
    spent = spent_s(read_attempts(call.attempts_files(capture.key)))
    last = job.stage == capture.jobs[-1].stage
    with appended_file(log) as log_file:
        process = subprocess.Popen(
            command_of(call, plan, capture, job, threads),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=log_file,
            env={
                **os.environ,
                IN_TURN_VARIABLE: "1",
                SPENT_VARIABLE: f"{spent:.3f}",
                **({} if last else {PART_VARIABLE: "1"}),
            },
            start_new_session=True,
            preexec_fn=end_with_parent,  # noqa: PLW1509 (one thread)
        )
    signals.forward_to(process)
    out = Path(plan.out) / capture.name
    shard = job.stage != stage_name(job.stage)
    events = shard_events(out, job.stage) if shard else out / EVENTS_FILE
    with progress.following(events):
        output, _ = process.communicate()
    return _ending(process.returncode, output, events)


def command_of(call: Call, plan: BatchPlan, capture: PlannedCapture, job: StageJob, threads: int) -> list[str]:
    """The `splatpipe run` command of a job, or for a shard the `splatpipe stage` command.

    The last stage's command runs the whole pipeline, so that export, which the film's stage does not need, is reported
    too. A shard uses the options that the preceding run saved in its OUT.
    """
    out = str(Path(plan.out) / capture.name)
    stage, _, shard = job.stage.partition(".")
    if shard:
        machine = ["--device", plan.device, "--threads", str(threads)]
        return [*SPLATPIPE, "stage", stage, out, "--shard", shard, *machine, "--json"]
    until = plan.until if job.stage == capture.jobs[-1].stage else stage
    options = {
        "--preset": capture.preset,
        "--config": str(call.config_file(capture.key)),
        "--device": plan.device,
        "--threads": str(threads),
        **({"--until": until} if until else {}),
    }
    words = [word for option in options.items() for word in option]
    return [*SPLATPIPE, "run", capture.photos, out, *words, "--json"]


def end_with_parent() -> None:
    """Arrange that the run ends if its parent is killed: it is asked to stop, and keeps its checkpoint."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


class _Signals:
    """Signals to end, forwarded once to the stage's process: a second one would keep it from writing its report."""

    def __init__(self) -> None:
        self.received = False
        self._process: subprocess.Popen[bytes] | None = None
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._forward)

    def forward_to(self, process: subprocess.Popen[bytes]) -> None:
        """Forward to this process, also a signal that came before it was known."""
        self._process = process
        if self.received:
            process.send_signal(signal.SIGTERM)

    def _forward(self, _number: int, _frame: FrameType | None) -> None:
        if not self.received and self._process is not None:
            self._process.send_signal(signal.SIGTERM)
        self.received = True


def _ending(code: int, output: bytes, events: Path) -> AttemptResult:
    if code < 0:
        name = signal.Signals(-code).name
        hint = "See the end of its log; SIGKILL usually means that memory ran out."
        return AttemptResult(128 - code, f"The command was killed by {name}.", hint)
    if code == 0:
        return AttemptResult(0)
    error = _error_of(output)
    message = str(error.get("message", "")) or f"It ended with exit code {code}."
    return AttemptResult(
        code, message, str(error.get("hint", "")), code in PERMANENT_FAILURES and not _may_be_temporary(events)
    )


def _may_be_temporary(events: Path) -> bool:
    """Whether the failure may be temporary: photos changed or were briefly unavailable, as on a network disk."""
    culprit = read_history(events, running=False).culprit
    return culprit is not None and culprit.state == "failed" and not culprit.permanent


def _error_of(output: bytes) -> Mapping[str, JSON]:
    """The ``error`` of the JSON object that a command prints last."""
    try:
        found = json.loads(output.splitlines()[-1])["error"]
    except (ValueError, KeyError, TypeError, IndexError):
        return {}
    return found if isinstance(found, dict) else {}


if __name__ == "__main__":
    try:
        main()
    except OSError as error:  # the disk is full or gone: there is nowhere else to report it
        sys.stderr.write(f"{error}\n")
        sys.exit(EXIT_MACHINE if error.errno else EXIT_STAGE)
