"""A small real pipeline with a sharded stage: numbers are divided into pieces, summed and merged."""

import json
import os
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

from arithmetic import READ, ReadConfig

from splatpipe.pipeline.engine.runs.needs import Need
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Shards, Stage, StageConfig, Summary

KILL_VARIABLE = "SHARDED_KILL"  # names the shard whose process dies of SIGKILL halfway
FAIL_VARIABLE = "SHARDED_FAIL"  # names the shard that raises
HOLD_VARIABLE = (
    "SHARDED_HOLD"  # a folder: while it has a file of a shard's number, the shard waits before its second step
)


class DivideConfig(StageConfig):
    piece: int = 2
    """Numbers in a piece; 0 leaves them together."""


class SumConfig(StageConfig):
    step_s: float = 0.0
    """Seconds a number."""
    offset: int = 0
    """Added to each square."""


class ShowConfig(StageConfig):
    pass


class LineConfig(StageConfig):
    read: ReadConfig = ReadConfig(at_most=1_000_000)
    divide: DivideConfig = DivideConfig()
    sum: SumConfig = SumConfig()
    show: ShowConfig = ShowConfig()
    train: ClassVar = SimpleNamespace(time_budget_s=0.0)  # no stage: the program asks every run for its budget


def divide(config: DivideConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    numbers = json.loads(inputs["read.numbers"].read_text())
    step = config.piece or max(1, len(numbers))
    pieces = [numbers[at : at + step] for at in range(0, len(numbers), step)] if config.piece else []
    (out / "pieces.json").write_text(json.dumps({"shards": len(pieces), "pieces": pieces}))
    return {"pieces": len(pieces)}


def sum_piece(config: SumConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    assert inputs.shard is not None
    piece = json.loads(inputs["divide.pieces"].read_text())["pieces"][inputs.shard.index]
    checkpoint = out / "checkpoint.json"
    begun, total = json.loads(checkpoint.read_text()) if checkpoint.exists() else (0, 0)
    for at in range(begun, len(piece)):
        report.progress(at, len(piece), "adding", "numbers")
        while at and (hold := os.environ.get(HOLD_VARIABLE)) and Path(hold, str(inputs.shard.number)).exists():
            time.sleep(0.05)
        time.sleep(config.step_s)
        total += piece[at] ** 2 + config.offset
        checkpoint.with_suffix(".new").write_text(json.dumps([at + 1, total]))
        checkpoint.with_suffix(".new").replace(checkpoint)
        if os.environ.get(KILL_VARIABLE) == str(inputs.shard.number) and at + 1 > begun:
            os.kill(os.getpid(), signal.SIGKILL)
        if os.environ.get(FAIL_VARIABLE) == str(inputs.shard.number):
            raise ValueError("out of order")
    (out / "sum.txt").write_text(str(total))
    return {"sum": total, "began_at": begun}


def add_sums(config: SumConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    assert inputs.shard is None
    sums = [int((folder / "sum.txt").read_text()) for folder in inputs.shards]
    reported = [inputs.summaries[f"sum.{number}"]["sum"] for number in range(1, len(sums) + 1)]
    assert reported == sums
    if not inputs.shards:
        sums = [sum(number**2 + config.offset for number in json.loads(inputs["read.numbers"].read_text()))]
    (out / "total.json").write_text(json.dumps({"total": sum(sums), "sums": sums}))
    return {"total": sum(sums)}


def show(config: ShowConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    (out / "shown.txt").write_text(str(json.loads(inputs["sum.total"].read_text())["total"]))
    return {}


DIVIDE = Stage("divide", 1, DivideConfig, ("read.numbers",), {"pieces": "pieces.json"}, "sharded:divide")
SUM = Stage(
    "sum",
    1,
    SumConfig,
    ("read.numbers", "divide.pieces"),
    {"total": "total.json"},
    "sharded:add_sums",
    shards=Shards("divide.pieces", {"sum": "sum.txt"}, "sharded:sum_piece", resumable=True),
)
SHOW = Stage("show", 1, ShowConfig, ("sum.total",), {"shown": "shown.txt"}, "sharded:show", deliverables=("shown",))

LINE = (READ, DIVIDE, SUM, SHOW)
AHEAD: dict[str, str] = {}


@dataclass(frozen=True)
class Forecaster:
    """The pipeline's cost, for tests in which the whole program runs it (`sharded_site`)."""

    config: LineConfig
    threads: int

    def __call__(self, _summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
        return RunForecast.of(None, self.config).needs(1.0)


class RunForecast:
    """A hundred million bytes a stage; half of the disk's and a tenth of the time for the third shard."""

    training = SimpleNamespace(division=None)

    @staticmethod
    def of(_size: object, _config: LineConfig, _threads: int = 1, _machine_bytes: int = 0) -> "RunForecast":
        return RunForecast()

    def needs(self, _speed: float) -> dict[str, Need]:
        needs = {stage.name: Need(100_000_000, 60.0, 8_000_000) for stage in LINE}
        return needs | {"sum.3": Need(100_000_000, 6.0, 4_000_000)}


def has_control(_source: object) -> bool:
    return False


def machine_speed() -> float:
    return 1.0
