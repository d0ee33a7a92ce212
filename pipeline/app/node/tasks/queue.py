"""Which waiting run starts next: the first whose memory there is, and behind it short ones that do not delay it.

Runs start in the order of their commits. If the first does not fit into the memory that the running ones leave, a later
one may start that fits and is forecast to end before the first could begin (backfilling, as on clusters: Lifka, The
ANL/IBM SP scheduling system, 1995). A run that needs more than the machine has starts alone: the forecast may be wrong,
and training keeps to the memory that there is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Waiting:
    """A run that waits.

    Attributes:
        key: Its job.
        memory_bytes: Its forecast peak memory.
        seconds: Its forecast duration.
    """

    key: str
    memory_bytes: int
    seconds: float


@dataclass(frozen=True)
class Running:
    """A run that is under way.

    Attributes:
        memory_bytes: Its forecast peak memory.
        left_s: Its forecast time left.
    """

    memory_bytes: int
    left_s: float


def next_run(
    waiting: Sequence[Waiting], running: Sequence[Running], slots: int, memory_bytes: int, free_bytes: int = 0
) -> str | None:
    """The key of the run to start now; None to wait.

    Args:
        waiting: In the order of the queue.
        running: Those under way.
        slots: How many may run at once.
        memory_bytes: Memory of the machine; 0 if unknown.
        free_bytes: Memory that is free now; 0 if unknown. Runs under way have not reached their peaks yet, so that what
            they will need is kept, too.
    """
    if not waiting or len(running) >= slots:
        return None
    first = waiting[0]
    if not running or memory_bytes == 0:
        return first.key
    left = memory_bytes - sum(each.memory_bytes for each in running)
    left = min(left, free_bytes) if free_bytes else left
    if first.memory_bytes <= left:
        return first.key
    begins_s = _time_until(first.memory_bytes, left, running)
    fitting = (each for each in waiting[1:] if each.memory_bytes <= left and each.seconds <= begins_s)
    return next((each.key for each in fitting), None)


def _time_until(needed: int, left: int, running: Sequence[Running]) -> float:
    """Seconds until ends of runs have freed enough memory; until the last if it is never enough."""
    for each in sorted(running, key=lambda run: run.left_s):
        left += each.memory_bytes
        if needed <= left:
            return each.left_s
    return max(each.left_s for each in running)


def start_times(waiting: Sequence[Waiting], running: Sequence[Running], slots: int) -> dict[str, float]:
    """Estimate when each waiting run starts, seconds from now, if memory suffices.

    Args:
        waiting: In the order of the queue.
        running: Those under way.
        slots: How many may run at once.
    """
    ends = sorted(each.left_s for each in running)[:slots]
    ends = [0.0] * max(0, slots - len(ends)) + ends
    found = {}
    for each in waiting:
        begins_s = min(ends)
        found[each.key] = begins_s
        ends[ends.index(begins_s)] = begins_s + each.seconds
    return found
