"""Fit the forecasts' costs to finished runs, and measure how well they predict runs that were left out of the fit."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.optimize import nnls

from splatpipe.stages.forecast.costs import REFERENCE, Costs, Sizes, StageCosts, total
from splatpipe.stages.forecast.needs import RunForecast, capture_size
from splatpipe.stages.forecast.training import CaptureSize
from splatpipe.stages.options import LineConfig

KINDS = ("cpu_seconds", "peak_memory_bytes", "disk_bytes")
BY_GAUSSIANS = ("clean", "evaluate", "export")
"""Stages whose memory grows with the Gaussians, of which runs at `preview` have too few to show how: the memory per
Gaussian was measured on seneca's 325,000."""

SELDOM = ("control", "targets", "blocks")
"""Stages that have nothing to do for most captures, so nothing is fitted to them."""

BY_HAND = ("matches", "sparse", "train")
"""Stages whose memory is not fitted. Matching runs in its own processes; two of them took 346 to 388 MB on the demo,
beside 250 of the stage itself. Adjusting everything took 720 bytes a keypoint on seneca, the stronger keypoints of one
photo 250 a pixel. Training's is the arithmetic of its own limits."""

BOUNDS = ("sparse",)
"""Stages whose memory is bounded from above: mapping takes more if it leaves photos to the ladder."""


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
    """Fit the costs to these runs: typical properties of scenes, and the costs of the stages by their sizes.

    What these runs do not cover (an extractor that none used, a flythrough) is taken from ``base``.
    """
    scenes = [scene_of(run, base) for run in runs]
    sizes = [forecast_of(run, scene).sizes for run, scene in zip(runs, scenes, strict=True)]
    each = list(zip(runs, scenes, strict=True))
    stages = dict(base.stages)
    for stage in stages.keys() - set(SELDOM):
        of_stage = [(run.used[stage], own) for run, own in zip(runs, sizes, strict=True) if stage in run.used]
        if of_stage:
            stages[stage] = _fit_stage(stage, of_stage, base.stages[stage])
    stages["blocks"] = replace(stages["blocks"], cpu=stages["train"].cpu)
    extractors = {run.config.features.extractor for run in runs}
    keypoints = {
        name: _typical([scene.keypoints[name] for run, scene in each if run.config.features.extractor == name])
        for name in extractors
    }
    trained = [scene for run, scene in each if "gaussians" in run.counts]
    return Costs(
        keypoints={**base.keypoints, **keypoints},
        pairs=_typical([scene.pairs for run, scene in each if run.counts["pairs"] < _every(run)]),
        gaussians=_typical([scene.gaussians for scene in trained]),
        flat=_typical([scene.flat for scene in trained]),
        stages=stages,
    )


def forecast_of(run: FinishedRun, costs: Costs) -> RunForecast:
    """Return the forecast of a run by these costs."""
    return RunForecast.of(run.size, run.config, run.threads, costs=costs)


def scene_of(run: FinishedRun, base: Costs) -> Costs:
    """Replace typical scene properties by this run's, known only afterwards, so that its sizes are exact."""
    extractor, counts = run.config.features.extractor, run.counts
    bare = forecast_of(run, replace(base, keypoints={extractor: 1.0}, pairs=1.0, gaussians=1.0))
    ratio = {name: counts[name] / bare.sizes[name] for name in ("keypoints", "pairs")}
    scene = replace(base, keypoints={**base.keypoints, extractor: ratio["keypoints"]}, pairs=ratio["pairs"])
    if "gaussians" not in counts:
        return scene
    training = bare.training
    return replace(
        scene, gaussians=counts["gaussians"] / training.grown, flat=counts["iterations"] / training.iterations
    )


def _fit_stage(stage: str, of_stage: Sequence[tuple[Mapping[str, float], Sizes]], base: StageCosts) -> StageCosts:
    """Fit a stage's CPU time, the first terms of its memory and disk space, and its resident memory."""

    def typical(kind: str, units: Sequence[float], otherwise: float) -> float:
        each = [used[kind] / unit for (used, _), unit in zip(of_stage, units, strict=True) if used[kind] * unit > 0.0]
        return _typical(each) if each else otherwise

    cpu = typical("cpu_seconds", [base.work(sizes) for _, sizes in of_stage], base.cpu)
    (on_disk, of_one), *more = base.disk.items()
    disk = {on_disk: typical("disk_bytes", [sizes[on_disk] for _, sizes in of_stage], of_one), **dict(more)}
    fitted = replace(base, cpu=cpu, disk=disk)
    if stage in BY_HAND:
        return fitted
    (by, slope), *others = base.memory.items() or [("photos", 0.0)]
    rest = dict(others)
    units = np.array([sizes[by] for _, sizes in of_stage])
    taken = np.array([used["peak_memory_bytes"] - total(rest, sizes) for used, sizes in of_stage])
    if stage in BY_GAUSSIANS or not base.memory:
        return replace(fitted, resident=float((taken - slope * units).mean()))
    resident, slope = _line(units, taken)
    return replace(fitted, resident=resident, memory={by: slope, **rest})


def _every(run: FinishedRun) -> float:
    return run.size.photos * (run.size.photos - 1) / 2


def _typical(values: Sequence[float]) -> float:
    """Return the geometric mean: as often too high as too low by the same factor."""
    return math.exp(sum(math.log(value) for value in values) / len(values))


def _line(units: Float64[np.ndarray, " n"], taken: Float64[np.ndarray, " n"]) -> tuple[float, float]:
    """Fit a constant and a slope, neither negative (relative least squares)."""
    table = np.stack([np.ones(len(units)), units / units.max()], axis=1) * (taken.mean() / taken)[:, None]
    constant, slope = nnls(table, np.ones(len(units)))[0] * taken.mean()
    return float(constant), float(slope / units.max())


def compared(run: FinishedRun, costs: Costs) -> dict[str, float]:
    """Return the ratios of a run's forecast by these costs to its actual use.

    ``memory`` is of the whole run's peak, without the stages of ``BOUNDS``, whose own memory is ``bound`` (NaN without
    any); ``cpu`` and ``disk`` are of all recorded stages, and those by a stage's name of its CPU time.
    """
    needs, used = forecast_of(run, costs).needs(1.0), run.used
    typical, bounds = used.keys() - set(BOUNDS), [stage for stage in BOUNDS if stage in used]
    memory = {stage: (needs[stage].memory_bytes, used[stage]["peak_memory_bytes"]) for stage in used}
    forecast_peak, peak = (max((memory[stage][k] for stage in typical), default=math.nan) for k in (0, 1))
    return {
        "memory": forecast_peak / peak,
        "cpu": sum(needs[stage].cpu_seconds for stage in used) / sum(each["cpu_seconds"] for each in used.values()),
        "disk": sum(needs[stage].disk_bytes for stage in used) / sum(each["disk_bytes"] for each in used.values()),
        "bound": min((memory[stage][0] / memory[stage][1] for stage in bounds), default=math.nan),
        **{stage: needs[stage].cpu_seconds / max(used[stage]["cpu_seconds"], 0.01) for stage in used},
    }


def left_out(runs: Sequence[FinishedRun]) -> list[dict[str, float]]:
    """Compare each run with costs fitted to the other captures."""
    return [compared(run, fit([other for other in runs if other.name != run.name])) for run in runs]
