"""Stages that run ahead of their turn beside others: which, when, and how both of them end."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pair
import pytest
from quick_line import part_digests
from timeouts import TIMEOUT_S, wait_until

from splatpipe.pipeline.app.library.requests import IN_TURN_VARIABLE
from splatpipe.pipeline.app.library.requests import request_of as command_request
from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.machine import available_memory_bytes
from splatpipe.pipeline.engine.runs.ahead import NICENESS
from splatpipe.pipeline.engine.runs.needs import Need
from splatpipe.pipeline.engine.runs.runner import Outcome
from splatpipe.pipeline.engine.runs.session import Request, open_session
from splatpipe.pipeline.engine.stage import Machine
from splatpipe.stages.line import AHEAD, LINE
from splatpipe.stages.options import LineConfig

pytestmark = pytest.mark.usefixtures("lines")

NAMES = [stage.name for stage in pair.LINE]
SMALL = dict.fromkeys(NAMES, Need(1 << 20, 1.0, 1))


@pytest.fixture
def numbers(tmp_path: Path) -> Path:
    folder = tmp_path / "numbers"
    folder.mkdir()
    (folder / "a.txt").write_text("1")
    return folder


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def meet(tmp_path: Path) -> str:
    folder = tmp_path / "meet"
    folder.mkdir()
    return str(folder)


def request_of(numbers: Path, out: Path, threads: int = 2, **sections: dict[str, object]) -> Request:
    config = resolve(pair.LineConfig, [sections])
    return Request(pair.LINE, config, numbers, out, Machine("cpu", threads), lambda _: SMALL, pair.AHEAD)


def walk(request: Request, events: list[Event] | None = None, **how: object) -> Outcome:
    with open_session(request, (events if events is not None else []).append) as runner:
        return runner.walk(**how)  # type: ignore[arg-type]


def order(events: list[Event], *kinds: str) -> list[str]:
    """Return what happened to the stages, in order, e.g. ``started side``."""
    wanted = [f"stage_{kind}" for kind in kinds or ("started", "reused", "finished", "failed")]
    return [f"{event.kind.removeprefix('stage_')} {event.stage}" for event in events if event.kind in wanted]


def test_a_stage_runs_beside_another_and_leaves_the_same_bits(numbers: Path, out: Path, meet: str) -> None:
    """Each of the two waits until the other has begun."""
    events: list[Event] = []
    both = {"long": {"meet": meet, "awaits": "side"}, "side": {"meet": meet, "awaits": "long"}}
    outcome = walk(request_of(numbers, out, **both), events)
    assert outcome.ran == NAMES and not outcome.failed
    happened = order(events)
    assert sorted(happened) == sorted(f"{what} {name}" for name in NAMES for what in ("started", "finished"))
    begun = max(happened.index("started long"), happened.index("started side"))
    assert begun < min(happened.index("finished long"), happened.index("finished side"))
    niceness = {name: outcome.artifacts[name].summary["niceness"] for name in ("long", "side")}
    assert niceness["side"] == min(19, niceness["long"] + NICENESS)  # 19: as far back as it goes
    assert [name for name in NAMES if outcome.artifacts[name].manifest.get("ahead")][:1] == ["side"]
    in_turn = out.with_name("in turn")
    walk(replace(request_of(numbers, in_turn), ahead={}))
    assert part_digests(out) == part_digests(in_turn)
    assert walk(request_of(numbers, out, **both)).ran == []


def too_large(*names: str) -> dict[str, Need]:
    return SMALL | dict.fromkeys(names, Need(2 * available_memory_bytes(), 1.0, 1))


@pytest.mark.parametrize(
    "changed",
    [
        {"machine": Machine("cpu", 1)},
        {"machine": Machine("cpu", 2, memory_bytes=1 << 20)},
        {"forecast_needs": lambda _: too_large("side", "next")},
        {"forecast_needs": lambda _: too_large("long", "longer")},
        {"forecast_needs": lambda _: {"side": SMALL["side"]}},
        {"ahead": {}},
        {"ahead": {"side": "side", "next": "last"}},
    ],
    ids=["one thread", "limit", "large", "beside large", "no forecast", "none", "only later"],
)
def test_without_a_core_memory_or_leave_each_stage_runs_in_its_turn(
    numbers: Path, out: Path, changed: dict[str, object]
) -> None:
    events: list[Event] = []
    walk(replace(request_of(numbers, out), **changed), events)  # type: ignore[arg-type]
    assert order(events) == [f"{what} {name}" for name in NAMES for what in ("started", "finished")]


def test_a_stage_that_does_not_fit_beside_the_next_is_waited_for(numbers: Path, out: Path, meet: str) -> None:
    events: list[Event] = []
    request = request_of(numbers, out, long={"meet": meet, "awaits": "side"}, side={"meet": meet})
    walk(replace(request, forecast_needs=lambda _: too_large("longer")), events)
    happened = order(events)
    assert happened.index("started side") < happened.index("finished long")
    assert happened.index("finished side") < happened.index("started longer")


def test_what_becomes_ready_runs_ahead_too(numbers: Path, out: Path, meet: str) -> None:
    events: list[Event] = []
    where = {"meet": meet}
    walk(request_of(numbers, out, longer={**where, "awaits": "next"}, side=where, next=where), events)
    happened = order(events)
    assert happened.index("finished side") < happened.index("started next") < happened.index("finished longer")


def test_a_valid_stage_is_reused_and_what_follows_it_runs_ahead(numbers: Path, out: Path, meet: str) -> None:
    walk(request_of(numbers, out), until="side")
    events: list[Event] = []
    outcome = walk(request_of(numbers, out, longer={"meet": meet, "awaits": "next"}, next={"meet": meet}), events)
    assert outcome.ran == ["long", "longer", "next", "last"]
    assert order(events, "reused") == ["reused first", "reused side"]


def test_a_stage_that_is_to_run_again_does_so_once_and_first(numbers: Path, out: Path, meet: str) -> None:
    """Its earlier result is not taken for what it is going to leave."""
    walk(request_of(numbers, out))
    events: list[Event] = []
    both = {"long": {"meet": meet, "awaits": "side"}, "side": {"meet": meet}, "next": {"meet": meet}}
    assert walk(request_of(numbers, out, **both), events, rerun=frozenset({"long", "side", "next"})).ran == [
        "long",
        "side",
        "next",
    ]
    happened = order(events)
    assert happened.index("started side") < happened.index("finished long")
    assert happened.index("finished side") < happened.index("started next")


def test_a_failure_ahead_is_raised_in_its_turn(numbers: Path, out: Path, meet: str) -> None:
    events: list[Event] = []
    failing = {"long": {"meet": meet, "awaits": "side"}, "side": {"meet": meet, "fail": "input"}}
    request = request_of(numbers, out, **failing)
    with pytest.raises(SplatpipeError, match="no good"), open_session(request, events.append) as runner:
        runner.walk()
    assert runner.outcome.ran == ["first", "long", "longer"] and runner.outcome.failed == "side"
    happened = order(events)
    assert happened.count("failed side") == happened.count("started side") == 1
    assert happened.index("started side") < happened.index("finished long")
    assert events[-1].kind == "run_finished" and events[-1].data["exit_code"] == 1
    assert walk(request_of(numbers, out, long=failing["long"])).ran == ["side", "next", "last"]


@pytest.mark.parametrize("fail", ["kill", "memory"])
def test_a_stage_that_dies_ahead_of_want_of_memory_goes_on_in_its_turn(
    numbers: Path, out: Path, meet: str, fail: str
) -> None:
    events: list[Event] = []
    both = {"long": {"meet": meet, "awaits": "side"}, "side": {"meet": meet, "fail": fail}}
    outcome = walk(request_of(numbers, out, **both), events)
    assert outcome.ran == NAMES and outcome.artifacts["side"].summary["began_at"] == 1
    assert "ahead" not in outcome.artifacts["side"].manifest
    assert order(events, "failed") == ["failed side"] and order(events, "started").count("started side") == 2
    assert any(event.kind == "note" and event.stage == "side" for event in events)


def is_gone(meet: str, name: str) -> bool:
    return not Path("/proc", Path(meet, name).read_text()).exists()


def test_a_failure_ends_the_stage_beside(numbers: Path, out: Path, meet: str) -> None:
    events: list[Event] = []
    long = {"meet": meet, "awaits": "side", "fail": "input"}
    side = {"meet": meet, "fail": "hang"}
    with pytest.raises(SplatpipeError, match="no good"):
        walk(request_of(numbers, out, long=long, side=side), events)
    assert is_gone(meet, "long") and is_gone(meet, "side")
    failed = {event.stage: event.data for event in events if event.kind == "stage_failed"}
    assert {name: data["exit_code"] for name, data in failed.items()} == {"long": 1, "side": 143}
    assert failed["side"]["message"] == "Stopped." and failed["side"]["peak_memory_bytes"] > 0
    assert [event.data["exit_code"] for event in events if event.kind == "run_finished"] == [1]
    assert events[-1].kind == "run_finished"
    assert walk(request_of(numbers, out)).artifacts["side"].summary["began_at"] == 0  # other options: another key


def test_what_a_callback_raises_ends_the_run_from_either_thread(numbers: Path, out: Path, meet: str) -> None:
    def show(event: Event) -> None:
        if event.kind == "progress" and event.stage == "side":
            raise KeyError("the caller's own")

    both = {"long": {"meet": meet, "awaits": "side"}, "side": {"meet": meet}}
    with pytest.raises(KeyError), open_session(request_of(numbers, out, **both), show) as runner:
        runner.walk()
    assert "side" not in runner.outcome.ran


def in_background(numbers: Path, out: Path, meet: str) -> subprocess.Popen[str]:
    """Start a run of which both stages hang, with the handlers of the command line."""
    code = (
        "import signal, sys, pair; from pathlib import Path\n"
        "from splatpipe.pipeline.app.cli.main import _stop\n"
        "from splatpipe.pipeline.engine.config import resolve\n"
        "from splatpipe.pipeline.engine.errors import StopSignal\n"
        "from splatpipe.pipeline.engine.runs.needs import Need\n"
        "from splatpipe.pipeline.engine.runs.session import Request, open_session\n"
        "from splatpipe.pipeline.engine.stage import Machine\n"
        "for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, _stop)\n"
        f"hangs = {{'meet': {meet!r}, 'fail': 'hang'}}\n"
        "config = resolve(pair.LineConfig, [{'long': hangs, 'side': hangs}])\n"
        "needs = dict.fromkeys((stage.name for stage in pair.LINE), Need(1, 1.0, 1))\n"
        f"places = Path({str(numbers)!r}), Path({str(out)!r})\n"
        "request = Request(pair.LINE, config, *places, Machine('cpu', 2), lambda _: needs, pair.AHEAD)\n"
        "try:\n"
        "    with open_session(request, lambda event: None) as runner: runner.walk()\n"
        "except StopSignal as error: sys.exit(error.exit_code)\n"
    )
    return subprocess.Popen([sys.executable, "-c", code], start_new_session=True, text=True)


@pytest.mark.parametrize(
    ("send", "code"),
    [
        (lambda process: os.killpg(process.pid, signal.SIGINT), 130),
        (lambda process: process.send_signal(signal.SIGTERM), 143),
        (lambda process: os.killpg(process.pid, signal.SIGTERM), 143),
        (lambda process: process.kill(), -signal.SIGKILL),
    ],
    ids=["Ctrl-C", "SIGTERM", "SIGTERM to all", "SIGKILL"],
)
def test_an_end_is_the_end_of_both_and_both_go_on(
    numbers: Path, out: Path, meet: str, send: Callable[[subprocess.Popen[str]], None], code: int
) -> None:
    with in_background(numbers, out, meet) as process:
        wait_until(
            lambda: {"long", "side"} <= {path.name for path in Path(meet).iterdir()} or process.poll() is not None,
            "both stages",
        )
        send(process)
        assert process.wait(TIMEOUT_S) == code
    wait_until(lambda: is_gone(meet, "long") and is_gone(meet, "side"), "the workers' end")
    partial = out / "stages" / ".partial"
    assert {path.name.partition("-")[0] for path in partial.iterdir()} == {"long", "side"}
    hangs = {"meet": meet, "fail": "hang"}
    request = request_of(numbers, out, long=hangs, side=hangs)
    seen: list[Event] = []

    def stop(event: Event) -> None:
        seen.append(event)
        if {each.stage for each in seen if each.kind == "progress"} >= {"long", "side"}:
            raise KeyError("enough")

    with pytest.raises(KeyError), open_session(request, stop) as runner:
        runner.walk()
    assert {event.stage: event.data["done"] for event in seen if event.kind == "progress"} == {"long": 1, "side": 1}


def test_a_crash_ahead_is_raised_in_its_turn(numbers: Path, out: Path, meet: str) -> None:
    both = {"long": {"meet": meet, "awaits": "side"}, "side": {"meet": meet, "fail": "abort"}}
    with pytest.raises(StageError, match="SIGABRT"):
        walk(request_of(numbers, out, **both))


@pytest.mark.parametrize(
    ("options", "shared", "ahead"),
    [({}, False, True), ({"time_budget_s": 600.0}, False, False), ({}, True, False)],
    ids=["usual", "time budget", "shared machine"],
)
def test_stages_of_a_command_run_ahead_unless_its_time_or_memory_are_given(
    numbers: Path, out: Path, options: dict[str, object], shared: bool, ahead: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shared:
        monkeypatch.setenv(IN_TURN_VARIABLE, "1")
    config = resolve(LineConfig, [{"train": options}])
    assert bool(command_request(numbers, out, config, "cpu", 2).ahead) is ahead


def test_stages_run_ahead_only_beside_earlier_ones_that_leave_what_they_read() -> None:
    """And nothing is waited for that could not be there: every stage after `export` but those that render."""
    names = [stage.name for stage in LINE]
    for name, first in AHEAD.items():
        assert names.index(first) < names.index(name)
    assert set(names[names.index("export") + 1 :]) - set(AHEAD) == {"splat_depths", "flythrough"}
