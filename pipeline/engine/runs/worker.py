"""The child process in which stage bodies run, so that a crash in a C++ library fails only the stage.

One worker runs the stages of a pipeline one after the other (torch is imported once). Requests arrive on stdin and
events leave on the original stdout, one JSON object per line; whatever libraries print goes to the log. The worker
dies with its parent, whatever kills the parent.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import IO

from splatpipe.pipeline.engine.errors import (
    ERRORS,
    EXIT_TERMINATED,
    MachineError,
    SplatpipeError,
    StageError,
    card_fault,
)
from splatpipe.pipeline.engine.events import Event, EventReporter
from splatpipe.pipeline.engine.heap import imports_outside_gc, return_free_heap
from splatpipe.pipeline.engine.runs.children import CHILDREN_MEMORY, die_with_parent
from splatpipe.pipeline.engine.runs.peak_memory import (
    peak_memory_bytes,
    reset_peak_memory,
    resident_memory_bytes,
)
from splatpipe.pipeline.engine.stage import JSON, Inputs, Machine, Shard, StageConfig, load_body

NO_MEMORY = (
    "not enough memory",
    "bad_alloc",
    "cuda out of memory",
    "cuda error: out of memory",
)  # in libraries' errors
NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE}
OOM_SCORE = "500"  # of 1000: of two workers, the kernel kills the one that stands back if memory runs out
BAD_DISK = {errno.EIO, errno.ESTALE, errno.ENXIO, errno.ENODEV}  # a failing disk, or a network share that went away


@dataclass(frozen=True)
class Task:
    """One stage to run, as plain JSON, so that any process with access to the same files can run it.

    Attributes:
        stage: Its name.
        entry: ``module:function`` of its body.
        config_type: ``module:class`` of its configuration model.
        config: The configuration's values.
        parts: Path of each part that it reads.
        photos_dir: The user's folder.
        settings: Borrowed settings.
        summaries: Summaries of the stages before it.
        machine: Device and threads.
        out: Where it writes.
        shard: Number and count of the shard to run; None for a stage's own body.
        shards: Folders of the stage's shards.
    """

    stage: str
    entry: str
    config_type: str
    config: dict[str, JSON]
    parts: dict[str, str]
    photos_dir: str
    settings: dict[str, JSON]
    summaries: dict[str, JSON]
    machine: dict[str, JSON]
    out: str
    shard: dict[str, int] | None = None
    shards: list[str] = field(default_factory=list)

    def inputs(self) -> Inputs:
        """The inputs passed to the body."""
        return Inputs(
            {name: Path(path) for name, path in self.parts.items()},
            Path(self.photos_dir),
            self.settings,
            Machine(**self.machine),
            self.summaries,
            None if self.shard is None else Shard(**self.shard),
            tuple(map(Path, self.shards)),
        )


def execute(task: Task, send: IO[str]) -> None:
    """Run a task's body in this process and send its events and its result.

    Args:
        task: What to run.
        send: Receives JSON lines: ``{"event": …}``, then ``{"done": …}`` or ``{"failed": …}``.

    Raises:
        KeyboardInterrupt: if it was asked to stop; ``failed`` is sent first.
    """

    lock = threading.Lock()

    def send_message(message: JSON) -> None:
        with lock:
            send.write(json.dumps(message) + "\n")
            send.flush()

    with_children = 0  # peak memory of the body's child processes, with what it had itself while it waited for them

    def sink(event: Event) -> None:
        nonlocal with_children
        if event.kind == "metric" and event.data["name"] == CHILDREN_MEMORY:
            with_children = max(with_children, int(event.data["value"]) + resident_memory_bytes())
        send_message({"event": asdict(event)})

    started = _Usage.now()
    try:
        module, _, name = task.config_type.partition(":")
        with imports_outside_gc():
            config_type: type[StageConfig] = getattr(__import__(module, fromlist=[name]), name)
            body = load_body(task.entry)
        config = config_type.model_validate(task.config)
        summary = body(config, task.inputs(), Path(task.out), EventReporter(task.stage, sink))
    except KeyboardInterrupt:
        send_message({"failed": {"type": "KeyboardInterrupt"}})
        raise
    except BaseException as error:
        traceback.print_exc(file=sys.stderr)
        sys.stderr.flush()
        failure = as_splatpipe_error(task.stage, error)
        send_message({"failed": {"type": type(failure).__name__, "message": failure.message, "hint": failure.hint}})
    else:
        usage = started.until_now()
        usage["peak_memory_bytes"] = max(usage["peak_memory_bytes"], with_children)
        send_message({"done": {"summary": dict(summary), **usage}})


def as_splatpipe_error(stage: str, error: BaseException) -> SplatpipeError:
    """Convert any exception of a stage's body into an error with a message for the user."""
    if isinstance(error, SplatpipeError):
        # A stage may raise its own subclass; only the known ones cross the process boundary by name.
        known = next(ERRORS[kind.__name__] for kind in type(error).__mro__ if kind.__name__ in ERRORS)
        return known(error.message, error.hint)
    text = str(error).lower()
    if isinstance(error, OSError) and error.errno in NO_ROOM | BAD_DISK:
        where = f" ({error.filename})" if error.filename else ""
        what = "write" if error.errno in NO_ROOM else "use a file"
        return MachineError(
            f"The stage {stage} could not {what}: {error.strerror}{where}.",
            "Free some space or check the disk, then run again: it resumes from here.",
        )
    if "disk is full" in text or "no space left" in text:
        return MachineError(
            f"The disk filled up in the stage {stage}.", "Free some space, then run again: it resumes from here."
        )
    if isinstance(error, MemoryError) or any(phrase in text for phrase in NO_MEMORY):
        return MachineError(
            f"The stage {stage} ran out of memory.",
            "Close other programs, or lower train.max_megapixels or train.max_gaussians.",
        )
    if (fault := card_fault(error)) is not None:
        return fault
    return StageError(
        f"The stage {stage} failed: {type(error).__name__}: {error}",
        "The log has the details; please report it.",
    )


@dataclass(frozen=True)
class _Usage:
    wall_s: float
    cpu_s: float

    @staticmethod
    def now() -> _Usage:
        return_free_heap()  # freed by earlier stages: this one must not be charged for it
        reset_peak_memory()
        return _Usage(time.monotonic(), _cpu_seconds())

    def until_now(self) -> dict[str, float | int]:
        return {
            "seconds": round(time.monotonic() - self.wall_s, 3),
            "cpu_seconds": round(_cpu_seconds() - self.cpu_s, 3),
            "peak_memory_bytes": peak_memory_bytes(),
        }


def _cpu_seconds() -> float:
    """CPU seconds of this process and of its ended children."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def _requests(stream: IO[str]) -> Iterator[Task]:
    """Yield the parent's tasks; if the pipe closes without an exit request, the parent has died: kill this process."""
    ready: list[Task | None] = []
    arrived = threading.Condition()

    def read() -> None:
        for line in stream:
            request = json.loads(line)
            with arrived:
                ready.append(Task(**request["task"]) if "task" in request else None)
                arrived.notify()
            if "task" not in request:
                return
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=read, daemon=True).start()
    while True:
        with arrived:
            arrived.wait_for(lambda: ready)
            task = ready.pop(0)
        if task is None:
            return
        yield task


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _install_handlers() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C also reaches the parent, which decides
    signal.signal(signal.SIGTERM, _interrupt)


def _stand_back(niceness: int) -> None:
    """Let other processes go first: on the processors, and in staying alive if memory runs out."""
    os.nice(niceness)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(OOM_SCORE, encoding="ascii")


def main() -> None:
    """Serve the parent until it sends an exit request.

    The parent's process ID is on the command line, then, for a worker that stands back, how far.
    """
    die_with_parent(int(sys.argv[1]))
    if len(sys.argv) > 2:
        _stand_back(int(sys.argv[2]))
    _install_handlers()
    events = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    try:
        for task in _requests(sys.stdin):
            execute(task, events)
    except KeyboardInterrupt:  # at once: the parent waits, and the thread reading stdin would delay an orderly exit
        os._exit(EXIT_TERMINATED)


if __name__ == "__main__":
    main()
