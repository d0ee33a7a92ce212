"""Runs the pipeline as the command does, and kills itself in the middle of a stage; a program for test_line.py.

Arguments: photos, out, the stage to die in, "alone", "group" or "beside", then --set assignments. The last is the
group, too, and of a run whose stages may run beside one another; otherwise each runs in its turn.
"""

import os
import signal
import sys
from pathlib import Path

from splatpipe.pipeline.engine.config import load_preset, parse_set, resolve
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.session import Request, open_session
from splatpipe.pipeline.engine.stage import Machine
from splatpipe.stages.forecast.needs import Forecaster
from splatpipe.stages.line import AHEAD, LINE
from splatpipe.stages.options import LineConfig


def main(photos: str, out: str, stage: str, how: str, *assignments: str) -> None:
    def die(event: Event) -> None:
        # The runner commits an artifact only after the stage's last event: a progress event is within the stage.
        if event.stage == stage and event.kind == "progress" and event.data["done"] > 0:
            if how != "alone":
                os.killpg(os.getpgid(0), signal.SIGKILL)
            os.kill(os.getpid(), signal.SIGKILL)

    # As the command resolves it.
    config = resolve(LineConfig, [load_preset("standard"), *(parse_set(text, LineConfig) for text in assignments)])
    ahead = AHEAD if how == "beside" else {}
    request = Request(LINE, config, Path(photos), Path(out), Machine("cpu", 2), Forecaster(config, 2), ahead)
    with open_session(request, die) as runner:
        runner.walk()


if __name__ == "__main__":
    main(*sys.argv[1:])
