"""CPU seconds of each stage of finished runs, beside its limit on this machine, and ratios between two sets of runs.

    .venv/bin/python benchmarks line_speed OUT …                       # seconds, limits; a photo, pair and megapixel
    .venv/bin/python benchmarks line_speed OUT … --before OUT …        # ratios to the same captures' earlier runs

Each stage counts as its last finished attempt in `events.jsonl` says: all threads, and child processes that ended. Wall
time is not used, since other work on the machine changes it; CPU time grows, too, where cores are shared, so runs to be
compared are made in turns.

A limit is what a core would take for the operations that a stage cannot do without, at this machine's ceilings, which
are measured now: `line_limits.py` says which. So run it on the machine that made the runs.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from line_limits import ceilings, counts, limits
from tables import Row, console, print_table

from splatpipe.pipeline.engine.events import parse_event
from splatpipe.stages.line import LINE

ALL = "all stages"


@dataclass(frozen=True)
class LineCosts:
    """What the stages of a run cost.

    Attributes:
        name: The run's folder, as it was given.
        cpu_s: CPU seconds by stage; shards count towards their stage.
        photos: Number of photos of the capture.
        megapixels: Their size together.
        pairs: Number of pairs of photos that were matched.
    """

    name: str
    cpu_s: dict[str, float]
    photos: int
    megapixels: float
    pairs: int = 0

    @property
    def total_s(self) -> float:
        """CPU seconds of all stages."""
        return sum(self.cpu_s.values())


def read_costs(out: Path) -> LineCosts:
    """Read what the stages of a run cost.

    Raises:
        ValueError: if the run has no finished `ingest`.
    """
    attempts: dict[str, float] = {}
    photos, megapixels, pairs = 0, 0.0, 0
    with (out / "events.jsonl").open("rb") as file:
        for event in filter(None, map(parse_event, file)):
            if event.kind != "stage_finished" or "cpu_seconds" not in event.data:
                continue
            attempts[event.stage] = float(event.data["cpu_seconds"])
            if event.stage == "ingest":
                photos = int(event.data["summary"]["photos"])
                megapixels = float(event.data["summary"]["megapixels"])
            if event.stage == "matches":
                pairs = int(event.data["summary"]["pairs"])
    if not photos:
        raise ValueError(f"{out} has no finished ingest with its CPU time")
    cpu_s: dict[str, float] = {}
    for name, seconds in attempts.items():
        stage = name.partition(".")[0]
        cpu_s[stage] = cpu_s.get(stage, 0.0) + seconds
    return LineCosts(str(out), cpu_s, photos, megapixels, pairs)


def seconds_table(runs: Sequence[LineCosts]) -> list[Row]:
    """A row for each stage with the CPU seconds in each run, then of all stages, a photo, a megapixel and a pair."""
    stages = [*_stages(runs), ALL]
    rows: list[Row] = [{"stage": stage} | {run.name: _spent(run, stage) for run in runs} for stage in stages]
    rows.append({"stage": "a photo"} | {run.name: run.total_s / run.photos for run in runs})
    rows.append({"stage": "a megapixel"} | {run.name: run.total_s / run.megapixels for run in runs})
    rows.append({"stage": "matches, a pair"} | {run.name: _ratio(_spent(run, "matches"), run.pairs) for run in runs})
    return rows


def limit_table(run: LineCosts, limit_s: Mapping[str, float]) -> list[Row]:
    """A row for each stage of a run: CPU seconds, limit, times over it; milliseconds a photo, a pair and a megapixel.

    The last row is of all stages; its limit and how many times it was taken are of those that have one.

    Args:
        run: The run.
        limit_s: Limits by stage, CPU seconds.
    """
    limited = {stage: limit_s[stage] for stage in _stages([run]) if stage in limit_s}
    rows: list[Row] = []
    for stage in [*_stages([run]), ALL]:
        spent, limit = _spent(run, stage), limited.get(stage)
        over = None if limit is None else spent / limit
        if stage == ALL and limited:
            limit = sum(limited.values())
            over = sum(run.cpu_s[stage] for stage in limited) / limit
        row = {"stage": stage, "CPU s": spent, "limit s": limit, "times": over}
        row |= {"ms a photo": 1e3 * spent / run.photos, "ms a megapixel": 1e3 * spent / run.megapixels}
        rows.append(row | {"ms a pair": _ratio(1e3 * spent, run.pairs) if stage == "matches" else None})
    return rows


def ratio_table(runs: Sequence[LineCosts], before: Sequence[LineCosts]) -> list[Row]:
    """A row for each stage with its CPU time as a share of the earlier run's; the last column is of all runs together.

    Args:
        runs: The new runs.
        before: The earlier runs of the same captures, in the same order.
    """
    pairs = list(zip(runs, before, strict=True))
    rows: list[Row] = []
    for stage in [*_stages(before), ALL]:
        spent = [(_spent(new, stage), _spent(old, stage)) for new, old in pairs]
        totals = (sum(new for new, _ in spent), sum(old for _, old in spent))
        columns = {run.name: _ratio(*pair) for run, pair in zip(runs, spent, strict=True)}
        rows.append({"stage": stage} | columns | {"together": _ratio(*totals)})
    return rows


def _spent(run: LineCosts, stage: str) -> float:
    return run.total_s if stage == ALL else run.cpu_s.get(stage, 0.0)


def _ratio(new_s: float, old_s: float) -> float | None:
    return new_s / old_s if old_s > 0.0 else None


def _stages(runs: Sequence[LineCosts]) -> list[str]:
    return [stage.name for stage in LINE if any(stage.name in run.cpu_s for run in runs)]


def _print(title: str, rows: Sequence[Row]) -> None:
    columns = {name: f"{name}:.{3 if name == 'limit s' else 2}f" for name in rows[0] if name != "stage"}
    print_table(title, rows, {"stage": "stage", **columns})


def print_limits(outs: Sequence[Path], runs: Sequence[LineCosts]) -> None:
    """Print each run's limits, and the machine's ceilings that they come from."""
    for out, run in zip(outs, runs, strict=True):
        numbers = counts(out)
        core = ceilings(out, numbers)
        _print(f"{run.name}: CPU seconds and limits", limit_table(run, limits(numbers, core)))
        console().print("a core, 10⁹/s: " + ", ".join(f"{name} {1e-9 * rate:.3g}" for name, rate in core.items()))


def main() -> None:
    """Print the tables of the runs on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("outs", nargs="+", type=Path, metavar="OUT", help="finished runs")
    parser.add_argument("--before", nargs="+", type=Path, default=[], metavar="OUT", help="earlier ones, in this order")
    options = parser.parse_args()
    if options.before and len(options.before) != len(options.outs):
        parser.error("--before needs as many runs")
    runs, before = ([read_costs(out) for out in outs] for outs in (options.outs, options.before))
    _print("CPU seconds", seconds_table(runs))
    if not before:
        print_limits(options.outs, runs)
    else:
        _print("CPU seconds before", seconds_table(before))
        _print("Share of before", ratio_table(runs, before))


if __name__ == "__main__":
    main()
