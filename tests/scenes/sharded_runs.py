"""Runs of a small pipeline with a stage in shards."""

from pathlib import Path

import sharded

from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.line import StageStatus, line_status
from splatpipe.pipeline.engine.runs.runner import Outcome
from splatpipe.pipeline.engine.runs.session import Request, open_session, status_of
from splatpipe.pipeline.engine.stage import Machine

NUMBERS = (3, 14, 15, 92, 65, 35)

SHARDS = ("sum.1", "sum.2", "sum.3")


def request_of(numbers: Path, out: Path, **sections: dict[str, object]) -> Request:
    return Request(sharded.LINE, resolve(sharded.LineConfig, [sections]), numbers, out, Machine("cpu", 1))


def walk(request: Request, **how: object) -> tuple[Outcome, list[Event]]:
    events: list[Event] = []
    with open_session(request, events.append) as runner:
        return runner.walk(**how), events  # type: ignore[arg-type]


def make_shard(request: Request, number: int) -> Outcome:
    with open_session(request, lambda event: None, shard=f"sum.{number}") as runner:
        return runner.run_shard("sum", number)


def statuses(request: Request) -> dict[str, StageStatus]:
    found = {status.stage.name: status for status in line_status(*status_of(request))}
    return found | {shard.stage.name: shard for status in found.values() for shard in status.shards}
