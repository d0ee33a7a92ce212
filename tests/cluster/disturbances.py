"""What happens to jobs on a cluster at night: each has to be told as what it is, and the repeated command goes on."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from daemons import GROUPS, HOSTS, Problem
from nights import Batch, Night

STAGE = "features"
# Long enough to be disturbed: the preset's extractor would take a second.
OPTIONS = ("--preset", "preview", "--until", STAGE, "--set", "features.extractor=sift", "--threads", "1")
PHOTOS = 8
PAGE_S = 30.0
MARKS = (b"splatpipe", b"snakemake", b"srun")  # in the command lines of a job's processes
SLURMS = b"slurmstepd"  # without it Slurm takes the host for dead, and requeues the job


def _start(night: Night, name: str, *more: str, profile_text: str = "") -> Batch:
    captures = night.captures(name, {"house": PHOTOS})
    profile = night.profile(name, profile_text)
    return night.start(name, captures, *OPTIONS, *more, profile=profile)


def _again(night: Night, batch: Batch) -> None:
    """Repeat a batch's command with the shipped profile: it has to go on and succeed."""
    name = batch.out.name
    night.start(name, night.work / "captures" / name, *OPTIONS, again=True).end(0)
    if (state := batch.capture()["state"]) not in ("done", "reused"):
        raise Problem(f"The repeated command leaves it {state}.")
    night.say("   the repeated command goes on, and the capture is done")


def _running(night: Night, batch: Batch, times: int = 1) -> str:
    """Wait until the stage's attempt of that number runs; return Slurm's number of its job."""
    batch.wait_for("the stage", lambda: batch.begun(STAGE, times))
    return str(batch.wait_for("its job", lambda: night.job_of(batch)))


def _must_fail(night: Night, batch: Batch, reason: str) -> None:
    batch.end(1)
    capture = batch.capture()
    summary = f"{capture['state']} in {capture['stage']}: {capture['reason']} {capture['hint']}"
    night.say(f"exit code 1; {summary}")
    if capture["state"] != "failed" or reason not in capture["reason"]:
        raise Problem(f"It has to fail with “{reason}”.\n{batch.output()}")


def _must_succeed(night: Night, batch: Batch, *, earlier: str = "", tries: int = 1) -> None:
    """It succeeds, and what was told before it did is right: an earlier attempt's reason, or nothing at all."""
    batch.end(0)
    capture = batch.capture()
    notices = batch.notices.read_text(encoding="utf-8").split("\n")[:-1]
    summary = ", ".join(f"{name} {capture[name]}" for name in ("state", "tries", "earlier"))
    night.say(f"exit code 0; {summary}, notices {notices}")
    if notices != ["house done", f"{batch.out.name} done"] or capture["tries"] != tries:
        raise Problem(f"There have to be {tries} attempts and two notices.\n{batch.output()}")
    if earlier not in " ".join(capture["earlier"]) or bool(earlier) != bool(capture["earlier"]):
        raise Problem(f"The reason of the earlier attempt has to be “{earlier}”.")


def _end_processes(job: str, marks: Sequence[bytes] = MARKS) -> None:
    """Kill what a job runs on the second host, and nothing else."""
    found = {
        int(line)
        for folder in (GROUPS / "memory" / f"slurm_{HOSTS[1]}").glob(f"uid_*/job_{job}")
        for file in folder.rglob("cgroup.procs")
        for line in file.read_text().split()
    }
    for process in found:
        with suppress(OSError):
            command = Path(f"/proc/{process}/cmdline").read_bytes()
            if any(mark in command for mark in marks):
                os.kill(process, signal.SIGKILL)


ON_SECOND = f"default-resources: {{slurm_partition: normal, slurm_extra: \"'--nodelist={HOSTS[1]}'\"}}"


def cancelled(night: Night) -> None:
    """`scancel` of a running job: an attempt with that reason, and Snakemake's retry succeeds."""
    batch = _start(night, "cancelled", "--retries", "1")
    night.cluster.run("scancel", _running(night, batch))
    _must_succeed(night, batch, earlier="cancelled (scancel)", tries=2)


def killed_on_the_other_host(night: Night) -> None:
    """kill -9 of all that a job runs on another host, where nothing can record its end."""
    batch = _start(night, "killed", "--retries", "0", profile_text=ON_SECOND)
    _end_processes(_running(night, batch))
    _must_fail(night, batch, "Slurm ended its job")
    _again(night, batch)


def requeued(night: Night) -> None:
    """`scontrol requeue`: no attempt has failed."""
    batch = _start(night, "requeued", "--retries", "0")
    night.cluster.run("scontrol", "requeue", _running(night, batch))
    _must_succeed(night, batch)


def beyond_its_memory(night: Night) -> None:
    """A job whose stage needs more memory than it requested."""
    less = f"set-resources: {{{STAGE}: {{mem_mb: 300}}}}"  # ingest takes 380 MB, and what starts it 145
    batch = _start(night, "memory", "--retries", "0", profile_text=less)
    _must_fail(night, batch, "more memory than its job had requested")
    _again(night, batch)


def too_large_for_any_node(night: Night) -> None:
    """A job that Slurm refuses: it never begins."""
    batch = _start(night, "large", "--retries", "0", profile_text=f"set-resources: {{{STAGE}: {{mem_mb: 60000}}}}")
    _must_fail(night, batch, "Its job failed: sbatch")
    _again(night, batch)


def at_its_time_limit(night: Night) -> None:
    """A job that its time limit ends; Slurm's shortest is a minute, so that it is stopped until then."""
    batch = _start(
        night, "time", "--retries", "0", profile_text=f"{ON_SECOND}\nset-resources: {{{STAGE}: {{runtime: 1}}}}"
    )
    job = _running(night, batch)
    night.cluster.run("scancel", "--signal=STOP", job)
    _must_fail(night, batch, "time limit")
    _again(night, batch)


def drained(night: Night) -> None:
    """All hosts drained: the page says why the job waits; then they come back."""
    for host in HOSTS:
        night.cluster.run("scontrol", "update", f"nodename={host}", "state=drain", "reason=test")
    try:
        batch = _start(night, "drained", "--retries", "0")
        reason = batch.wait_for(
            "Slurm's reason", lambda: (batch.out / "batch.json").exists() and batch.capture()["reason"]
        )
        page = batch.out / "batch.html"  # written after batch.json
        batch.wait_for("its page", lambda: "down or drained" in page.read_text(encoding="utf-8"), PAGE_S)
    finally:
        for host in HOSTS:
            night.cluster.run("scontrol", "update", f"nodename={host}", "state=resume")
    night.say(f"while it waits: {reason}")
    if "down or drained" not in reason:
        raise Problem("It has to be told that the nodes are drained.")
    _must_succeed(night, batch)


def host_down(night: Night) -> None:
    """The job's host dies: Slurm notices it after half a minute and requeues the job, which is no attempt."""
    batch = _start(night, "down", "--retries", "0", profile_text=ON_SECOND)
    job = _running(night, batch)
    night.cluster.end_daemon(HOSTS[1], at_once=True)
    _end_processes(job, (*MARKS, SLURMS))
    batch.wait_for("the host to be down", lambda: night.cluster.node_states()[HOSTS[1]].startswith("down"))
    night.say(f"{HOSTS[1]} is {night.cluster.node_states()[HOSTS[1]]}; it is started again")
    night.cluster.start_host(HOSTS[1])
    _must_succeed(night, batch)


def batch_killed(night: Night) -> None:
    """kill -9 of the batch itself: its guard cancels the job and says so."""
    batch = _start(night, "batch", "--retries", "0")
    _running(night, batch)
    batch.process.kill()
    batch.process.wait()
    until_s = time.monotonic() + 60.0
    while batch.state()["at_work"] or night.cluster.run("squeue", "-h", "-o", "%Z").find(str(batch.out)) >= 0:
        if time.monotonic() > until_s:
            raise Problem("Its jobs or its page have not ended.")
        time.sleep(1.0)
    capture = batch.capture()
    night.say(f"{capture['state']} in {capture['stage']}: {batch.state()['message']}")
    if capture["state"] != "stopped":
        raise Problem("The capture has to be stopped.")
    _again(night, batch)


TOGETHER = (
    cancelled,
    killed_on_the_other_host,
    requeued,
    beyond_its_memory,
    too_large_for_any_node,
    at_its_time_limit,
    batch_killed,
)
ALONE = (drained, host_down)  # these take the hosts from the others
