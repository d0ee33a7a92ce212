"""Runs the pipeline of lines/leftovers.py, and kills itself once a stage reports something; a program for
test_ladder_kills.py.

Arguments: photos, out, the event to die at ("" for none), threads.
"""

import os
import signal
import sys
from pathlib import Path

import leftovers

from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.session import Request, open_session
from splatpipe.pipeline.engine.stage import Machine


def main(photos: str, out: str, stop_at: str, threads: str) -> None:
    def die(event: Event) -> None:
        if stop_at and event.kind == "progress" and stop_at in str(event.data["what"]):
            os.killpg(os.getpgid(0), signal.SIGKILL)

    config = resolve(leftovers.LineConfig, [{"sparse": {"mapper": "incremental", "lens": "simple"}}])
    with open_session(
        Request(leftovers.LINE, config, Path(photos), Path(out), Machine("cpu", int(threads))), die
    ) as run:
        run.walk()


if __name__ == "__main__":
    main(*sys.argv[1:])
