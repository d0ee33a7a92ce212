"""Runs of a small pipeline, and what is left of them."""

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import arithmetic

from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.events import Event, parse_event
from splatpipe.pipeline.engine.runs.runner import Outcome
from splatpipe.pipeline.engine.runs.session import Request, open_session
from splatpipe.pipeline.engine.stage import Machine

LINE = ["read", "add", "count", "tell"]


def request_of(numbers: Path, out: Path, **count: object) -> Request:
    return Request(arithmetic.LINE, resolve(arithmetic.LineConfig, [{"count": count}]), numbers, out, Machine("cpu", 1))


def walk(request: Request, show: Callable[[Event], object] = lambda event: None) -> Outcome:
    with open_session(request, show) as runner:
        return runner.walk()


def events(out: Path) -> list[Event]:
    """Return the logged events; every line is one."""
    found = [parse_event(line) for line in (out / "events.jsonl").read_bytes().split(b"\n")[:-1]]
    assert None not in found
    return [event for event in found if event is not None]


def goes_on(numbers: Path, out: Path, ran: list[str]) -> None:
    """The next run does what is missing, and no more."""
    assert walk(request_of(numbers, out)).ran == ran
    assert (out / "telling.txt").read_text() == "3 1 False 21"
    assert events(out)[-1].data["exit_code"] == 0


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """A file size limit enforced by the kernel, also for workers: another way of having no space."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
