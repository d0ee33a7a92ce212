"""The resources a stage uses: forecast and measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

from splatpipe.pipeline.engine.stage import JSON, Shard, Summary


@dataclass(frozen=True)
class Need:
    """The forecast resource use of a stage.

    Attributes:
        memory_bytes: Peak resident memory of its process.
        cpu_seconds: CPU seconds of all threads together.
        disk_bytes: Size of what it writes into OUT.
        scratch_bytes: Additional disk space it uses there while it runs.
        parallel: Fraction of the CPU seconds that is divided among the threads.
    """

    memory_bytes: int
    cpu_seconds: float
    disk_bytes: int
    scratch_bytes: int = 0
    parallel: float = 1.0

    def seconds(self, threads: int) -> float:
        """Wall-clock seconds with ``threads`` cores to itself."""
        return self.cpu_seconds * (1.0 - self.parallel + self.parallel / max(1, threads))

    def as_json(self) -> dict[str, JSON]:
        """The need as JSON, for a manifest."""
        return {**asdict(self), "cpu_seconds": round(self.cpu_seconds, 2)}


ForecastFunction = Callable[[Mapping[str, Summary]], Mapping[str, Need]]
"""Forecasts by stage from the summaries of finished stages; stages without a forecast are left out.

A stage's forecast includes all of its shards, run one after the other; a shard may have its own, e.g. ``train.2``.
"""


def no_forecasts(_summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
    """The forecast function of a pipeline that has none."""
    return {}


def of_shard(needs: Mapping[str, Need], stage: str, shard: Shard) -> Need | None:
    """A shard's need: its own forecast, else its share of the stage's time and disk with the stage's memory.

    None if neither has a forecast.
    """
    own, of_stage = needs.get(f"{stage}.{shard.number}"), needs.get(stage)
    if own is not None or of_stage is None:
        return own
    share = 1.0 / shard.count
    return replace(of_stage, cpu_seconds=share * of_stage.cpu_seconds, disk_bytes=round(share * of_stage.disk_bytes))


def used_with_shards(used: Mapping[str, JSON], shards: Sequence[Mapping[str, JSON]]) -> dict[str, JSON]:
    """The resources a stage used including its shards, run one after the other, for its manifest.

    Args:
        used: ``seconds``, ``cpu_seconds`` and ``peak_memory_bytes`` of the stage's own body.
        shards: Manifests of its shards; without any, ``used`` is returned as it is.
    """
    if not shards:
        return dict(used)
    each = [used, *shards]
    shards_used = [
        {"key": shard["key"], "disk_bytes": _disk_bytes(shard), **{name: shard[name] for name in used}}
        for shard in shards
    ]
    sums = {name: round(sum(float(one[name]) for one in each), 3) for name in ("seconds", "cpu_seconds")}
    return {**sums, "peak_memory_bytes": max(int(one["peak_memory_bytes"]) for one in each), "shards": shards_used}


def _disk_bytes(manifest: Mapping[str, JSON]) -> int:
    """Bytes an artifact occupies on disk, including the shards it was made from."""
    own = sum(file["size"] for part in manifest["parts"].values() for file in part["files"])
    return int(own + sum(shard["disk_bytes"] for shard in manifest.get("shards", ())))


def used_and_forecast(manifest: Mapping[str, JSON]) -> dict[str, JSON]:
    """The resources a finished stage used and its forecast, from its manifest; ``forecast`` is None without one."""
    used = {"memory_bytes": manifest["peak_memory_bytes"], "cpu_seconds": manifest["cpu_seconds"]}
    used["disk_bytes"] = _disk_bytes(manifest)
    forecast = manifest.get("forecast")
    return {"used": used, "forecast": None if forecast is None else {name: forecast[name] for name in used}}


def whole(needs: Mapping[str, Need]) -> Need:
    """The need of a run of these stages, one after the other.

    Memory and scratch space are the largest of any stage; CPU time and disk space are totals.

    Args:
        needs: Needs by stage; at least one.
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
