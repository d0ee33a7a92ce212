"""Jobs of stages' shards, whose number is known once the stage that counts them has run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from splatpipe.pipeline.app.batch.plan import Call, StageJob
from splatpipe.pipeline.app.cli_runs import existing_request
from splatpipe.pipeline.engine.line import StageStatus, line_status
from splatpipe.pipeline.engine.needs import Need, of_shard
from splatpipe.pipeline.engine.session import status_of
from splatpipe.pipeline.engine.stage import Shard, Stage, stage_name

MEMORY_MARGIN = 1.3  # a forecast is within 30 % of what is used
NOTHING = Need(memory_bytes=200_000_000, cpu_seconds=1.0, disk_bytes=1_000_000)  # a process that finds nothing to do


def stage_job(name: str, need: Need, threads: int) -> StageJob:
    """A job from its expected resource use."""
    memory = round(MEMORY_MARGIN * need.memory_bytes)
    return StageJob(name, threads, memory, need.seconds(threads), need.disk_bytes + need.scratch_bytes)


def missing_shards(statuses: Iterable[StageStatus]) -> dict[str, list[Shard]]:
    """Shards still to be run, by stage, for stages whose number of shards is known."""
    return {
        status.stage.name: [
            Shard(number, len(status.shards))
            for number, shard in enumerate(status.shards, 1)
            if shard.artifact is None and status.artifact is None
        ]
        for status in statuses
        if status.stage.shards is not None and (status.shards or status.state != "waiting")
    }


def shard_jobs(
    missing: Mapping[str, Sequence[Shard]], needs: Mapping[str, Need], threads: int
) -> dict[str, list[StageJob]]:
    """The jobs of shards, by stage.

    Args:
        missing: Shards by stage.
        needs: The forecast.
        threads: Threads per job.
    """
    return {
        stage: [
            stage_job(f"{stage}.{shard.number}", of_shard(needs, stage, shard) or NOTHING, threads) for shard in shards
        ]
        for stage, shards in missing.items()
    }


def counts_shards(stage: str, line: Sequence[Stage]) -> bool:
    """Whether a stage determines how many shards another has."""
    return any(each.shards is not None and stage_name(each.shards.counted_by) == stage for each in line)


def store_shard_jobs(call: Call, key: str, threads: int) -> None:
    """Store the jobs of a capture's shards for Snakemake, once the stage that counts them has run.

    Args:
        call: The call.
        key: The capture's key.
        threads: Threads per job.
    """
    request = existing_request(call.out / call.plan().capture(key).name)
    statuses = list(line_status(*status_of(request)))
    summaries = {each.stage.name: each.artifact.summary for each in statuses if each.artifact is not None}
    call.write_shards(key, shard_jobs(missing_shards(statuses), request.forecast_needs(summaries), threads))
