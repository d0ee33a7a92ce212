"""Forecast of each stage's memory, CPU time and disk space from the capture's size and the options. Light to import.

The sizes of a run (pixels, pairs, keypoints, Gaussians, iterations) follow from the capture's size and the options
(`sizes.py`, `training.py`); `costs.py` has what each stage takes by them. Texture, overlap and sky are not
known beforehand: captures of the same size differ by a factor of two in some stages and by less in total. There are no
figures for CUDA devices.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from splatpipe.pipeline.engine.machine import available_memory_bytes
from splatpipe.pipeline.engine.runs.needs import Need, whole
from splatpipe.pipeline.engine.runs.source import RunSource
from splatpipe.pipeline.engine.stage import Summary
from splatpipe.pipeline.train.blocks.cells.division import Division
from splatpipe.pipeline.train.blocks.cells.needs import SPLAT_BYTES, grown_from
from splatpipe.stages.forecast.costs import REFERENCE, SCRATCH, Costs, Sizes, total
from splatpipe.stages.forecast.sizes import sizes_of
from splatpipe.stages.forecast.training import MEGA, CaptureSize, Training
from splatpipe.stages.options import LineConfig

TRAINING = ("blocks", "train")  # stages that keep a memory limit
MIN_SHARE = 0.1  # least share of a time budget that training gets
SPEED_NUMBERS = 20_000  # in the text, without repeats, whose compression is timed
SPEED_S = 0.008  # seconds of that compression on the reference machine of `costs.py`, otherwise idle
SPEED_LEVEL = 6  # zlib's compression level when the machine's speed is measured
SPEED_TRIES = 5  # the fastest counts: the others were slowed by other processes
SPEED_RANGE = (0.25, 4.0)  # measurements are clamped to it


@dataclass(frozen=True)
class RunForecast:
    """The forecast of a run on a capture.

    Attributes:
        size: The capture's size.
        config: The resolved options.
        threads: Number of threads of the run.
        training: The expected training.
        costs: What each stage takes.
    """

    size: CaptureSize
    config: LineConfig
    threads: int
    training: Training
    costs: Costs = REFERENCE

    @staticmethod
    def of(
        size: CaptureSize,
        config: LineConfig,
        threads: int,
        machine_bytes: int = 0,
        decided: Summary | None = None,
        costs: Costs = REFERENCE,
    ) -> RunForecast:
        """Return the forecast of a run.

        Args:
            size: The capture's size.
            config: The resolved options.
            threads: Number of threads of the run.
            machine_bytes: Memory of the machine that is going to decide on blocks; 0 if unknown.
            decided: The summary of `blocks`, whose decision holds on any machine; None before it.
            costs: What each stage takes.
        """
        dataset = replace(size, megapixels=min(size.megapixels, config.undistort.max_megapixels))
        training = Training.of(dataset, config.train, costs.gaussians)
        if decided is None:
            training = training.as_divided(machine_bytes, config.blocks.least)
        elif "division" in decided:
            training = replace(training, division=Division.of_facts(decided["division"]))
        elif "limit_bytes" in decided:
            training = Training.of(dataset, config.train, costs.gaussians, int(decided["limit_bytes"]))
        return RunForecast(size, config, threads, training, costs)

    @cached_property
    def sizes(self) -> Sizes:
        """The sizes of the run, by name."""
        return sizes_of(self.size, self.config, self.threads, self.costs, self.training)

    def needs(self, speed: float) -> dict[str, Need]:
        """Return the resources that each stage needs, by name; training fills a time budget.

        Args:
            speed: Relative speed of this machine's cores, from ``machine_speed``.
        """
        needs, budget = self._needs(speed), self.config.train.time_budget_s
        if not budget:
            return needs
        others = sum(need.seconds(self.threads) for stage, need in needs.items() if stage != "train")
        left = max(MIN_SHARE * budget, budget - others)
        cpu = left / replace(needs["train"], cpu_seconds=1.0).seconds(self.threads)
        training = self.training.filling(left, cpu * speed / self.costs.stages["train"].cpu)
        filled = replace(self, training=training)._needs(speed)
        return {**filled, "train": replace(filled["train"], cpu_seconds=cpu)}

    def needs_of_blocks(self, of_blocks: Mapping[str, Any], speed: float) -> dict[str, Need]:
        """Return each block's needs by shard name, and under ``train`` those of all blocks; empty without blocks.

        Args:
            of_blocks: Facts about each block from the summary of `blocks`; may be empty.
            speed: Relative speed of this machine's cores.
        """
        if self.training.division is None or not of_blocks:
            return {}
        facts = (of_blocks[name] for name in ("iterations", "start", "steps", "trained", "frozen", "disk_bytes"))
        needs = {}
        for number, (iterations, start, steps, most, frozen, photo_bytes) in enumerate(zip(*facts, strict=True), 1):
            trained = grown_from(start, steps, most)
            sizes = {**self.sizes, **self.training.of_process(iterations, trained, frozen, self.training.share)}
            need = self._need("train", {**sizes, "written": trained, "cached": 0.0}, speed)
            needs[f"train.{number}"] = replace(need, scratch_bytes=need.scratch_bytes + photo_bytes)
        of_all = whole(needs)
        merged = int(SPLAT_BYTES * self.training.gaussians)
        return {**needs, "train": replace(of_all, disk_bytes=of_all.disk_bytes + merged)}

    def _needs(self, speed: float) -> dict[str, Need]:
        """The needs without regard to a time budget; none if a stage is turned off."""
        return {
            stage: Need(0, 0.0, 0) if getattr(self.config, stage).is_off else self._need(stage, self.sizes, speed)
            for stage in self.costs.stages
        }

    def _need(self, stage: str, sizes: Sizes, speed: float) -> Need:
        """What a stage takes at these sizes; one that trains keeps a memory limit."""
        need, division = self.costs.stages[stage].need(sizes), self.training.division
        limit = self.training.config.max_memory_bytes if division is None else division.limit_bytes
        memory = min(need.memory_bytes, limit) if stage in TRAINING and limit else need.memory_bytes
        scratch = int(total(SCRATCH.get(stage, {}), sizes))
        return replace(need, memory_bytes=memory, cpu_seconds=need.cpu_seconds / speed, scratch_bytes=scratch)


@dataclass(frozen=True)
class Forecaster:
    """Forecasts for a run, refined as its stages finish.

    Attributes:
        config: The resolved options.
        threads: Number of threads of the run.
    """

    config: LineConfig
    threads: int

    @cached_property
    def speed(self) -> float:
        """Relative speed of this machine's cores, measured once."""
        return machine_speed()

    def __call__(self, summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
        """Return the needs by stage name from the summary of ``ingest``; empty without one.

        After ``blocks``, the forecast follows its decision and includes each block's own needs.
        """
        size, decided = capture_size(summaries), summaries.get("blocks")
        if size is None:
            return {}
        run = RunForecast.of(size, self.config, self.threads, available_memory_bytes(), decided)
        return run.needs(self.speed) | run.needs_of_blocks((decided or {}).get("of_blocks", {}), self.speed)


def capture_size(summaries: Mapping[str, Summary]) -> CaptureSize | None:
    """Capture size from the summary of ``ingest``, by its most common camera; None if it did not run."""
    summary, wanted = summaries.get("ingest", {}), summaries.get("control", {})
    groups = summary.get("camera_groups", ())
    if not groups:
        return None
    shorter, longer = sorted(max(groups, key=lambda group: int(group["photos"]))["size"])
    photos = int(summary["photos"])
    control = bool(wanted.get("points") or wanted.get("scale_bars"))
    positions = 2 * int(summary["positions"]) > photos
    return CaptureSize(photos, shorter * longer / MEGA, positions, shorter / longer, control)


def has_control(source: RunSource) -> bool:
    """Whether the user gave control points or scale bars, for which targets are searched."""
    return any(source.named.get(part) is not None for part in ("source.control", "source.scale_bars"))


def machine_speed() -> float:
    """Speed of this machine's cores relative to the reference machine, from timing a compression (0.05 s in all)."""
    text = " ".join(str(number * number % 9973) for number in range(SPEED_NUMBERS)).encode()
    took = []
    for _ in range(SPEED_TRIES):
        began = time.thread_time()
        zlib.compress(text, SPEED_LEVEL)
        took.append(time.thread_time() - began)
    least, most = SPEED_RANGE
    return min(most, max(least, SPEED_S / max(min(took), 1e-6)))
