"""Processes that a stage's body starts for work that threads of one process must not share.

They end with the body, whatever ends that: an error, an interruption, or the death of its process.
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

PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
LOOK_S = 0.2
CHILDREN_MEMORY = "children_peak_memory_bytes"  # the metric by which a body tells what its children took
# Each is one core's work: pools of the numeric libraries would only get into each other's way.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
MAXRSS_BYTES = 1 if sys.platform == "darwin" else 1024  # the unit of ru_maxrss


def die_with_parent(parent: int) -> None:
    """Have this process ended when the one that started it dies: by Linux, elsewhere by a look now and then.

    Args:
        parent: Who that is; if it is dead already this process ends here.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_outlive_nobody, args=(parent,), daemon=True).start()
    if os.getppid() != parent:
        os._exit(1)


def _outlive_nobody(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)


def run_children(commands: Sequence[Sequence[str]], look: Callable[[], None], what: str) -> int:
    """Run commands side by side to their ends, a core each.

    Args:
        commands: ``module, *arguments`` each; the module is given our process number before those, for
            ``die_with_parent``.
        look: Called a few times a second.
        what: What they do, for the message if one fails.

    Returns:
        The sum of their peaks of resident memory, bytes: they run side by side.

    Raises:
        StageError: if one fails; the others are ended.
    """
    running: dict[int, subprocess.Popen[bytes]] = {}
    peak = 0
    try:
        for module, *arguments in commands:
            command = [sys.executable, "-m", module, str(os.getpid()), *arguments]
            child = subprocess.Popen(command, stdin=subprocess.DEVNULL, env={**os.environ, **ONE_THREAD})
            running[child.pid] = child
        while running:
            time.sleep(LOOK_S)
            for pid in list(running):
                ended, status, usage = os.wait4(pid, os.WNOHANG)
                if ended:
                    child = running.pop(pid)
                    child.returncode = os.waitstatus_to_exitcode(status)
                    peak += usage.ru_maxrss * MAXRSS_BYTES
                    _check(child.returncode, what)
            look()
    finally:
        for child in running.values():
            child.kill()
        for child in running.values():
            child.wait()
    return peak


def _check(code: int, what: str) -> None:
    if code:
        how = f"with exit code {code}" if code > 0 else f"by signal {-code}"
        raise StageError(
            f"A process that was {what} ended {how}.",
            hint="Run again: what was finished is kept. If memory is short, close other programs or give --threads 1.",
        )
