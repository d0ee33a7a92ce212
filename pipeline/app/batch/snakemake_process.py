"""Snakemake as a process: found, started in a group of its own, and ended in order with all that it started.

    python -m splatpipe.pipeline.app.batch.snakemake_process ARGUMENTS

is Snakemake that hears a Ctrl-C of ours also where the shell that called us told its children not to, and that does not
outlive us.
"""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.app.batch.job import end_with_parent
from splatpipe.pipeline.app.batch.plan import MEGABYTE, BatchPlan, Call
from splatpipe.pipeline.app.batch.workflow import SNAKEFILE
from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.engine.machine import available_cores, free_memory_bytes

END_PATIENCE_S = 8.0  # a run ends within five seconds and Docker kills after ten
POLL_S = 0.05
LOG_TAIL = 4000  # characters of Snakemake's log in which its last words are looked for
PROFILE_FILES = ("config.v9+.yaml", "config.v8+.yaml", "config.yaml")
SAID = re.compile(r"^(?:[A-Za-z]*(?:Error|Exception)\b.*|.*\berror: .*)", re.MULTILINE)


@dataclass(frozen=True)
class Profile:
    """Where Snakemake is to run jobs: this machine without a profile.

    Attributes:
        folder: The profile's; None without one.
        text: Of its configuration.
    """

    folder: Path | None = None
    text: str = ""

    @property
    def local(self) -> bool:
        """Whether jobs run on this machine."""
        found = re.search(r"^executor\s*:\s*[\"']?([\w-]+)", self.text, re.MULTILINE)
        return found is None or found[1] == "local"

    def says(self, option: str) -> bool:
        """Whether it has an option."""
        return re.search(rf"^{re.escape(option)}\s*:", self.text, re.MULTILINE) is not None


def open_profile(folder: Path | None) -> Profile:
    """A profile of Snakemake's, a folder with a ``config.yaml``.

    Raises:
        UsageError: if it is none.
    """
    if folder is None:
        return Profile()
    folder = folder.expanduser().resolve()
    for name in PROFILE_FILES:
        with suppress(FileNotFoundError, NotADirectoryError):
            return Profile(folder, (folder / name).read_text(encoding="utf-8"))
    raise UsageError(f"{folder} is not a Snakemake profile.", hint="Name a folder that has a config.yaml.")


def require_snakemake() -> None:
    """Say what is missing before hours are planned.

    Raises:
        MachineError: if Snakemake is not installed.
    """
    if importlib.util.find_spec("snakemake") is None:
        raise MachineError("Snakemake is not installed.", hint="Install it: pip install 'splatpipe[batch]'.")


def snakemake_command(call: Call, plan: BatchPlan, profile: Profile) -> list[str]:
    """The command that runs a call's workflow."""
    command = [sys.executable, "-m", "splatpipe.pipeline.app.batch.snakemake_process"]
    command += ["--snakefile", str(call.folder / SNAKEFILE)]
    command += ["--directory", str(call.folder), "--nolock", "--keep-going", "--nocolor"]
    command += ["--retries", str(plan.retries), "--scheduler", "greedy", "--rerun-triggers", "input"]
    if profile.folder is not None:
        command += ["--profile", str(profile.folder)]
    if not profile.local and not profile.says("cores"):  # no job elsewhere gets more threads than this
        command += ["--cores", str(max((job.threads for each in plan.captures for job in each.jobs), default=1))]
    if profile.local:
        memory = free_memory_bytes() // MEGABYTE
        limits = ["gpu=1", *([f"mem_mb={memory}"] if memory else [])]
        command += [] if profile.says("cores") else ["--cores", str(available_cores())]
        command += [] if profile.says("resources") else ["--resources", *limits]
    return command


def snakemake_environment(call: Call) -> dict[str, str]:
    """Variables for it: no profile that nobody named, no cache outside the batch's folder."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SNAKEMAKE_")}
    # Snakemake does not start without a HOME and a name, which a container's arbitrary user has not.
    nobody = {"HOME": str(call.folder), "LOGNAME": f"user-{os.getuid()}"}
    return {**nobody, **environment, "XDG_CACHE_HOME": str(call.folder / "cache")}


def start_snakemake(call: Call, plan: BatchPlan, profile: Profile) -> subprocess.Popen[bytes]:
    """Begin a call's workflow; the terminal's Ctrl-C does not reach it."""
    with call.snakemake_log.open("ab") as log:
        return subprocess.Popen(
            snakemake_command(call, plan, profile),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            cwd=call.folder,
            env=snakemake_environment(call),
            start_new_session=True,
        )


def end_group(call: Call, group: int, *, local: bool, gone: Callable[[], bool]) -> None:
    """End a workflow: no job begins, those that run are asked to end, and what does not is killed.

    Args:
        call: The call.
        group: Number of Snakemake's process group.
        local: Jobs here are asked themselves; those elsewhere are cancelled by Snakemake.
        gone: Whether Snakemake has ended.
    """
    with suppress(OSError):  # on a full disk the signals do it alone
        call.stop_file.touch()
    deadline = time.monotonic() + END_PATIENCE_S
    with suppress(ProcessLookupError):
        os.killpg(group, signal.SIGTERM if local else signal.SIGINT)
        while not gone() and time.monotonic() < deadline:
            time.sleep(POLL_S)
        os.killpg(group, signal.SIGKILL)


def group_gone(group: int) -> bool:
    """Whether no process of a group is left, of one that is not ours to wait for."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def last_words(call: Call) -> str:
    """What Snakemake said at its end, a line; empty where it said nothing."""
    with suppress(OSError):
        text = call.snakemake_log.read_text(encoding="utf-8", errors="replace")[-LOG_TAIL:]
        found = SAID.findall(text) or [line for line in text.splitlines() if line.strip()]
        return str(found[-1]).strip() if found else ""
    return ""


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    end_with_parent()
    runpy.run_module("snakemake", run_name="__main__", alter_sys=True)
