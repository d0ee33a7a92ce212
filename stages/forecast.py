"""What each stage will take of a machine: memory, CPU time and disk, from a capture's size and the options. Light.

A stage's work is counted in units (pixels looked at, pairs times keypoints, Gaussians) that follow from the size and
the options (`work.py`); `costs.py` has what a unit costs. Texture, overlap and sky are not known beforehand: captures
of one size differ by a factor of two in some stages and by less in the whole. Of CUDA devices nothing is known.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from splatpipe.pipeline.engine.machine import available_memory_bytes
from splatpipe.pipeline.engine.needs import Need
from splatpipe.pipeline.engine.needs import whole as whole
from splatpipe.pipeline.engine.source import RunSource
from splatpipe.pipeline.engine.stage import Summary
from splatpipe.pipeline.train.blocks.division import Division
from splatpipe.pipeline.train.blocks.needs import MARGIN_GROWTH, grown_from
from splatpipe.pipeline.train.limits import (
    FIXED_BYTES,
    LIBRARIES_BYTES,
    PIXEL_BYTES,
    SMALLEST_WINDOW,
    bytes_per_gaussian,
)
from splatpipe.stages.block_work import BEGINNING_S, BlockLoad
from splatpipe.stages.costs import REFERENCE, Costs
from splatpipe.stages.options import LineConfig
from splatpipe.stages.work import FEWEST_GAUSSIANS, LEAST_SHARE, MEGA, CaptureSize, CaptureWork

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
    return needs_of(CaptureWork.of(size, config, costs, threads, machine_bytes), speed)


def needs_of(work: CaptureWork, speed: float) -> dict[str, Need]:
    """What each stage of a work takes, by its name.

    Args:
        work: The line's.
        speed: Of this machine's cores, as ``machine_speed`` says.
    """
    needs, threads = work.needs(speed), work.threads
    budget = work.config.train.time_budget_s
    if not budget:
        return needs
    others = sum(need.seconds(threads) for stage, need in needs.items() if stage != "train")
    left = max(LEAST_SHARE * budget, budget - others)
    filled = work.filling(left, speed).needs(speed)
    whole_time = left / replace(filled["train"], cpu_seconds=1.0).seconds(threads)
    return {**filled, "train": replace(filled["train"], cpu_seconds=whole_time)}


def least_memory_bytes(config: LineConfig) -> int:
    """Least limit of memory that a training can keep to: its libraries, the smallest window, the fewest Gaussians."""
    model = FEWEST_GAUSSIANS * bytes_per_gaussian(config.train.sh_degree)
    return LIBRARIES_BYTES + FIXED_BYTES + PIXEL_BYTES * SMALLEST_WINDOW + model


@dataclass(frozen=True)
class Forecaster:
    """Forecasts for a run, as its stages finish.

    Attributes:
        config: The options, resolved.
        threads: That the run is given.
    """

    config: LineConfig
    threads: int
    _works: dict[object, CaptureWork] = field(default_factory=dict, compare=False, repr=False)

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
        work = self._work(size, decided)
        told = {} if decided is None else decided.get("of_blocks", {})
        return needs_of(work, self.speed) | needs_of_blocks(work, told, self.speed)

    def _work(self, size: CaptureSize, decided: Summary | None) -> CaptureWork:
        """The line's, made once as long as nothing more is known."""
        key = size, decided is None
        if key not in self._works:
            self._works[key] = work_as_decided(size, self.config, self.threads, decided)
        return self._works[key]


def work_as_decided(size: CaptureSize, config: LineConfig, threads: int, decided: Summary | None) -> CaptureWork:
    """The work as the stage ``blocks`` decided on it, on whatever machine; None: as it would decide on this one.

    Args:
        size: Of the capture.
        config: The options, resolved.
        threads: That the run is given.
        decided: What the stage said.
    """
    if decided is None:
        return CaptureWork.of(size, config, REFERENCE, threads, available_memory_bytes())
    whole_scene = CaptureWork.of_whole(size, config, REFERENCE, threads, int(decided.get("limit_bytes", 0)))
    division = decided.get("division")
    return whole_scene if division is None else whole_scene.divided_as(Division.of_facts(division))


def needs_of_blocks(work: CaptureWork, told: Mapping[str, Any], speed: float) -> dict[str, Need]:
    """Each block's need by its name, and that of all of them, once it is known what each looks at and begins with.

    Args:
        work: The line's.
        told: What ``blocks`` said of them; nothing without blocks.
        speed: Of this machine's cores.
    """
    blocks = work.blocks
    if blocks is None or not told:
        return {}
    train, cost, planned = work.needs(speed)["train"], work.costs.stages["train"], work.blocks_iterations
    loads = [
        BlockLoad(float(grown_from(*figures)), float(frozen))
        for *figures, frozen in zip(told["start"], told["steps"], told["trained"], told["frozen"], strict=True)
    ]
    found = {}
    for number, load in enumerate(loads):
        own = int(told["iterations"][number])
        cpu = cost.cpu * work.done * work.blocks_training(blocks.lengths, load) * own / max(1, planned)
        found[f"train.{number + 1}"] = replace(
            train,
            memory_bytes=work.block_memory_bytes(load),
            cpu_seconds=(cpu + BEGINNING_S) / speed,
            disk_bytes=load.left_bytes,
            scratch_bytes=int(told["disk_bytes"][number]) + load.work_bytes,
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


def has_control(source: RunSource) -> bool:
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
