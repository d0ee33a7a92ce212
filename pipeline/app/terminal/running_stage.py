"""A stage that runs, as it is shown: its steps, its bar, and the shards that are left after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rich.progress import TaskID

from splatpipe.pipeline.app.report.facts.wording import duration
from splatpipe.pipeline.engine.stage import stage_name


@dataclass(frozen=True)
class Step:
    """A step of a stage, whose progress is counted by itself.

    Attributes:
        what: What is being done.
        began_s: When it was first reported, ``time.monotonic()``.
        done: How much of it was done then: a resumed training begins in the middle.
    """

    what: str = ""
    began_s: float = 0.0
    done: float = 0.0

    def left_s(self, now_s: float, done: float, total: float) -> float | None:
        """Seconds left at the rate until now; None if nothing was done since it began, or nothing is left."""
        if not self.done < done < total:
            return None
        return (now_s - self.began_s) * (total - done) / (done - self.done)


@dataclass
class RunningStage:
    """What is shown of a stage that runs; another may run beside it.

    Attributes:
        began_s: When it started, ``time.monotonic()``.
        printed_s: When its progress was last printed as a line.
        step: The step it is in.
        done: How much of that is done.
        task: Its bar on a terminal.
    """

    began_s: float
    printed_s: float = 0.0
    step: Step = Step()
    done: float = 0.0
    task: TaskID | None = None


class ShardTimes:
    """Durations of a stage's shards, run one after the other, to estimate the time left for all of them."""

    def __init__(self) -> None:
        self._took: dict[str, dict[str, float]] = {}
        self._after: dict[str, int] = {}  # shards that are left after the current one, by stage

    def begin(self, stage: str, shard: Mapping[str, int] | None) -> None:
        """Record the start of a stage or of one of its shards.

        Args:
            stage: Its name.
            shard: Its number and count; None for the stage's own body.
        """
        of = stage_name(stage)
        self._after[of] = 0
        if shard is not None:
            took = self._took.get(of, {})
            later = (f"{of}.{number}" for number in range(shard["number"] + 1, shard["count"] + 1))
            self._after[of] = sum(name not in took for name in later)

    def end(self, stage: str, seconds: float) -> None:
        """Record the end of a shard."""
        if stage != stage_name(stage):
            self._took.setdefault(stage_name(stage), {})[stage] = seconds

    def left(self, stage: str, seconds: float, done: float, total: float) -> str:
        """The approximate time left for all shards, in words; empty for the last one, and if unknown.

        Args:
            stage: Its stage, or the current shard.
            seconds: Elapsed time of the current shard.
            done: Its work done.
            total: Its total work.
        """
        of = stage_name(stage)
        after = self._after.get(of, 0)
        if not after or not done or not total:
            return ""
        whole = seconds * total / done
        each = [*self._took.get(of, {}).values(), whole]
        left = whole - seconds + after * sum(each) / len(each)
        return f", {duration(left)} including the {after} remaining"
