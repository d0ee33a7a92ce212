"""Generates a call's Snakemake workflow: one rule per job's last stage, with exactly the jobs of the plan.

The artifact store remains the only cache: each call has its own folder and its own output names, none of which exist
yet, so that neither file times nor Snakemake's records decide anything. An output is a marker file that the job writes
when its stages are done.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from splatpipe.pipeline.app.batch.jobs.plan import (
    MEGABYTE,
    SHARDS_FOLDER,
    BatchPlan,
    Call,
    resources_of,
    workflow_jobs,
)
from splatpipe.pipeline.app.batch.jobs.shards import counts_shards
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.python_module import python_module
from splatpipe.pipeline.engine.stage import JSON, Stage, stage_name

SNAKEFILE = "Snakefile"
GPU_STAGES = ("blocks", "train", "clean", "evaluate", "flythrough")

_HEAD = """\
# Written by splatpipe batch for one call; the next call writes its own.
# By capture and last stage of a job: threads, megabytes of memory, minutes, megabytes of disk.
JOBS = {jobs}
BEFORE = {{capture: dict(zip(list(jobs)[1:], jobs)) for capture, jobs in JOBS.items()}}


def memory(megabytes, attempt):
    return min(megabytes * attempt, max(megabytes, {largest}))


def before(wildcards, stage):
    return [f"{done}/{{wildcards.capture}}/{{name}}" for name in [BEFORE[wildcards.capture].get(stage)] if name]
{shards}

wildcard_constraints:
    capture="[0-9A-Za-z-]+",
    shard="[0-9]+",


rule all:
    input:
        [f"{done}/{{capture}}/{{list(jobs)[-1]}}" for capture, jobs in JOBS.items()],
"""

_SHARDS = """
# Of a capture's shards, by name, as JOBS; the job that counts them writes the file, or the command where it is known.
def shards(capture, stage):
    import json

    try:
        with open(f"{folder}/{{capture}}.json", encoding="utf-8") as file:
            return json.load(file)[stage]["resources"]
    except (FileNotFoundError, KeyError):
        return None


def joined(wildcards, stage, counted):
    if counted not in JOBS[wildcards.capture]:  # one job runs both stages
        return before(wildcards, stage)
    if shards(wildcards.capture, stage) is None:
        getattr(checkpoints, counted).get(capture=wildcards.capture)
    names = shards(wildcards.capture, stage) or {{}}
    return [*before(wildcards, stage), *(f"{done}/{{wildcards.capture}}/{{name}}" for name in names)]
"""

_RULE = """

{kind} {name}:
    input:
        lambda wildcards: {after},
    output:
        "{done}/{{capture}}/{output}",
    priority: {priority}
    threads: lambda wildcards: {jobs}[0]
    resources:
        mem_mb=lambda wildcards, attempt: memory({jobs}[1], attempt),
        runtime=lambda wildcards, attempt: {jobs}[2] * attempt,
        disk_mb=lambda wildcards: {jobs}[3],
        attempt=lambda wildcards, attempt: attempt,
{gpu}    shell:
        "exec {job} {{wildcards.capture:q}} {output_name} {{threads}} {{output:q}} {{resources.attempt}}"
"""


def workflow_text(call: Call, plan: BatchPlan, stages: Sequence[Stage]) -> str:
    """The Snakefile of a plan.

    Args:
        call: The call, whose folder is passed to the jobs.
        plan: The plan.
        stages: The pipeline, in order; a stage that is no job's last gets no rule.
    """
    jobs: dict[str, dict[str, JSON]] = {
        capture.key: {name: resources_of(of_job) for name, of_job in workflow_jobs(capture.jobs).items()}
        for capture in plan.captures
        if capture.jobs
    }
    largest = plan.node_memory_bytes // MEGABYTE or 'float("inf")'
    done = f"done-{plan.began_s:.3f}"  # storage that outlives the call still has those of earlier calls
    wanted = {name for stages_of in jobs.values() for name in stages_of}
    words = python_module("splatpipe.pipeline.app.batch.jobs.job", str(call.folder))
    job = shlex.join(words).encode("unicode_escape").decode("ascii")  # as in a Python string literal
    job = job.replace('"', '\\"').replace("{", "{{").replace("}", "}}")
    rules, divided = [], False
    for place, stage in enumerate(stages):
        if stage.name not in wanted:
            continue
        # The first stage, which finds broken photos, goes first; then the later the stage, the higher its priority, so
        # that captures finish one after the other.
        rule = {"done": done, "job": job, "priority": place or len(stages), "gpu": _gpu(stage.name, plan)}
        kind = "checkpoint" if counts_shards(stage.name, stages) else "rule"
        after = f'before(wildcards, "{stage.name}")'
        if stage.shards is not None:
            divided = True
            rules.append(_shard_rule(stage.name, rule, after))
            after = f'joined(wildcards, "{stage.name}", "{stage_name(stage.shards.counted_by)}")'
        names = {"name": stage.name, "output": stage.name, "output_name": stage.name}
        own = f'JOBS[wildcards.capture]["{stage.name}"]'
        rules.append(_RULE.format(**rule, **names, kind=kind, after=after, jobs=own))
    lines = ",\n".join(f"    {json.dumps(key)}: {json.dumps(of_capture)}" for key, of_capture in jobs.items())
    shards = _SHARDS.format(done=done, folder=SHARDS_FOLDER) if divided else ""
    return _HEAD.format(done=done, jobs=f"{{\n{lines}\n}}", shards=shards, largest=largest) + "".join(rules)


def _shard_rule(stage: str, rule: Mapping[str, JSON], after: str) -> str:
    """The rule of a stage's shards, one job each; their number is known now or once the preceding stage is done."""
    names = {"name": f"{stage}_shard", "output": f"{stage}.{{shard}}", "output_name": f"{stage}.{{wildcards.shard}}"}
    own = f'shards(wildcards.capture, "{stage}")["{stage}." + wildcards.shard]'
    return _RULE.format(**rule, **names, kind="rule", after=after, jobs=own)


def _gpu(stage: str, plan: BatchPlan) -> str:
    return "        gpu=1,\n" if plan.gpu and stage in GPU_STAGES else ""


def write_workflow(call: Call, plan: BatchPlan, stages: Sequence[Stage]) -> Path:
    """Write the Snakefile into the call's folder."""
    path = call.folder / SNAKEFILE
    write_file(path, workflow_text(call, plan, stages))
    return path
