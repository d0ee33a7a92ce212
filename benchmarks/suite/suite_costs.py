"""Where the tests' time goes: a pytest plugin that records every test's cost, and its summary.

    PYTHONPATH=benchmarks/suite SUITE_COSTS=costs.jsonl .venv/bin/python -m pytest -p suite_costs -n 2 --dist loadfile …
    .venv/bin/python benchmarks suite_costs costs.jsonl [--most 100]

A row per test and phase: seconds, CPU seconds of its own process, of children that ended and of those still running (a
browser), and what it used. Children of children count once their parents have waited for them.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

RESULTS = "SUITE_COSTS"  # names the file that rows are appended to, by several workers
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
COMPILERS = ("c++", "g++", "cc", "nvcc", "ninja", "cmake")
BROWSERS = ("chromium", "chrome", "node")  # node: the driver of the browser
STARTS = ("subprocess.Popen", "os.posix_spawn", "os.fork", "os.exec")


@dataclass
class Clocks:
    """Seconds since some moment: elapsed, CPU of this process, of ended children, of running descendants."""

    wall: float
    own: float
    ended: float
    running: float

    @staticmethod
    def now() -> Clocks:
        own, ended = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        return Clocks(
            time.monotonic(), own.ru_utime + own.ru_stime, ended.ru_utime + ended.ru_stime, _running_s(os.getpid())
        )

    def since(self, before: Clocks) -> dict[str, float]:
        """Return the differences. What ran before and has ended since moves from one column to another."""
        children = self.ended + self.running - before.ended - before.running
        return {"wall_s": self.wall - before.wall, "own_s": self.own - before.own, "children_s": max(children, 0.0)}


def _running_s(pid: int) -> float:
    """Return the CPU seconds of a process's running descendants, and of those that they have waited for."""
    total = 0.0
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = listed.read_text().split()
        except OSError:
            continue
        for child in children:
            try:
                fields = Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            total += TICK_S * sum(map(int, fields[11:15])) + _running_s(int(child))
    return total


_started: list[str] = []


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if event in STARTS:
        command = arguments[1] if event == "subprocess.Popen" else arguments[0] if arguments else event
        words = [os.fsdecode(word) for word in command] if isinstance(command, list | tuple) else [str(command)]
        _started.append(_kind(words))


def _kind(words: list[str]) -> str:
    """Return the kind of a started program."""
    name = Path(words[0]).name if words else ""
    if name in COMPILERS:
        return "compiler"
    if name.startswith(BROWSERS):
        return "browser"
    return "python" if name.startswith("python") else f"program {name}"


def pytest_configure() -> None:
    sys.addaudithook(_watch)


def _write(row: dict[str, Any]) -> None:
    with Path(os.environ[RESULTS]).open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Generator[None, object, object]:
    before = Clocks.now()
    result = yield
    _write({"test": "", "phase": "collection", **Clocks.now().since(before), "used": []})
    return result


def _measured(item: pytest.Item, phase: str) -> Generator[None, object, object]:
    _started.clear()
    before = Clocks.now()
    try:
        return (yield)
    finally:
        used = sorted(set(_started) | {name for name in ("demo_run", "open_page") if name in item.fixturenames})
        _write({"test": item.nodeid, "phase": phase, **Clocks.now().since(before), "used": used})


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, object, object]:
    return (yield from _measured(item, "setup"))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    return (yield from _measured(item, "call"))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, object, object]:
    return (yield from _measured(item, "teardown"))


def summed(rows: Iterable[dict[str, Any]], key: Any) -> list[tuple[str, float, float, int]]:
    """Return (key, seconds, CPU seconds, tests) of rows that share a key, the dearest first."""
    found: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    tests: dict[str, set[str]] = defaultdict(set)
    for row in rows:
        group = key(row)
        found[group][0] += row["wall_s"]
        found[group][1] += row["own_s"] + row["children_s"]
        tests[group].add(row["test"])
    table = [(group, wall, cpu, len(tests[group])) for group, (wall, cpu) in found.items()]
    return sorted(table, key=lambda entry: -entry[2])


def main() -> None:
    parser = argparse.ArgumentParser(description="Summarize where the tests' time went.")
    parser.add_argument("costs", type=Path)
    parser.add_argument("--most", type=int, default=50, help="Rows per table.")
    given = parser.parse_args()
    rows = [json.loads(line) for line in given.costs.read_text(encoding="utf-8").splitlines()]
    used: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        used[row["test"]].update(row["used"])
    tables = {
        "by what they use": lambda row: (
            " + ".join(sorted(used[row["test"]])) or row["phase"] * (not row["test"]) or "-"
        ),
        "by folder": lambda row: str(Path(row["test"].split("::")[0]).parent),
        "by file": lambda row: row["test"].split("::")[0],
        "by test": lambda row: row["test"],
    }
    for title, key in tables.items():
        print(f"\n{title}: seconds, CPU seconds, tests")
        for group, wall, cpu, tests in summed(rows, key)[: given.most]:
            print(f"{wall:9.1f} {cpu:9.1f} {tests:6d}  {group}")


if __name__ == "__main__":
    main()
