"""``make test``: the unit tests, the tests of parts, and the slow groups whose sources changed.

    python tests/records/suite.py                 both rings, and the groups that changed
    python tests/records/suite.py --all           both rings and every group
    python tests/records/suite.py unit kills      only these

Rings and groups run one after the other; the first that fails ends it.
"""

from __future__ import annotations

import argparse
import datetime
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from groups import OLD_DAYS, ROOT, Group, groups, passes, record_pass

RINGS = ("unit", "parts")
MAX_WORKERS = 8


@dataclass(frozen=True)
class Cost:
    """What a ring or a group took."""

    name: str
    wall_s: float
    cpu_s: float


def main() -> int:
    """Run the command; return the exit code of the first ring or group that failed, otherwise 0."""
    parser = argparse.ArgumentParser(prog="make test", description=__doc__.split("\n")[0])
    every = {group.name: group for group in groups()}
    parser.add_argument("only", nargs="*", metavar="NAME", help=f"one of {', '.join((*RINGS, *every))}")
    parser.add_argument("--all", action="store_true", help="every group, whether its sources changed or not")
    given = parser.parse_args()
    unknown = [name for name in given.only if name not in (*RINGS, *every)]
    if unknown:
        parser.error(f"there is no ring or group {unknown[0]}")
    today = datetime.datetime.now(datetime.UTC).date()
    left_out = {
        name: why for name, group in every.items() if not given.all and (why := why_left_out(group, ROOT, today))
    }
    left_out |= {name: f"there is no {group.needs}" for name, group in every.items() if not can_run(group, ROOT)}
    names = given.only or [name for name in (*RINGS, *every) if name not in left_out]
    costs: list[Cost] = []
    code = 0
    for name in names:
        code, cost = _run(name, every.get(name))
        costs.append(cost)
        if code:
            break
    _summarize(costs, {} if given.only else left_out)
    if code:
        _say(f"{costs[-1].name} FAILED")
    return code


def can_run(group: Group, root: Path) -> bool:
    """Whether what a group needs exists."""
    return not group.needs or (root / group.needs).exists()


def why_left_out(group: Group, root: Path, today: datetime.date) -> str:
    """Return why a group need not run; empty if it has to."""
    last = passes(root).get(group.name)
    if last is None or last.sources != group.digest(root):
        return ""
    days = (today - last.day).days
    old = f", {days} days ago: run `make test-all` some time" if days > OLD_DAYS else ""
    return f"its sources are those of its last pass on {last.day}{old}"


def _run(name: str, group: Group | None) -> tuple[int, Cost]:
    """Run a ring or a group, and record a group's pass."""
    _say(f"== {name}{f': {group.what}' if group else ''}")
    digest = group.digest(ROOT) if group else ""
    command = (
        list(group.command) if group and group.command else _pytest(str(group.folder if group else f"tests/{name}"))
    )
    begin = time.monotonic()
    process = subprocess.Popen(command, cwd=ROOT)
    try:
        _, status, used = os.wait4(process.pid, 0)
    except KeyboardInterrupt:
        os.wait4(process.pid, 0)  # the terminal has interrupted it as well
        raise SystemExit(130) from None
    process.returncode = code = os.waitstatus_to_exitcode(status)
    if group and not code:
        record_pass(group, digest, datetime.datetime.now(datetime.UTC).date())
    return code, Cost(name, time.monotonic() - begin, used.ru_utime + used.ru_stime)


def _pytest(folder: str) -> list[str]:
    """Return the command that runs a folder's tests, on all cores: a file's in one worker, as they share fixtures."""
    workers = ["-n", "logical", "--maxprocesses", str(MAX_WORKERS), "--dist", "loadfile", "--no-loadscope-reorder"]
    chosen = [] if folder.endswith("device") else ["-m", "not cuda"]
    return [sys.executable, "-m", "pytest", "-q", *chosen, *workers, folder]


def _summarize(costs: list[Cost], left_out: dict[str, str]) -> None:
    _say("\nring or group      seconds   CPU s")
    total = Cost("together", sum(cost.wall_s for cost in costs), sum(cost.cpu_s for cost in costs))
    for cost in (*costs, total):
        _say(f"{cost.name:16} {cost.wall_s:9.0f} {cost.cpu_s:7.0f}")
    for name, why in left_out.items():
        _say(f"left out: {name} ({why})")


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
