"""Runs of a small pipeline, in this process or another."""

import subprocess
import sys
from pathlib import Path

import arithmetic

from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.runner import Outcome
from splatpipe.pipeline.engine.runs.session import Request, open_session
from splatpipe.pipeline.engine.stage import Machine


def request_of(numbers: Path, out: Path, **sections: dict[str, object]) -> Request:
    config = resolve(arithmetic.LineConfig, [sections])
    return Request(arithmetic.LINE, config, numbers, out, Machine("cpu", 1))


def walk(request: Request, **how: object) -> tuple[Outcome, list[Event]]:
    events: list[Event] = []
    with open_session(request, events.append) as runner:
        return runner.walk(**how), events


def run_in_background(numbers: Path, out: Path, **count: object) -> subprocess.Popen[bytes]:
    code = (
        "import arithmetic, sys; from pathlib import Path\n"
        "from splatpipe.pipeline.engine.config import resolve\n"
        "from splatpipe.pipeline.engine.runs.session import Request, open_session\n"
        "from splatpipe.pipeline.engine.stage import Machine\n"
        f"config = resolve(arithmetic.LineConfig, [{{'count': {count!r}}}])\n"
        f"request = Request(arithmetic.LINE, config, Path({str(numbers)!r}), Path({str(out)!r}), Machine('cpu', 1))\n"
        "def show(event):\n"
        "    if event.kind == 'progress' and event.stage == 'count' and event.data['done'] >= 2:\n"
        "        print('counting', flush=True)\n"
        "with open_session(request, show) as runner:\n"
        "    runner.walk()\n"
    )
    command = [sys.executable, "-c", code]
    return subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
