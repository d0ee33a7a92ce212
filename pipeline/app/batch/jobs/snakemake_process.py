"""Snakemake as a process: located, started in its own process group, and ended with everything it started.

    python -m splatpipe.pipeline.app.batch.jobs.snakemake_process ARGUMENTS

runs Snakemake so that it receives our SIGINT even if the calling shell made its children ignore it, and so that it does
not outlive us.
"""

from __future__ import annotations

import asyncio
import importlib.util
import os
import pwd
import re
import runpy
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.batch.jobs.job import end_with_parent
from splatpipe.pipeline.app.batch.jobs.job_errors import record_errors
from splatpipe.pipeline.app.batch.jobs.plan import MEGABYTE, BatchPlan, Call
from splatpipe.pipeline.app.batch.jobs.slurm_queue import largest_node
from splatpipe.pipeline.app.batch.jobs.workflow import SNAKEFILE
from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.engine.files.output_file import appended_file, write_file
from splatpipe.pipeline.engine.files.small_file import read_end, read_small
from splatpipe.pipeline.engine.machine import available_cores, free_memory_bytes
from splatpipe.pipeline.engine.python_module import SAFE_PATH, python_module

END_TIMEOUT_S = 8.0  # a run ends within five seconds and Docker kills after ten
POLL_S = 0.05
MAX_PROFILE_BYTES = 1 << 20
LOG_TAIL = 4000  # characters of Snakemake's log that are searched for its last message
PROFILE_FILES = ("config.v9+.yaml", "config.v8+.yaml", "config.yaml")
ERROR_LINE = re.compile(r"^(?:[A-Za-z]*(?:Error|Exception)\b(?::\n)?.*|.*\berror: .*)", re.MULTILINE)
SNAKEMAKE = "snakemake>=9.20,<10"
# Executor plugins by their profile's name, in the versions with which the shipped profiles were tried.
PLUGINS = {"slurm": "snakemake-executor-plugin-slurm==2.8.0"}


@dataclass(frozen=True)
class Profile:
    """Where Snakemake runs jobs: on this machine if there is no profile.

    Attributes:
        folder: The profile's folder; None without one.
        text: Its configuration file's text.
    """

    folder: Path | None = None
    text: str = ""

    @property
    def executor(self) -> str:
        """The name of the executor."""
        return self.value("executor") or "local"

    @property
    def local(self) -> bool:
        """Whether jobs run on this machine."""
        return self.executor == "local"

    def sets(self, option: str) -> bool:
        """Whether the profile sets an option."""
        return re.search(rf"^{re.escape(option)}\s*:", self.text, re.MULTILINE) is not None

    def value(self, option: str) -> str:
        """An option's value, also within another's, if it is one word; else empty."""
        found = re.search(rf"^\s*{re.escape(option)}\s*:\s*[\"']*([\w.-]+)", self.text, re.MULTILINE)
        return found[1] if found else ""

    def largest_machine(self) -> tuple[int, int]:
        """Processors and bytes of memory of the largest machine that jobs can have, each 0 if unknown.

        A profile's ``max-threads`` takes precedence over what Slurm says.
        """
        stated = self.value("max-threads")
        cpus, memory = largest_node(self.value("slurm_partition")) if self.executor == "slurm" else (0, 0)
        return int(stated) if stated.isdecimal() else cpus, memory


def open_profile(folder: Path | None) -> Profile:
    """Open a Snakemake profile, a folder with a ``config.yaml``.

    Raises:
        UsageError: if it is not a profile.
    """
    if folder is None:
        return Profile()
    folder = folder.expanduser().resolve()
    for name in PROFILE_FILES:
        with suppress(FileNotFoundError, NotADirectoryError):
            return Profile(folder, read_small(folder / name, MAX_PROFILE_BYTES).decode("utf-8"))
    raise UsageError(f"{folder} is not a Snakemake profile.", hint="Name a folder that has a config.yaml.")


def require_snakemake(profile: Profile) -> None:
    """Check that Snakemake is installed, and the plugin with which the profile submits jobs.

    Raises:
        MachineError: if one is not installed.
    """
    if importlib.util.find_spec("snakemake") is None:
        raise MachineError("Snakemake is not installed.", hint=_install(SNAKEMAKE))
    name = f"snakemake-executor-plugin-{profile.executor}"
    if not profile.local and importlib.util.find_spec(name.replace("-", "_")) is None:
        raise MachineError(
            f"Snakemake has no executor {profile.executor}, which the profile names.",
            hint=_install(PLUGINS.get(profile.executor, name)),
        )


def _install(package: str) -> str:
    """The command that installs a package into this installation."""
    if importlib.util.find_spec("pip") is None:  # as in the image
        return f'Build the image with --build-arg SNAKEMAKE_PLUGINS="{package}".'
    return f"Install it: {sys.executable} -m pip install {shlex.quote(package)}"


def snakemake_command(call: Call, plan: BatchPlan, profile: Profile) -> list[str]:
    """The command that runs a call's workflow."""
    command = python_module("splatpipe.pipeline.app.batch.jobs.snakemake_process")
    command += ["--snakefile", str(call.folder / SNAKEFILE)]
    command += ["--directory", str(call.folder), "--nolock", "--keep-going", "--nocolor"]
    command += ["--retries", str(plan.retries), "--scheduler", "greedy", "--rerun-triggers", "input"]
    if profile.folder is not None:
        command += ["--profile", str(profile.folder)]
    if not profile.local and not profile.sets("cores"):  # caps the threads of jobs elsewhere
        command += ["--cores", str(max((job.threads for each in plan.captures for job in each.jobs), default=1))]
    if profile.local:
        memory = free_memory_bytes() // MEGABYTE
        limits = ["gpu=1", *([f"mem_mb={memory}"] if memory else [])]
        command += [] if profile.sets("cores") else ["--cores", str(available_cores())]
        command += [] if profile.sets("resources") else ["--resources", *limits]
    return command


def snakemake_environment(call: Call) -> dict[str, str]:
    """Environment variables for Snakemake: no implicit profile, no cache outside the batch's folder."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SNAKEMAKE_")}
    # Snakemake does not start without HOME and a user name, which an arbitrary container user lacks.
    nobody = {"HOME": str(call.folder), "LOGNAME": _user_name()}
    return {**nobody, **environment, **SAFE_PATH, "XDG_CACHE_HOME": str(call.folder / "cache")}


def _user_name() -> str:
    """This user's name, by which Slurm knows them; one made up if the machine has none."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return f"user-{os.getuid()}"


def start_snakemake(call: Call, plan: BatchPlan, profile: Profile) -> subprocess.Popen[bytes]:
    """Start a call's workflow; the terminal's Ctrl-C does not reach it."""
    with appended_file(call.snakemake_log) as log:
        return subprocess.Popen(
            snakemake_command(call, plan, profile),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            cwd=call.folder,
            env=snakemake_environment(call),
            start_new_session=True,
        )


def end_group(call: Call, group: int, *, local: bool, has_ended: Callable[[], bool]) -> None:
    """End a workflow: no job starts, running ones are asked to stop, and those that do not are killed.

    Args:
        call: The call.
        group: ID of Snakemake's process group.
        local: Local jobs are signalled directly; Snakemake cancels those elsewhere.
        has_ended: Returns whether Snakemake has ended.
    """
    with suppress(OSError):  # on a full disk the signals must suffice
        write_file(call.stop_file, "")
    deadline = time.monotonic() + END_TIMEOUT_S
    with suppress(ProcessLookupError):
        os.killpg(group, signal.SIGTERM if local else signal.SIGINT)
        while not has_ended() and time.monotonic() < deadline:
            time.sleep(POLL_S)
        os.killpg(group, signal.SIGKILL)


def group_has_ended(group: int) -> bool:
    """Whether no process of a group is left, for a group whose processes are not our children."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def last_error_line(call: Call) -> str:
    """The last line of Snakemake's log; empty if there is none."""
    with suppress(OSError):
        text = read_end(call.snakemake_log, LOG_TAIL).decode("utf-8", errors="replace")
        found = ERROR_LINE.findall(text) or [line for line in text.splitlines() if line.strip()]
        return " ".join(str(found[-1]).split()) if found else ""
    return ""


def limit_poll_intervals() -> None:
    """Keep the executor of the Snakemake that will run in this process asking as often as Snakemake is set to.

    Slurm's plugin ignores ``--seconds-between-status-checks`` and lets its intervals grow to three minutes, by which
    the next job starts later; Slurm may even have forgotten the job by then.
    """
    from snakemake_interface_executor_plugins.executors.remote import RemoteExecutor

    RemoteExecutor.sleep = _sleep_until_next_poll


async def _sleep_until_next_poll(executor: Any) -> None:
    most = executor.workflow.remote_execution_settings.seconds_between_status_checks
    await asyncio.sleep(min(executor.next_seconds_between_status_checks, most))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    end_with_parent()
    record_errors(Path.cwd())
    limit_poll_intervals()
    runpy.run_module("snakemake", run_name="__main__", alter_sys=True)
