"""A small pipeline of which two stages need only the first: one is long, the other may run beside it.

Their bodies meet by files, so that no test depends on how long something takes.
"""

import os
import signal
import time
from pathlib import Path

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Stage, StageConfig, Summary

TIMEOUT_S = 60.0


class BodyConfig(StageConfig):
    meet: str = ""
    """Folder in which the bodies leave their process IDs; empty: they leave none."""
    awaits: str = ""
    """Stage to wait for until its process ID is there."""
    fail: str = ""
    """How to fail, if at all."""


class LineConfig(StageConfig):
    first: BodyConfig = BodyConfig()
    long: BodyConfig = BodyConfig()
    longer: BodyConfig = BodyConfig()
    side: BodyConfig = BodyConfig()
    next: BodyConfig = BodyConfig()
    last: BodyConfig = BodyConfig()


def run(config: BodyConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    done = out / "done"
    begun = len(done.read_text()) if done.exists() else 0
    done.write_text((begun + 1) * "x")
    report.progress(begun, 2, "working", "steps")
    if config.meet:
        name = out.name.partition("-")[0]
        Path(config.meet, f"{name}.new").write_text(str(os.getpid()))
        Path(config.meet, f"{name}.new").replace(Path(config.meet, name))
    until_s = time.monotonic() + TIMEOUT_S
    while config.awaits and not Path(config.meet, config.awaits).exists():
        assert time.monotonic() < until_s, f"{config.awaits} did not begin"
        time.sleep(0.02)
    if config.fail == "kill" and not begun:
        os.kill(os.getpid(), signal.SIGKILL)
    if config.fail == "memory" and not begun:
        raise MachineError("It ran out of memory.")
    if config.fail == "abort":
        os.abort()
    if config.fail == "input":
        raise SplatpipeError("It is no good.")
    if config.fail == "hang":
        time.sleep(600.0)
    parts = [path.read_text() for _, path in sorted(inputs.parts.items()) if path.is_file()]
    (out / "text").write_text(f"({' '.join(parts)})")
    return {"began_at": begun, "niceness": os.nice(0)}


def stage(name: str, *reads: str) -> Stage:
    return Stage(name, 1, BodyConfig, reads, {"text": "text"}, "pair:run", resumable=True)


FIRST = stage("first", "source.photos")
LONG = stage("long", "first.text")
LONGER = stage("longer", "long.text")
SIDE = stage("side", "first.text")
NEXT = stage("next", "side.text")
LAST = stage("last", "longer.text", "next.text")
LINE = (FIRST, LONG, LONGER, SIDE, NEXT, LAST)
AHEAD = {"side": "long", "next": "longer"}
