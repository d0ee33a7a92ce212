"""Forecast of each stage's memory, CPU time and disk space from the capture's size and the options. Light to import.

A stage's work is counted in units (pixels processed, pairs times keypoints, Gaussians) that follow from the size and
the options (`work.py`); `costs.py` has the cost per unit. Texture, overlap and sky are not known beforehand: captures
of the same size differ by a factor of two in some stages and by less in total. There are no figures for CUDA devices.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from splatpipe.pipeline.engine.machine import available_memory_bytes
from splatpipe.pipeline.engine.runs.needs import Need
from splatpipe.pipeline.engine.runs.needs import whole as whole
from splatpipe.pipeline.engine.runs.source import RunSource
from splatpipe.pipeline.engine.stage import Summary
from splatpipe.pipeline.train.blocks.cells.division import Division
from splatpipe.pipeline.train.blocks.cells.needs import MARGIN_GROWTH, grown_from
from splatpipe.pipeline.train.plan.limits import (
    FIXED_BYTES,
    LIBRARIES_BYTES,
    PIXEL_BYTES,
    SMALLEST_WINDOW,
    bytes_per_gaussian,
)
from splatpipe.stages.block_work import START_S, BlockLoad
from splatpipe.stages.costs import REFERENCE, Costs
from splatpipe.stages.options import LineConfig
from splatpipe.stages.work import MEGA, MIN_GAUSSIANS, MIN_SHARE, CaptureSize, CaptureWork

SPEED_NUMBERS = 20_000  # in the text, without repeats, whose compression is timed
SPEED_S = 0.008  # seconds of that compression on the reference machine of `costs.py`, otherwise idle
SPEED_LEVEL = 6  # zlib's compression level when the machine's speed is measured
SPEED_TRIES = 5  # the fastest counts: the others were slowed by other processes
SPEED_RANGE = (0.25, 4.0)  # measurements are clamped to it


def forecast(
    size: CaptureSize,
    config: LineConfig,
    threads: int = 2,
    *,
    speed: float = 1.0,
    costs: Costs = REFERENCE,
    machine_bytes: int = 0,
) -> dict[str, Need]:
    """Return the resources that each stage needs, by stage name.

    Args:
        size: The capture's size.
        config: The resolved options.
        threads: Number of threads of the run.
        speed: Relative speed of this machine's cores, from ``machine_speed``.
        costs: Cost per unit of each stage's work.
        machine_bytes: Memory of the machine that decides on blocks; 0 if unknown.
    """
    return needs_of(CaptureWork.of(size, config, costs, threads, machine_bytes), speed)


def needs_of(work: CaptureWork, speed: float) -> dict[str, Need]:
    """Return the resources that each stage needs, by stage name; training fills a time budget.

    Args:
        work: The work of all stages.
        speed: Relative speed of this machine's cores, from ``machine_speed``.
    """
    needs, threads = work.needs(speed), work.threads
    budget = work.config.train.time_budget_s
    if not budget:
        return needs
    others = sum(need.seconds(threads) for stage, need in needs.items() if stage != "train")
    left = max(MIN_SHARE * budget, budget - others)
    filled = work.filling(left, speed).needs(speed)
    whole_time = left / replace(filled["train"], cpu_seconds=1.0).seconds(threads)
    return {**filled, "train": replace(filled["train"], cpu_seconds=whole_time)}


def min_memory_bytes(config: LineConfig) -> int:
    """Smallest memory limit that training can keep: libraries, the smallest window, the fewest Gaussians."""
    model = MIN_GAUSSIANS * bytes_per_gaussian(config.train.sh_degree)
    return LIBRARIES_BYTES + FIXED_BYTES + PIXEL_BYTES * SMALLEST_WINDOW + model


@dataclass(frozen=True)
class Forecaster:
    """Forecasts for a run, refined as its stages finish.

    Attributes:
        config: The resolved options.
        threads: Number of threads of the run.
    """

    config: LineConfig
    threads: int
    _works: dict[object, CaptureWork] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def speed(self) -> float:
        """Relative speed of this machine's cores, measured once."""
        return machine_speed()

    def __call__(self, summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
        """Return the needs by stage name from the summary of ``ingest``; empty without one.

        After ``blocks``, the forecast follows its decision and includes each block's own needs.
        """
        size = capture_size(summaries)
        if size is None:
            return {}
        decided = summaries.get("blocks")
        work = self._work(size, decided)
        summary = {} if decided is None else decided.get("of_blocks", {})
        return needs_of(work, self.speed) | needs_of_blocks(work, summary, self.speed)

    def _work(self, size: CaptureSize, decided: Summary | None) -> CaptureWork:
        """The work of all stages, cached until ``blocks`` has decided."""
        key = size, decided is None
        if key not in self._works:
            self._works[key] = work_as_decided(size, self.config, self.threads, decided)
        return self._works[key]


def work_as_decided(size: CaptureSize, config: LineConfig, threads: int, decided: Summary | None) -> CaptureWork:
    """Return the work by the decision of the stage ``blocks``, made on any machine.

    Args:
        size: The capture's size.
        config: The resolved options.
        threads: Number of threads of the run.
        decided: The stage's summary; None to decide for this machine.
    """
    if decided is None:
        return CaptureWork.of(size, config, REFERENCE, threads, available_memory_bytes())
    whole_scene = CaptureWork.of_whole(size, config, REFERENCE, threads, int(decided.get("limit_bytes", 0)))
    division = decided.get("division")
    return whole_scene if division is None else whole_scene.divided_as(Division.of_facts(division))


def needs_of_blocks(work: CaptureWork, summary: Mapping[str, Any], speed: float) -> dict[str, Need]:
    """Return each block's needs by shard name, and under ``train`` those of all blocks; empty without blocks.

    Args:
        work: The work of all stages.
        summary: The blocks' figures (start, steps, limits, iterations) from the summary of ``blocks``; may be empty.
        speed: Relative speed of this machine's cores.
    """
    blocks = work.blocks
    if blocks is None or not summary:
        return {}
    train, cost, planned = work.needs(speed)["train"], work.costs.stages["train"], work.blocks_iterations
    loads = [
        BlockLoad(float(grown_from(*figures)), float(frozen))
        for *figures, frozen in zip(
            summary["start"], summary["steps"], summary["trained"], summary["frozen"], strict=True
        )
    ]
    found = {}
    for number, load in enumerate(loads):
        own = int(summary["iterations"][number])
        cpu = cost.cpu * work.done * work.blocks_training(blocks.lengths, load) * own / max(1, planned)
        found[f"train.{number + 1}"] = replace(
            train,
            memory_bytes=work.block_memory_bytes(load),
            cpu_seconds=(cpu + START_S) / speed,
            disk_bytes=load.left_bytes,
            scratch_bytes=int(summary["disk_bytes"][number]) + load.work_bytes,
        )
    each = list(found.values())
    merged = sum(load.trained for load in loads) / MARGIN_GROWTH
    of_all = replace(
        train,
        memory_bytes=max(need.memory_bytes for need in each),
        cpu_seconds=sum(need.cpu_seconds for need in each),
        disk_bytes=int(cost.disk * merged) + sum(need.disk_bytes for need in each),
        scratch_bytes=max(need.scratch_bytes for need in each),
    )
    return found | {"train": of_all}


def capture_size(summaries: Mapping[str, Summary]) -> CaptureSize | None:
    """Capture size from the summary of ``ingest``, by its most common camera; None if it did not run."""
    summary = summaries.get("ingest", {})
    groups = summary.get("camera_groups", ())
    if not groups:
        return None
    shorter, longer = sorted(max(groups, key=lambda group: int(group["photos"]))["size"])
    photos, wanted = int(summary["photos"]), summaries.get("control", {})
    control = bool(wanted.get("points") or wanted.get("scale_bars"))
    return CaptureSize(
        photos, shorter * longer / MEGA, 2 * int(summary["positions"]) > photos, shorter / longer, control
    )


def has_control(source: RunSource) -> bool:
    """Whether the user gave control points or scale bars, for which targets are searched."""
    return any(source.named.get(part) is not None for part in ("source.control", "source.scale_bars"))


def seconds(need: Need, threads: int) -> float:
    """Seconds that a stage takes with `threads` cores of its own."""
    return need.seconds(threads)


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
