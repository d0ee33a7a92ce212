"""What a stage takes of a machine: as it is forecast, and as it was."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

from splatpipe.pipeline.engine.stage import JSON, Shard, Summary


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
"""Forecasts by stage from the summaries of those that are done; a stage that nothing is known of is not in it.

A stage's is with all of its shards, one after the other; a shard's own may be there by its name, e.g. ``train.2``.
"""


def unforeseen(_summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
    """The foresight of a line that has none."""
    return {}


def of_shard(needs: Mapping[str, Need], stage: str, shard: Shard) -> Need | None:
    """What a shard takes: as it is forecast, else its share of the stage's time and disk, with the stage's memory."""
    own, of_stage = needs.get(f"{stage}.{shard.number}"), needs.get(stage)
    if own is not None or of_stage is None:
        return own
    share = 1.0 / shard.count
    return replace(of_stage, cpu_seconds=share * of_stage.cpu_seconds, disk_bytes=round(share * of_stage.disk_bytes))


def used_with_shards(used: Mapping[str, JSON], shards: Sequence[Mapping[str, JSON]]) -> dict[str, JSON]:
    """What a stage took together with its shards, one after the other, for its manifest.

    Args:
        used: ``seconds``, ``cpu_seconds`` and ``peak_memory_bytes`` of its own body.
        shards: Manifests of its shards; where there are none, nothing is added.
    """
    if not shards:
        return dict(used)
    each = [used, *shards]
    told = [
        {"key": shard["key"], "disk_bytes": _disk_bytes(shard), **{name: shard[name] for name in used}}
        for shard in shards
    ]
    sums = {name: round(sum(float(one[name]) for one in each), 3) for name in ("seconds", "cpu_seconds")}
    return {**sums, "peak_memory_bytes": max(int(one["peak_memory_bytes"]) for one in each), "shards": told}


def _disk_bytes(manifest: Mapping[str, JSON]) -> int:
    """What an artifact takes on the disk, with the shards that it was made of."""
    own = sum(file["size"] for part in manifest["parts"].values() for file in part["files"])
    return int(own + sum(shard["disk_bytes"] for shard in manifest.get("shards", ())))


def used_and_forecast(manifest: Mapping[str, JSON]) -> dict[str, JSON]:
    """What a finished stage took and what had been forecast for it, from its manifest; null where nothing had been."""
    used = {"memory_bytes": manifest["peak_memory_bytes"], "cpu_seconds": manifest["cpu_seconds"]}
    used["disk_bytes"] = _disk_bytes(manifest)
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
