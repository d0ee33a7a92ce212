"""What a stage takes of a machine: as it is forecast, and as it was."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

from splatpipe.pipeline.engine.stage import JSON, Summary


@dataclass(frozen=True)
class Need:
    """A stage's forecast.

    Attributes:
        memory_bytes: Peak resident memory of the process that it runs in.
        cpu_seconds: Of all its threads together.
        disk_bytes: What it leaves in OUT.
        scratch_bytes: What it takes there besides while it runs.
        parallel: Share of the CPU seconds that is divided among the threads.
    """

    memory_bytes: int
    cpu_seconds: float
    disk_bytes: int
    scratch_bytes: int = 0
    parallel: float = 1.0

    def seconds(self, threads: int) -> float:
        """How long it takes with so many cores to itself."""
        return self.cpu_seconds * (1.0 - self.parallel + self.parallel / max(1, threads))

    def as_json(self) -> dict[str, JSON]:
        """For a manifest."""
        return {**asdict(self), "cpu_seconds": round(self.cpu_seconds, 2)}


Foresight = Callable[[Mapping[str, Summary]], Mapping[str, Need]]
"""Forecasts by stage from the summaries of those that are done; a stage that nothing is known of is not in it."""


def unforeseen(_summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
    """The foresight of a line that has none."""
    return {}


def used_and_forecast(manifest: Mapping[str, JSON]) -> dict[str, JSON]:
    """What a finished stage took and what had been forecast for it, from its manifest; null where nothing had been."""
    disk = sum(file["size"] for part in manifest["parts"].values() for file in part["files"])
    used = {"memory_bytes": manifest["peak_memory_bytes"], "cpu_seconds": manifest["cpu_seconds"], "disk_bytes": disk}
    forecast = manifest.get("forecast")
    return {"used": used, "forecast": None if forecast is None else {name: forecast[name] for name in used}}


def whole(needs: Mapping[str, Need]) -> Need:
    """Of a run of these stages, one after the other: the largest memory, all the time, all that is left on the disk.

    Args:
        needs: By stage; at least one.
    """
    each = list(needs.values())
    cpu = sum(need.cpu_seconds for need in each)
    return Need(
        max(need.memory_bytes for need in each),
        cpu,
        sum(need.disk_bytes for need in each),
        max(need.scratch_bytes for need in each),
        sum(need.cpu_seconds * need.parallel for need in each) / cpu if cpu > 0.0 else 1.0,
    )
