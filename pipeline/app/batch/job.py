"""The process of a workflow job: runs its stages of one capture by `splatpipe run --until`, or one shard.

    python -m splatpipe.pipeline.app.batch.job CALL CAPTURE JOB THREADS MARKER ATTEMPT

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
from collections.abc import Mapping
from pathlib import Path
from types import FrameType

from splatpipe.pipeline.app.batch.attempts import PERMANENT_FAILURES, AttemptLog, AttemptResult, read_attempts, spent_s
from splatpipe.pipeline.app.batch.plan import BatchPlan, Call, PlannedCapture, StageJob, workflow_jobs
from splatpipe.pipeline.app.batch.shards import counts_shards, store_shard_jobs
from splatpipe.pipeline.app.cli_runs import SPENT_VARIABLE
from splatpipe.pipeline.app.command_summary import PART_VARIABLE
from splatpipe.pipeline.app.report.run_history import read_history
from splatpipe.pipeline.engine.children import PR_SET_PDEATHSIG
from splatpipe.pipeline.engine.errors import EXIT_MACHINE, EXIT_STAGE, EXIT_TERMINATED
from splatpipe.pipeline.engine.output_file import appended_file, write_file
from splatpipe.pipeline.engine.python_module import python_module
from splatpipe.pipeline.engine.run_folder import EVENTS_FILE, shard_events
from splatpipe.pipeline.engine.stage import JSON, stage_name
from splatpipe.stages.line import LINE

SPLATPIPE = tuple(python_module("splatpipe.pipeline.app.cli"))
RESERVE_BYTES = 256 << 20  # of the disk, reserved for what other captures' stages write at the same time


def main() -> None:
    """Run the job given on the command line."""
    end_with_parent()
    call = Call(Path(sys.argv[1]))
    key, name, threads, marker, number = sys.argv[2], sys.argv[3], int(sys.argv[4]), Path(sys.argv[5]), int(sys.argv[6])
    capture = call.plan().capture(key)
    log = AttemptLog(call.attempts_file(key, name))
    before = {each.stage: each for each in log.read()}
    signals = _Signals()
    for job in workflow_jobs(call.jobs(capture))[name]:
        earlier = before.get(job.stage)
        if earlier is not None and (earlier.succeeded or earlier.final):
            code = earlier.exit_code or 0
        elif call.stop_file.exists() or signals.received:
            code = EXIT_TERMINATED
        else:
            log.begin(job.stage, number)
            ending = _disk_shortage(call.out, job) or _run(call, capture, job, threads, signals)
            log.end(ending)
            code = ending.exit_code
        if code:
            sys.exit(code)
    if counts_shards(name, LINE):
        store_shard_jobs(call, key, threads)
    marker.parent.mkdir(parents=True, exist_ok=True)
    write_file(marker, "")


def _disk_shortage(out: Path, job: StageJob) -> AttemptResult | None:
    """The failure if the stage must not start, e.g. for lack of disk space; None if it may."""
    free = shutil.disk_usage(out).free
    if free >= job.disk_bytes + RESERVE_BYTES:
        return None
    needed = (job.disk_bytes + RESERVE_BYTES) / 1e9
    return AttemptResult(
        EXIT_MACHINE,
        f"The disk has {free / 1e9:.1f} GB free, and the stage {job.stage} needs about {needed:.1f}.",
        "Make room, then repeat the command: finished work is kept.",
        final=True,
    )


def _run(call: Call, capture: PlannedCapture, job: StageJob, threads: int, signals: _Signals) -> AttemptResult:
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
            env={**os.environ, SPENT_VARIABLE: f"{spent:.3f}", **({} if last else {PART_VARIABLE: "1"})},
            start_new_session=True,
            preexec_fn=end_with_parent,  # noqa: PLW1509 (one thread)
        )
    signals.forward_to(process)
    output, _ = process.communicate()
    out = Path(plan.out) / capture.name
    shard = job.stage != stage_name(job.stage)
    return _ending(process.returncode, output, shard_events(out, job.stage) if shard else out / EVENTS_FILE)


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
    return culprit is not None and culprit.state == "failed" and not culprit.lasting


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
