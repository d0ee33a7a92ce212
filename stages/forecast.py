"""What each stage will take of a machine: memory, CPU time and disk, from a capture's size and the options. Light.

A stage's work is counted in units (pixels looked at, pairs times keypoints, Gaussians) that follow from the size and
the options (`work.py`); `costs.py` has what a unit costs. Texture, overlap and sky are not known beforehand: captures
of one size differ by a factor of two in some stages and by less in the whole. Of CUDA devices nothing is known.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from splatpipe.pipeline.engine.machine import available_memory_bytes
from splatpipe.pipeline.engine.needs import Need
from splatpipe.pipeline.engine.needs import whole as whole
from splatpipe.pipeline.engine.source import Source
from splatpipe.pipeline.engine.stage import Summary
from splatpipe.pipeline.train.limits import (
    FIXED_BYTES,
    MACHINE_SHARE,
    PIXEL_BYTES,
    SMALLEST_WINDOW,
    bytes_per_gaussian,
)
from splatpipe.stages.costs import REFERENCE, Costs
from splatpipe.stages.options import LineConfig
from splatpipe.stages.work import FEWEST_GAUSSIANS, LEAST_SHARE, MEGA, CaptureSize, Work

SPEED_NUMBERS = 20_000  # of a text without repeats, whose packing is timed
SPEED_S = 0.008  # that the machine of the costs takes to pack it, undisturbed
SPEED_LEVEL = 6  # of the packing
SPEED_TRIES = 5  # the best of them counts: the others met somebody else's work
SPEED_RANGE = (0.25, 4.0)  # outside it the measurement is not believed


def forecast(
    size: CaptureSize,
    config: LineConfig,
    threads: int = 2,
    *,
    speed: float = 1.0,
    costs: Costs = REFERENCE,
    machine_bytes: int = 0,
) -> dict[str, Need]:
    """What each stage takes, by its name.

    Args:
        size: Of the capture.
        config: The options, resolved.
        threads: That the run is given.
        speed: Of this machine's cores, as ``machine_speed`` says.
        costs: Of a unit of each stage's work.
        machine_bytes: Memory of the machine that decides on blocks; 0 where nobody knows.
    """
    work = Work.of(size, config, costs, threads, machine_bytes)
    needs = work.needs(speed)
    budget = config.train.time_budget_s
    if not budget:
        return needs
    others = sum(need.seconds(threads) for stage, need in needs.items() if stage != "train")
    left = max(LEAST_SHARE * budget, budget - others)
    filled = work.filling(left, speed).needs(speed)
    whole_time = left / replace(filled["train"], cpu_seconds=1.0).seconds(threads)
    return {**filled, "train": replace(filled["train"], cpu_seconds=whole_time)}


def least_memory_bytes(config: LineConfig, costs: Costs = REFERENCE) -> int:
    """Least limit of memory that a training can keep to: its libraries, the smallest window, the fewest Gaussians."""
    model = FEWEST_GAUSSIANS * bytes_per_gaussian(config.train.sh_degree)
    return int(costs.stages["train"].resident) + FIXED_BYTES + PIXEL_BYTES * SMALLEST_WINDOW + model


@dataclass(frozen=True)
class Forecaster:
    """Forecasts for a run, as its stages finish.

    Attributes:
        config: The options, resolved.
        threads: That the run is given.
    """

    config: LineConfig
    threads: int

    @cached_property
    def speed(self) -> float:
        """Of this machine, measured once."""
        return machine_speed()

    def __call__(self, summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
        """From what ``ingest`` counted; nothing before it, nor where the photos came otherwise.

        Once ``blocks`` is done, by what it decided, with each block's own need.
        """
        size = counted(summaries)
        if size is None:
            return {}
        decided = summaries.get("blocks")
        memory = available_memory_bytes()
        if decided is not None:  # on whatever machine
            memory = int(decided.get("of_blocks", {}).get("limit_bytes", 0) / MACHINE_SHARE)
        needs = forecast(size, self.config, self.threads, speed=self.speed, machine_bytes=memory)
        work = Work.of(size, self.config, REFERENCE, self.threads, memory)
        if decided is None or work.blocks is None:
            return needs
        planned = sum(count for _level, count in work.blocks.lengths)
        return needs | needs_of_blocks(needs["train"], decided.get("of_blocks", {}), planned)


def needs_of_blocks(train: Need, told: Mapping[str, Any], planned: int) -> dict[str, Need]:
    """Each block's need by its name, and that of all of them, once it is known what each looks at.

    Args:
        train: The need of all of them as it was forecast.
        told: What ``blocks`` said of them; nothing without blocks.
        planned: Iterations of all of them that the forecast took.
    """
    iterations, disk, around = (told.get(name, ()) for name in ("iterations", "disk_bytes", "work_bytes"))
    whole, planned = max(1, sum(iterations)), max(1, planned)
    each = {
        f"train.{number}": replace(
            train,
            cpu_seconds=train.cpu_seconds * own / planned,
            disk_bytes=round(train.disk_bytes * own / whole),
            scratch_bytes=int(decoded) + int(beside),
        )
        for number, (own, decoded, beside) in enumerate(zip(iterations, disk, around, strict=True), 1)
    }
    if not each:
        return {}
    return each | {"train": replace(train, cpu_seconds=sum(need.cpu_seconds for need in each.values()))}


def counted(summaries: Mapping[str, Summary]) -> CaptureSize | None:
    """The size of a capture as ``ingest`` told it, by its commonest camera; None where it did not run."""
    told = summaries.get("ingest", {})
    groups = told.get("camera_groups", ())
    if not groups:
        return None
    shorter, longer = sorted(max(groups, key=lambda group: int(group["photos"]))["size"])
    photos, wanted = int(told["photos"]), summaries.get("control", {})
    control = bool(wanted.get("points") or wanted.get("scale_bars"))
    return CaptureSize(photos, shorter * longer / MEGA, 2 * int(told["positions"]) > photos, shorter / longer, control)


def has_control(source: Source) -> bool:
    """Whether files of the user's ask for targets."""
    return any(source.named.get(part) is not None for part in ("source.control", "source.scale_bars"))


def seconds(need: Need, threads: int) -> float:
    """How long a stage takes with so many cores to itself."""
    return need.seconds(threads)


def machine_speed() -> float:
    """How fast a core of this machine is, against that of the costs: a fixed piece of packing, 0.05 s."""
    text = " ".join(str(number * number % 9973) for number in range(SPEED_NUMBERS)).encode()
    took = []
    for _ in range(SPEED_TRIES):
        began = time.thread_time()
        zlib.compress(text, SPEED_LEVEL)
        took.append(time.thread_time() - began)
    least, most = SPEED_RANGE
    return min(most, max(least, SPEED_S / max(min(took), 1e-6)))
