"""Child processes that a stage's body starts for work that cannot be done by threads of one process.

They end with the body, whether by an error, an interruption, or the death of its process.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.python_module import python_module
from splatpipe.pipeline.engine.runs.peak_memory import MAXRSS_BYTES, peak_memory_of

PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
POLL_S = 0.2
CHILDREN_MEMORY = "children_peak_memory_bytes"  # the metric with which a body reports its children's memory
# Each child uses one core: thread pools of the numeric libraries would only compete with each other.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def die_with_parent(parent: int) -> None:
    """Have this process killed when its parent dies: by the kernel on Linux, elsewhere by polling.

    Args:
        parent: The parent's process ID; if it is already dead, this process ends here.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()
    if os.getppid() != parent:
        os._exit(1)


def _exit_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(POLL_S)
    os._exit(1)


def run_children(commands: Sequence[Sequence[str]], poll: Callable[[], None], what: str) -> int:
    """Run commands in parallel to completion, one core each.

    Args:
        commands: ``module, *arguments`` each; the module gets our process ID as its first argument, for
            ``die_with_parent``.
        poll: Called a few times a second.
        what: What they are doing, for the message if one fails.

    Returns:
        The sum of their peak resident memory, bytes, since they run in parallel.

    Raises:
        StageError: if one fails; the others are killed.
    """
    running: dict[int, subprocess.Popen[bytes]] = {}
    peaks: dict[int, int] = {}
    try:
        for module, *arguments in commands:
            command = python_module(module, str(os.getpid()), *arguments)
            child = subprocess.Popen(command, stdin=subprocess.DEVNULL, env={**os.environ, **ONE_THREAD})
            running[child.pid] = child
        while running:
            time.sleep(POLL_S)
            for pid in list(running):
                peaks[pid] = peak_memory_of(pid) or peaks.get(pid, 0)
                ended, status, usage = os.wait4(pid, os.WNOHANG)
                if ended:
                    child = running.pop(pid)
                    child.returncode = os.waitstatus_to_exitcode(status)
                    # Linux counts in ru_maxrss what the parent had when it started the child.
                    peaks[pid] = peaks[pid] or usage.ru_maxrss * MAXRSS_BYTES
                    _check(child.returncode, what)
            poll()
    finally:
        for child in running.values():
            child.kill()
        for child in running.values():
            child.wait()
    return sum(peaks.values())


def _check(code: int, what: str) -> None:
    if code:
        how = f"with exit code {code}" if code > 0 else f"by signal {-code}"
        raise StageError(
            f"A process that was {what} ended {how}.",
            hint="Run again: what was finished is kept. If memory is short, close other programs or give --threads 1.",
        )
