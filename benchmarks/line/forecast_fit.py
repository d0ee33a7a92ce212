"""Fit the forecasts' costs to finished runs, and measure how well they predict runs that were left out of the fit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from splatpipe.stages.costs import REFERENCE, Costs, StageCosts
from splatpipe.stages.forecast import capture_size, forecast
from splatpipe.stages.options import LineConfig
from splatpipe.stages.work import NEIGHBOURS, CaptureSize, CaptureWork, WorkUnits

KINDS = ("cpu_seconds", "peak_memory_bytes", "disk_bytes")
BY_GAUSSIANS = ("train", "clean", "evaluate", "export")
"""Stages whose memory grows with the Gaussians, of which runs at `preview` have too few to show how: the memory per
Gaussian is counted in training (`train/plan/limits.py`), and was measured on seneca's 325,000 in the later stages."""

SELDOM = ("control", "targets", "blocks")
"""Stages that have nothing to do for most captures, so nothing is fitted to them."""

BY_HAND = ("matches", "train")
"""Stages whose memory is not fitted. Matching runs in its own processes; two of them took 346 to 388 MB on the demo,
beside 250 of the stage itself. Training's value dates from before its frames were freed early; two runs since then say
0.31 GB, but with few Gaussians, and memory limits rely on it."""


BOUNDS = ("sparse",)
"""Stages whose memory is bounded from above: mapping takes much more if it leaves photos to the ladder, which matches
stronger keypoints: 1 to 3.3 GB."""


@dataclass(frozen=True)
class FinishedRun:
    """A finished run, read from its manifests.

    Attributes:
        name: Name of the capture.
        size: Size of the capture.
        config: The options that it ran with.
        threads: Threads that it had.
        counts: Keypoints of all photos, pairs and, after a training, final Gaussians and iterations done.
        used: Use of each of ``KINDS``, by stage; CPU seconds are those of the reference machine.
    """

    name: str
    size: CaptureSize
    config: LineConfig
    threads: int
    counts: Mapping[str, float]
    used: Mapping[str, Mapping[str, float]]

    def as_row(self, preset: str) -> dict[str, Any]:
        """Return the row for the stored table."""
        return {
            "name": self.name,
            "preset": preset,
            "threads": self.threads,
            "size": [self.size.photos, round(self.size.megapixels, 4), self.size.positions, round(self.size.shape, 4)],
            "counts": dict(self.counts),
            "used": {stage: [round(found[kind], 2) for kind in KINDS] for stage, found in self.used.items()},
        }

    @staticmethod
    def of_row(row: Mapping[str, Any], config: LineConfig) -> FinishedRun:
        """The inverse of ``as_row``, with the preset's options."""
        used = {stage: dict(zip(KINDS, figures, strict=True)) for stage, figures in row["used"].items()}
        return FinishedRun(row["name"], CaptureSize(*row["size"]), config, row["threads"], row["counts"], used)


def read_run(out: Path, config: LineConfig, name: str) -> FinishedRun:
    """Read a run from the newest manifest of each stage in its OUT; it may have ended after `sparse`.

    Raises:
        ValueError: if it did not start from photos, or did not get that far.
    """
    manifests: dict[str, dict[str, Any]] = {}
    for path in out.glob("stages/*/manifest.json"):
        manifest = json.loads(path.read_text(encoding="utf-8"))
        before = manifests.get(manifest["stage"])
        if before is None or manifest["finished_s"] > before["finished_s"]:
            manifests[manifest["stage"]] = manifest
    summaries = {stage: manifest["summary"] for stage, manifest in manifests.items()}
    size = capture_size(summaries)
    if size is None or "sparse" not in summaries:
        raise ValueError(f"{out} holds no photos that were placed.")
    counts = {
        "keypoints": float(summaries["features"]["keypoints"]),
        "pairs": float(summaries["matches"]["pairs"]),
    }
    if "train" in summaries:
        counts |= {kind: float(summaries["train"][kind]) for kind in ("gaussians", "iterations")}
    used = {stage: _used(manifest) for stage, manifest in manifests.items() if stage not in SELDOM}
    return FinishedRun(name, size, config, int(manifests["sparse"]["machine"]["threads"]), counts, used)


def _used(manifest: Mapping[str, Any]) -> dict[str, float]:
    disk = sum(file["size"] for part in manifest["parts"].values() for file in part["files"])
    return {
        "cpu_seconds": float(manifest["cpu_seconds"]),
        "peak_memory_bytes": float(manifest["peak_memory_bytes"]),
        "disk_bytes": float(disk),
    }


def fit(runs: Sequence[FinishedRun], base: Costs = REFERENCE) -> Costs:
    """Fit the costs to these runs: typical properties of scenes, and the cost per unit of their work.

    What these runs do not cover (an extractor that none used, a flythrough) is taken from ``base``.
    """
    scenes = [scene_of(run, base) for run in runs]
    works = [CaptureWork.of(run.size, run.config, scene, run.threads) for run, scene in zip(runs, scenes, strict=True)]
    units = [work.units() for work in works]
    keypoints = dict(base.keypoints)
    for extractor in {run.config.features.extractor for run in runs}:
        counts = [scene.keypoints[extractor] for run, scene in zip(runs, scenes, strict=True) if _uses(run, extractor)]
        keypoints[extractor] = _typical(counts, 0.0)
    chosen = [scene.pairs for run, scene in zip(runs, scenes, strict=True) if run.counts["pairs"] < _every(run)]
    trained = [(run, scene) for run, scene in zip(runs, scenes, strict=True) if "gaussians" in run.counts]
    ended = [scene.flat for run, scene in trained if run.config.train.stop_when_flat]
    stages = {}
    for stage, otherwise in base.stages.items():
        those = [(run.used[stage], each[stage]) for run, each in zip(runs, units, strict=True) if stage in run.used]
        if those:
            resident, memory = otherwise.resident, otherwise.memory
            if stage in BOUNDS:
                memory = max(0.0, *(_beyond(used, of, resident) / of.memory for used, of in those))
            elif stage not in BY_HAND:
                resident, memory = _line(those, memory if stage in BY_GAUSSIANS else None)
            cpu = [used["cpu_seconds"] / of.cpu for used, of in those if used["cpu_seconds"] * of.cpu > 0.0]
            disk = [used["disk_bytes"] / of.disk for used, of in those if used["disk_bytes"] * of.disk > 0.0]
            found = _typical(cpu, otherwise.cpu), _typical(disk, otherwise.disk)
            stages[stage] = StageCosts(found[0], resident, memory, found[1])
        else:
            stages[stage] = otherwise
    return Costs(
        keypoints,
        _typical(chosen, base.pairs),
        _typical([scene.gaussians for _run, scene in trained], base.gaussians),
        _typical(ended, base.flat),
        stages,
    )


def scene_of(run: FinishedRun, base: Costs) -> Costs:
    """Replace typical scene properties by this run's, known only afterwards, so that its units of work are exact."""
    bare = CaptureWork.of(run.size, run.config, replace(base, gaussians=1.0), run.threads)
    options, counts = run.config, run.counts
    keypoints = {
        **base.keypoints,
        options.features.extractor: counts["keypoints"] / run.size.photos / bare.keypoint_megapixels,
    }
    pairs = counts["pairs"] / run.size.photos * NEIGHBOURS / options.matches.neighbours
    placed = replace(base, keypoints=keypoints, pairs=pairs)
    if "gaussians" not in counts:
        return placed
    return replace(placed, gaussians=counts["gaussians"] / bare.grown, flat=counts["iterations"] / bare.iterations)


def _beyond(used: Mapping[str, float], of: WorkUnits, resident: float) -> float:
    """Bytes of a stage's memory beyond what is constant or known."""
    return used["peak_memory_bytes"] - resident - of.fixed_bytes


def _uses(run: FinishedRun, extractor: str) -> bool:
    return run.config.features.extractor == extractor


def _every(run: FinishedRun) -> float:
    return run.size.photos * (run.size.photos - 1) / 2


def _typical(values: Sequence[float], otherwise: float) -> float:
    """Return the geometric mean: as often too high as too low by the same factor."""
    return math.exp(sum(math.log(value) for value in values) / len(values)) if values else otherwise


def _line(those: Sequence[tuple[Mapping[str, float], WorkUnits]], slope: float | None = None) -> tuple[float, float]:
    """Fit a stage's memory: a constant and a cost per unit, neither negative (relative least squares)."""
    units = np.array([of.memory for _, of in those])
    used = np.array([found["peak_memory_bytes"] for found, _ in those])
    if slope is not None:
        return float(np.mean(used - slope * units)), slope
    scale = max(float(units.max()), 1.0)
    table = np.stack([np.ones(len(those)), units / scale], axis=1) * (used.mean() / used)[:, None]
    constant, slope = nnls(table, np.ones(len(those)))[0] * used.mean()
    return float(constant), float(slope / scale)


@dataclass(frozen=True)
class ForecastRatio:
    """A run beside its forecast: forecast over actual use.

    Attributes:
        run: The run.
        memory: Ratio of the whole run's peak, without the stages of ``BOUNDS``; NaN if only these were recorded.
        cpu: Ratio of the CPU time of all recorded stages.
        disk: Ratio of all remaining output.
        stages: Ratios of the CPU time of single stages.
        bounds: Ratios of the memory of those of ``BOUNDS``.
    """

    run: FinishedRun
    memory: float
    cpu: float
    disk: float
    stages: Mapping[str, float]
    bounds: Mapping[str, float]


def compared(run: FinishedRun, costs: Costs) -> ForecastRatio:
    """Return the ratios of a run's forecast by these costs to its actual use."""
    needs = forecast(run.size, run.config, run.threads, costs=costs)
    used, bounded = run.used, [stage for stage in BOUNDS if stage in run.used]
    typical = [stage for stage in used if stage not in BOUNDS]

    def ratio(join: Callable[[Iterable[float]], float], predicted: Mapping[str, float], kind: str) -> float:
        return math.nan if not predicted else join(predicted.values()) / join(used[stage][kind] for stage in predicted)

    return ForecastRatio(
        run,
        ratio(max, {stage: float(needs[stage].memory_bytes) for stage in typical}, "peak_memory_bytes"),
        ratio(sum, {stage: needs[stage].cpu_seconds for stage in used}, "cpu_seconds"),
        ratio(sum, {stage: float(needs[stage].disk_bytes) for stage in used}, "disk_bytes"),
        {stage: needs[stage].cpu_seconds / max(used[stage]["cpu_seconds"], 0.01) for stage in used},
        {stage: needs[stage].memory_bytes / used[stage]["peak_memory_bytes"] for stage in bounded},
    )


def left_out(runs: Sequence[FinishedRun]) -> list[ForecastRatio]:
    """Compare each run with costs fitted to the other captures."""
    return [compared(run, fit([other for other in runs if other.name != run.name])) for run in runs]
