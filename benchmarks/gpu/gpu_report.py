"""Turn the files of a visit to a GPU into the tables of docs/gpu_visit.md, and say which demands hold.

``gpu_report FOLDER/first.jsonl FOLDER/second.jsonl --pack .gpu_visit``. A demand on correctness that does not hold
ends it with exit code 1; a factor against a peer that is missed is a finding, no failure.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

from gpu_parts import Row, read_lines

MIN_DB, MAX_RELATIVE = 60.0, 1e-3  # agreement with the CPU: PSNR of a render, relative error of a gradient
GOALS = {"gsplat": 2.0, "faster-gs": 1.0}  # iterations a second against the peer's, at least
MAX_MEMORY_SHARE = 0.6  # largest memory use over gsplat's
MAX_DIFFERENCE_DB, STANDARD_ERRORS = 0.1, 2.0  # by which a training's psnr_cc may differ from the CPU's
CHECKS = ("memcheck", "racecheck", "synccheck", "initcheck")
HOLDS, FAILS, MISSED, UNKNOWN = "holds", "**does not hold**", "missed (a finding)", "not measured"


@dataclass(frozen=True)
class Verdict:
    """A demand, what was measured, and whether it holds."""

    demand: str
    measured: str
    state: str


class VisitRecord:
    """Everything that the files of a visit say; later files replace earlier outcomes of the same part.

    Args:
        paths: The files, the first call's first.
        carried: Rows of the CPU's trainings.
    """

    def __init__(self, paths: Sequence[Path], carried: Sequence[Row]) -> None:
        self.carried = list(carried)
        self.calls: list[Row] = []
        self.states: dict[str, Row] = {}
        self._rows: dict[str, list[Row]] = {}
        for path in paths:
            again = set()
            for line in read_lines(path):
                name = line.get("part")
                if "call" in line:
                    self.calls.append(line)
                elif name is not None and "row" in line:
                    if name not in again:
                        self._rows[name] = []
                        again.add(name)
                    self._rows[name].append(line["row"])
                elif name is not None and not (line["state"] == "not begun" and name in self.states):
                    self.states[name] = line

    def rows(self, *keys: str, without: Sequence[str] = ()) -> list[Row]:
        """Return the rows that have some keys and lack others."""
        every = [row for rows in self._rows.values() for row in rows]
        return [row for row in every if set(keys) <= row.keys() and row.keys().isdisjoint(without)]

    def of(self, part: str) -> list[Row]:
        """Return a part's rows."""
        return self._rows.get(part, [])

    def card(self) -> Row:
        """Return what nvidia-smi said; empty if nothing."""
        return next(iter(self.of("the card")), {})


def verdicts(record: VisitRecord) -> Iterator[Verdict]:
    """Yield every demand with its verdict."""
    views = record.rows("psnr_db", "gradients")
    yield judged(
        f"renders ≥ {MIN_DB:.0f} dB from the CPU's",
        [row["psnr_db"] for row in views],
        lambda worst: worst >= MIN_DB,
        "{:.1f} dB",
        min,
    )
    gradients = [value for row in views for value in row["gradients"].values()]
    yield judged(
        f"gradients within {MAX_RELATIVE:g} of the CPU's", gradients, lambda worst: worst <= MAX_RELATIVE, "{:.1e}", max
    )
    same = [row["same"] for row in record.of("the same bits twice")]
    yield judged("the same bits twice", same, bool, "{}", min)
    yield passed(record, "tests marked cuda", "the tests on the device pass")
    for tool in CHECKS:
        yield passed(record, tool, f"{tool} finds nothing")
    same = [row["same"] for row in record.of("features")]
    yield judged("features have the same bits from run to run", same, bool, "{}", min)
    for peer, goal in GOALS.items():
        for ours, theirs in pairs(record, peer):
            factor = theirs["iteration_ms"] / ours["iteration_ms"]
            state = HOLDS if factor >= goal else MISSED
            demand = f"≥ {goal:g} times {peer}'s iterations, {named(ours)}"
            yield Verdict(demand, f"{factor:.2f} times", state)
            if peer == "gsplat" and ours["peak_gb"] and theirs["peak_gb"]:
                share = ours["peak_gb"] / theirs["peak_gb"]
                state = HOLDS if share <= MAX_MEMORY_SHARE else MISSED
                yield Verdict(f"≤ {MAX_MEMORY_SHARE:g} of gsplat's memory, {named(ours)}", f"{share:.2f}", state)
        if not any(True for _ in pairs(record, peer)):
            yield Verdict(f"≥ {goal:g} times {peer}'s iterations", "", UNKNOWN)
    yield as_the_cpu(record)


def judged(demand: str, values: Sequence[float], holds: object, number_format: str, worst: object) -> Verdict:
    """Return the verdict of the worst of some values; NaN does not hold."""
    if not values:
        return Verdict(demand, "", UNKNOWN)
    value = math.nan if any(math.isnan(each) for each in values) else worst(values)
    return Verdict(demand, number_format.format(value), HOLDS if holds(value) else FAILS)


def passed(record: VisitRecord, part: str, demand: str) -> Verdict:
    """Return the verdict of a part that only has to succeed."""
    outcome = record.states.get(part)
    if outcome is None or outcome["state"] == "not begun":
        return Verdict(demand, "", UNKNOWN)
    if outcome["state"] == "refused":
        return Verdict(demand, "refused by the machine", UNKNOWN)
    last = next((row["tests"] for row in record.of(part) if "tests" in row), outcome["state"])
    return Verdict(demand, last, HOLDS if outcome["state"] == "done" else FAILS)


def pairs(record: VisitRecord, peer: str) -> Iterator[tuple[Row, Row]]:
    """Yield our iterations and a peer's of the same scene."""
    for theirs in record.rows("peer", "iteration_ms"):
        if theirs["peer"] == peer and "raster_ms" in theirs:
            for ours in plain(record):
                if named(ours) == named(theirs):
                    yield ours, theirs


def plain(record: VisitRecord) -> list[Row]:
    """Return the rows of our plain iterations."""
    return [row for row in record.rows("iteration_ms", "host_ms", without=("peer",)) if not row["preset"]]


def named(row: Row) -> str:
    """Return a scene's name."""
    return f"{row['count']:,} ({row['scene']})"


def as_the_cpu(record: VisitRecord) -> Verdict:
    """Compare the mean psnr_cc of the trainings with the carried one of the CPU's."""
    demand = f"psnr_cc within {MAX_DIFFERENCE_DB} dB + {STANDARD_ERRORS:g} standard errors of the CPU's"
    ours = {row["seed"]: row["psnr_cc"] for row in record.rows("seed", "psnr_cc") if row["psnr_cc"] is not None}
    theirs = {row["seed"]: row["psnr_cc"] for row in record.carried if row["seed"] in ours}
    if len(theirs) < 2:
        return Verdict(demand, "", UNKNOWN)
    both = [[values[seed] for seed in theirs] for values in (ours, theirs)]
    apart = statistics.mean(both[0]) - statistics.mean(both[1])
    error = math.sqrt(sum(statistics.variance(values) / len(values) for values in both))
    state = HOLDS if abs(apart) <= MAX_DIFFERENCE_DB + STANDARD_ERRORS * error else FAILS
    return Verdict(demand, f"{apart:+.2f} ± {error:.2f} dB of {len(theirs)} seeds", state)


def tables(record: VisitRecord) -> Iterator[str]:
    """Yield the lines of all tables, as Markdown."""
    card, call = record.card(), record.calls[0] if record.calls else {}
    driver, when = card.get("driver_version", "?"), call.get("began", "?")[:10]
    commit = call.get("carried", {}).get("commit", "?")
    yield f"On {card.get('name', 'no card')}, driver {driver}, {when}, commit {commit}:"
    yield from table(("demand", "measured", ""), [astuple(each) for each in verdicts(record)])
    yield from table(
        ("Gaussians", "iteration", "host", "slowest", "forward", "both passes", "memory", "least"),
        [
            (
                named(row) + (", default preset" if row["preset"] else ""),
                *(_ms(row, key) for key in ("iteration_ms", "host_ms", "slowest_ms")),
                *(_ms(_alone(record, row), key) for key in ("forward_ms", "raster_ms")),
                _gb(row),
                _ms(row, "least_ms"),
            )
            for row in record.rows("iteration_ms", "host_ms", without=("peer",))
        ],
    )
    yield from table(
        ("peer", "Gaussians", "iteration", "both passes", "memory", "optimiser", "SSIM"),
        [
            (
                *(row["peer"], named(row), _ms(row, "iteration_ms"), _ms(row, "raster_ms"), _gb(row)),
                *(row["optimiser"], row["ssim"]),
            )
            for row in record.rows("peer", "raster_ms")
        ],
    )
    yield from table(
        ("rasterization", "Gaussians", "forward", "both passes", "gsplat's both passes", "memory"),
        [
            (
                "SH of degree 3" if row["channels"] is None else f"{row['channels']} channels",
                *(named(row), _ms(row, "features_forward_ms"), _ms(row, "features_ms"), _gsplats(record, row)),
                _gb(row, "features_peak_gb"),
            )
            for row in record.rows("features_ms")
        ],
    )
    yield from table(
        ("kernel", "calls an iteration", "µs an iteration", "share"),
        [
            (f"`{row['kernel'].partition('(')[0]}`", f"{row['calls']:g}", f"{row['us']:.0f}", f"{row['share']:.1%}")
            for row in record.rows("kernel", "us")
        ],
    )
    yield from table(
        ("training", "psnr_cc", "the CPU's", "seconds", "the CPU's"),
        [
            (f"seed {row['seed']}", f"{row['psnr_cc']:.2f}", *_cpus(record, row))
            for row in record.rows("seed", "psnr_cc")
        ],
    )
    yield from table(
        ("limit", "measured"),
        [
            *(
                (f"{row['count']:,} Gaussians", f"{_gb(row)}, {_ms(row, 'iteration_ms')}")
                for row in record.of("most, memory")
            ),
            *((f"{row['pairs']:,} pairs", f"{row['forward_s']:.2f} s") for row in record.rows("pairs", "same")),
            *(
                (f"{row['iterations']:,} of {row['of']:,} iterations", f"{row['seconds']:.0f} s")
                for row in record.of("long training")[-1:]
            ),
        ],
    )
    lost = [each for each in record.states.values() if each["state"] not in ("done",)]
    yield from table(("not done", "", ""), [(each["part"], each["state"], _last(each)) for each in lost])


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield a table's lines; none without rows."""
    if rows:
        yield ""
        yield "| " + " | ".join(heads) + " |"
        yield "|" + "---|" * len(heads)
        yield from ("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)


def _alone(record: VisitRecord, row: Row) -> Row:
    """Return the row of the rasterizer alone that belongs to one of iterations."""
    found = record.rows("forward_ms", "raster_ms", without=("peer",))
    same = [each for each in found if named(each) == named(row)]
    return same[0] if same and not row["preset"] else {}


def _cpus(record: VisitRecord, row: Row) -> tuple[str, str, str]:
    found = [each for each in record.carried if each["seed"] == row["seed"]]
    quality, seconds = (f"{found[0]['psnr_cc']:.2f}", f"{found[0]['train_seconds']:.0f}") if found else ("", "")
    return quality, f"{row['train_seconds']:.0f}", seconds


def _ms(row: Row, key: str) -> str:
    return f"{row[key]:.2f} ms" if row.get(key) is not None else ""


def _gb(row: Row, key: str = "peak_gb") -> str:
    return f"{row[key]:.2f} GB" if row.get(key) is not None else ""


def _gsplats(record: VisitRecord, row: Row) -> str:
    """Return what gsplat's rasterization took of the same scene: it is timed with spherical harmonics alone."""
    found = [each for each in record.rows("peer", "raster_ms") if each["peer"] == "gsplat"]
    same = [each for each in found if named(each) == named(row) and row["channels"] is None]
    return _ms(same[0], "raster_ms") if same else ""


def _last(line: Row) -> str:
    return line.get("error", "").strip().splitlines()[-1][:150] if line.get("error", "").strip() else ""


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("files", type=Path, nargs="+", help="the first call's file, and the second's")
    options.add_argument("--pack", type=Path, default=Path(".gpu_visit"), help="with the CPU's trainings")
    arguments = options.parse_args()
    carried = arguments.pack / "cpu.json"
    record = VisitRecord(arguments.files, json.loads(carried.read_text()) if carried.exists() else [])
    print("\n".join(tables(record)))
    sys.exit(any(each.state == FAILS for each in verdicts(record)))


if __name__ == "__main__":
    main()
