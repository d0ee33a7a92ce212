"""Jobs of stages' shards, whose number is known once the stage that counts them has run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from splatpipe.pipeline.app.batch.jobs.plan import Call, StageJob
from splatpipe.pipeline.app.library.requests import existing_request
from splatpipe.pipeline.engine.runs.line import StageStatus, line_status
from splatpipe.pipeline.engine.runs.needs import Need, of_shard
from splatpipe.pipeline.engine.runs.session import status_of
from splatpipe.pipeline.engine.stage import Shard, Stage, stage_name

MEMORY_MARGIN = 1.3  # a forecast is within 30 % of what is used
NOTHING = Need(memory_bytes=200_000_000, cpu_seconds=1.0, disk_bytes=1_000_000)  # a process that finds nothing to do
# Where a job's memory is enforced, these are part of it: two processes of Snakemake, job.py, and the command that waits
# for the stage's process. Measured with Slurm: 340 MB, and some for the files that they read.
CLUSTER_BYTES = 450_000_000
# Least busy share of the processors that a stage requests on a cluster, where others could use them.
MIN_EFFICIENCY = 0.5


def stage_job(name: str, need: Need, threads: int, *, local: bool = True) -> StageJob:
    """A job from its expected resource use.

    Args:
        name: The stage's name.
        need: Its expected resource use.
        threads: Threads available to it; on a cluster it requests no more than it can use.
        local: Whether it runs on this machine, where nothing enforces a job's own memory.
    """
    memory = round(MEMORY_MARGIN * need.memory_bytes)
    if not local:
        memory = max(memory, NOTHING.memory_bytes) + CLUSTER_BYTES
        threads = useful_threads(need, threads)
    return StageJob(name, threads, memory, need.seconds(threads), need.disk_bytes + need.scratch_bytes)


def useful_threads(need: Need, most: int) -> int:
    """The largest number of threads of which a stage keeps more than ``MIN_EFFICIENCY`` busy; at least one."""
    one = need.seconds(1)
    return max((n for n in range(1, most + 1) if one > MIN_EFFICIENCY * n * need.seconds(n)), default=1)


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
    missing: Mapping[str, Sequence[Shard]], needs: Mapping[str, Need], threads: int, *, local: bool = True
) -> dict[str, list[StageJob]]:
    """The jobs of shards, by stage.

    Args:
        missing: Shards by stage.
        needs: The forecast.
        threads: Threads available to a job.
        local: As for ``stage_job``.
    """
    return {
        stage: [
            stage_job(f"{stage}.{shard.number}", of_shard(needs, stage, shard) or NOTHING, threads, local=local)
            for shard in shards
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
    plan = call.plan()
    request = existing_request(call.out / plan.capture(key).name)
    statuses = list(line_status(*status_of(request)))
    summaries = {each.stage.name: each.artifact.summary for each in statuses if each.artifact is not None}
    needs = request.forecast_needs(summaries)
    call.write_shards(key, shard_jobs(missing_shards(statuses), needs, threads, local=plan.local))
