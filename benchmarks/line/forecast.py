"""Fit the forecasts' costs to finished runs, and show the errors on runs that were left out of the fit.

python benchmarks forecast                       # the table of figures that is kept: fits, leaves one capture out
python benchmarks forecast --add OUT NAME PRESET # reads a run's manifests (at least to `sparse`) into that table
    --stage sparse --speed 0.5                      # … of one stage only; its machine was half as fast as the reference
python benchmarks forecast --costs               # prints the fitted costs, for stages/forecast/costs.py
python benchmarks forecast --hours               # prints the table of hours of docs/speed.md
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from forecast_fit import FinishedRun, compared, fit, left_out, read_run
from tables import print_table

from splatpipe.pipeline.engine.config import load_preset, resolve
from splatpipe.stages.forecast.costs import REFERENCE, Costs
from splatpipe.stages.forecast.needs import RunForecast
from splatpipe.stages.forecast.training import CaptureSize
from splatpipe.stages.options import LineConfig

TABLE = Path(__file__).with_name("forecast.json")
FITTED_TO = "preview"  # runs of other presets are reported, not fitted
MEMORY_WITHIN = 0.3
CPU_WITHIN = 1.5
ROUNDING = 0.01  # relative rounding error of the costs in `stages/forecast/costs.py`, which have three digits
PHOTOS, CORES, MEGAPIXELS = (100, 300, 500), (2, 8, 32), 20.0  # of the table of hours
DISPLAYED_STAGES = ("features", "matches", "sparse", "initialize", "train")


def main() -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--add", nargs=3, metavar=("OUT", "NAME", "PRESET"))
    parser.add_argument("--stage", help="add this stage's figures only, and keep the others of the row")
    parser.add_argument(
        "--speed", type=float, default=1.0, help="of the run's machine: CPU seconds are multiplied by it"
    )
    parser.add_argument("--costs", action="store_true")
    parser.add_argument("--hours", action="store_true", help="print the table of docs/speed.md")
    options = parser.parse_args()
    if options.hours:
        sys.stdout.write(hours_table())
        return 0
    rows = json.loads(TABLE.read_text(encoding="utf-8")) if TABLE.is_file() else []
    if options.add:
        out, name, preset = options.add
        row = read_run(Path(out), configured(preset), name).as_row(preset)
        for figures in row["used"].values():
            figures[0] = round(options.speed * figures[0], 2)
        kept = [old for old in rows if (old["name"], old["preset"]) != (name, preset)]
        if options.stage:
            row["used"] = {options.stage: row["used"][options.stage]}
            for old in rows:
                if (old["name"], old["preset"]) == (name, preset):
                    row = {**old, "used": {**old["used"], **row["used"]}}
        lines = (
            json.dumps(entry) for entry in sorted([*kept, row], key=lambda entry: (entry["preset"], entry["name"]))
        )
        TABLE.write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")
        return 0
    fitted_to, others = runs_of(rows)
    if options.costs:
        sys.stdout.write(costs_text(fit(fitted_to)) + "\n")
        return 0
    show(f"{FITTED_TO}, each against the costs of the others: forecast over used", fitted_to, left_out(fitted_to))
    if others:
        title = "other presets, against the costs in stages/forecast/costs.py"
        show(title, others, [compared(run, REFERENCE) for run in others])
    return 0


def hours_table() -> str:
    """The forecast hours of whole runs on the reference machine's cores, as a table in Markdown."""
    columns = [(preset, threads) for preset in ("preview", "standard", "high") for threads in CORES]
    lines = ["photos", *(f"{preset}, {threads} cores" for preset, threads in columns)]
    text = f"| {' | '.join(lines)} |\n{'|---' * len(lines)}|\n"
    for photos in PHOTOS:
        size = CaptureSize(photos, MEGAPIXELS, positions=True)
        cells = []
        for preset, threads in columns:
            needs = RunForecast.of(size, configured(preset), threads).needs(speed=1.0)
            minutes = sum(need.seconds(threads) for need in needs.values()) / 60.0
            cells.append(f"{minutes:.0f} min" if minutes < 60.0 else f"{minutes / 60.0:.1f} h")
        text += f"| {photos} | {' | '.join(cells)} |\n"
    return text


def costs_text(costs: Costs) -> str:
    """Format costs as in `stages/forecast/costs.py`, to three digits."""
    lines = [f"{name}: {getattr(costs, name):.3g}" for name in ("pairs", "gaussians", "flat")]
    lines.append(f"keypoints: { {name: round(count) for name, count in costs.keypoints.items()} }")
    for stage, of in costs.stages.items():
        memory, disk = next(iter(of.memory.values()), 0.0), next(iter(of.disk.values()), 0.0)
        lines.append(f"{stage}: {of.cpu:.3g}, {of.resident / 1e6:.0f}e6, {memory:.3g}, {disk:.3g}")
    return "\n".join(lines)


def configured(preset: str, differing: Mapping[str, Any] | None = None) -> LineConfig:
    """Return a preset's options as they were at the time of the run: current ones except for ``differing``."""
    return resolve(LineConfig, [load_preset(preset), differing or {}])


def runs_of(rows: Sequence[dict[str, Any]]) -> tuple[list[FinishedRun], list[FinishedRun]]:
    """Split the runs into those of the fitted preset and the others."""
    runs = [(row["preset"], FinishedRun.of_row(row, configured(row["preset"], row.get("set")))) for row in rows]
    return [run for preset, run in runs if preset == FITTED_TO], [run for preset, run in runs if preset != FITTED_TO]


def holds(ratios: Mapping[str, float]) -> tuple[bool, bool]:
    """Whether the forecasts of the whole run's peak memory and CPU time were accurate enough."""
    is_bound = not ratios["bound"] < 1.0 - ROUNDING
    return abs(ratios["memory"] - 1.0) <= MEMORY_WITHIN and is_bound, 1.0 / CPU_WITHIN <= ratios["cpu"] <= CPU_WITHIN


def show(title: str, runs: Sequence[FinishedRun], outcomes: Sequence[Mapping[str, float]]) -> None:
    """Print the outcomes."""
    rows = [
        {
            **dict.fromkeys(DISPLAYED_STAGES, math.nan),
            **ratios,
            "name": run.name,
            "used": max(found["peak_memory_bytes"] for found in run.used.values()) / 1e6,
            "seconds": sum(found["cpu_seconds"] for found in run.used.values()),
            "holds": ""
            if math.isnan(ratios["memory"])
            else " ".join("yes" if well else "NO" for well in holds(ratios)),
        }
        for run, ratios in zip(runs, outcomes, strict=True)
    ]
    columns = {"capture": "name", "peak MB": "used:.0f", "memory ×": "memory:.2f", "bound of sparse ×": "bound:.2f"}
    columns |= {"CPU s": "seconds:.0f", "CPU ×": "cpu:.2f", "disk ×": "disk:.2f", "both hold": "holds"}
    print_table(title, rows, columns | {f"{stage} CPU ×": f"{stage}:.2f" for stage in DISPLAYED_STAGES})


if __name__ == "__main__":
    sys.exit(main())
