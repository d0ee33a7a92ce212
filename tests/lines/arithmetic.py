"""A small real pipeline for the engine's tests: reads numbers from files, adds, multiplies, prints a report."""

import json
import os
import signal
import sys
import time
from pathlib import Path

from rich.console import Console

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Stage, StageConfig, Summary


class ReadConfig(StageConfig):
    at_most: int = 100
    """Numbers above this are left out."""


class AddConfig(StageConfig):
    offset: int = 0
    """Added to the sum."""
    seed: int = 0
    """Exists only to be set."""


class CountConfig(StageConfig):
    enabled: bool = True
    """Count at all."""
    steps: int = 3
    """How far to count."""
    step_s: float = 0.0
    """Seconds a step."""
    fail: str = ""
    """How to fail, if at all."""


class TellConfig(StageConfig):
    loud: bool = False
    """Print in capitals."""


class LineConfig(StageConfig):
    read: ReadConfig = ReadConfig()
    add: AddConfig = AddConfig()
    count: CountConfig = CountConfig()
    tell: TellConfig = TellConfig()


def read(config: ReadConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    files = sorted(inputs["source.photos"].glob("*.txt"))
    numbers = [int(path.read_text()) for path in files]
    if not numbers:
        raise SplatpipeError("There are no numbers.", hint="Put some in.")
    kept = [number for number in numbers if number <= config.at_most]
    (out / "numbers.json").write_text(json.dumps(kept))
    (out / "left_out.json").write_text(json.dumps(len(numbers) - len(kept)))
    (out / "scratch.tmp").write_text("belongs to no part")
    report.progress(len(files), len(files), "reading", "files")
    return {"numbers": len(kept)}


def add(config: AddConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    total = sum(json.loads(inputs["read.numbers"].read_text())) + config.offset
    (out / "parts").mkdir()
    (out / "parts" / "parity.txt").write_text(str(total % 2))
    (out / "total.txt").write_text(str(total))
    return {"total": total}


def count(config: CountConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    if not config.enabled:
        (out / "count.txt").write_text(f"nothing of {len(inputs.parts)} parts")
        return {}
    checkpoint = out / "checkpoint"
    begun = int(checkpoint.read_text()) if checkpoint.exists() else 0
    for step in range(begun, config.steps):
        report.progress(step, config.steps, "counting", "steps")
        time.sleep(config.step_s)
        checkpoint.with_suffix(".new").write_text(str(step + 1))
        checkpoint.with_suffix(".new").replace(checkpoint)
    if config.fail == "abort":
        os.abort()
    if config.fail == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if config.fail == "raise":
        raise ValueError("out of order")
    if config.fail == "disk":
        raise OSError(28, "No space left on device", "somewhere")
    if config.fail == "fill":
        with (out / "much").open("wb") as file:
            for _ in range(64):
                file.write(bytes(1 << 20))
    if config.fail == "colours":
        Console(file=sys.stderr).print("[red]no terminal here")
    if config.fail == "deaf":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(60)
    if config.fail == "forget":
        return {}
    (out / "count.txt").write_text(
        f"{config.steps} {(inputs['add.parity'] / 'parity.txt').read_text()} {inputs.settings['tell.loud']}"
    )
    return {"began_at": begun}


def tell(config: TellConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    text = inputs["count.count"].read_text() + " " + inputs["add.total"].read_text()
    (out / "telling.txt").write_text(text.upper() if config.loud else text)
    (out / "more").mkdir()
    if config.loud:
        (out / "more" / "echo.txt").write_text(text.upper())
    return {"length": len(text)}


READ = Stage(
    "read",
    1,
    ReadConfig,
    ("source.photos",),
    {"numbers": "numbers.json", "left_out": "left_out.json"},
    "arithmetic:read",
)
ADD = Stage("add", 1, AddConfig, ("read.numbers",), {"total": "total.txt", "parity": "parts"}, "arithmetic:add")
COUNT = Stage(
    "count", 1, CountConfig, ("add.parity",), {"count": "count.txt"}, "arithmetic:count", ("tell.loud",), resumable=True
)
TELL = Stage(
    "tell",
    1,
    TellConfig,
    ("count.count", "add.total"),
    {"telling": "telling.txt", "more": "more"},
    "arithmetic:tell",
    deliverables=("telling", "more"),
)

LINE = (READ, ADD, COUNT, TELL)
