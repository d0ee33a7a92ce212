"""The workflow of a call for Snakemake: a rule a stage, with the jobs that the plan names and no others.

Ours stays the only cache: each call has a folder of its own, and outputs of names of their own, of which none is there
yet, so that neither times of files nor what Snakemake remembers decides anything. An output is a marker that the job
leaves when its stage is there.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from splatpipe.pipeline.app.batch.plan import Call, Plan
from splatpipe.pipeline.engine.stage import JSON, Stage

SNAKEFILE = "Snakefile"
GPU_STAGES = ("train", "evaluate", "flythrough")
RUNTIME_FACTOR, RUNTIME_MIN = 3.0, 15.0  # a cluster kills at the limit: minutes too many cost nothing
MEGABYTE = 10**6

_HEAD = """\
# Written by splatpipe batch for one call; the next call writes its own.
# By capture and stage: threads, megabytes of memory, minutes, megabytes of disk.
JOBS = {jobs}
BEFORE = {{capture: dict(zip(list(jobs)[1:], jobs)) for capture, jobs in JOBS.items()}}


def before(wildcards, stage):
    return [f"{done}/{{wildcards.capture}}/{{name}}" for name in [BEFORE[wildcards.capture].get(stage)] if name]


wildcard_constraints:
    capture="[0-9A-Za-z-]+",


rule all:
    input:
        [f"{done}/{{capture}}/{{list(jobs)[-1]}}" for capture, jobs in JOBS.items()],
"""

_RULE = """

rule {stage}:
    input:
        lambda wildcards: before(wildcards, "{stage}"),
    output:
        "{done}/{{capture}}/{stage}",
    priority: {priority}
    threads: lambda wildcards: JOBS[wildcards.capture]["{stage}"][0]
    resources:
        mem_mb=lambda wildcards, attempt: JOBS[wildcards.capture]["{stage}"][1] * attempt,
        runtime=lambda wildcards, attempt: JOBS[wildcards.capture]["{stage}"][2] * attempt,
        disk_mb=lambda wildcards: JOBS[wildcards.capture]["{stage}"][3],
{gpu}    shell:
        "exec {job} {{wildcards.capture:q}} {stage} {{threads}} {{output:q}}"
"""


def workflow_text(call: Call, plan: Plan, stages: Sequence[Stage]) -> str:
    """The Snakefile of a plan.

    Args:
        call: Whose folder the jobs are told.
        plan: What is to be done.
        stages: The line, in order; a stage without a job gets no rule.
    """
    jobs: dict[str, dict[str, JSON]] = {
        capture.key: {
            job.stage: _resources(job.threads, job.memory_bytes, job.seconds, job.disk_bytes) for job in capture.jobs
        }
        for capture in plan.captures
        if capture.jobs
    }
    done = f"done-{plan.began_s:.3f}"  # a storage that outlives the call has those of earlier ones
    wanted = {name for stages_of in jobs.values() for name in stages_of}
    words = [sys.executable, "-m", "splatpipe.pipeline.app.batch.job", str(call.folder)]
    job = shlex.join(words).encode("unicode_escape").decode("ascii")  # as it stands in a text of Python's
    job = job.replace('"', '\\"').replace("{", "{{").replace("}", "}}")
    rules = [
        # Broken photos are told first; then what is nearest to its end goes first, so that captures are finished one
        # after the other and not all in the morning.
        _RULE.format(done=done, stage=stage.name, priority=place or len(stages), job=job, gpu=_gpu(stage.name, plan))
        for place, stage in enumerate(stages)
        if stage.name in wanted
    ]
    lines = ",\n".join(f"    {json.dumps(key)}: {json.dumps(of_capture)}" for key, of_capture in jobs.items())
    return _HEAD.format(done=done, jobs=f"{{\n{lines}\n}}") + "".join(rules)


def _resources(threads: int, memory_bytes: int, seconds: float, disk_bytes: int) -> list[int]:
    minutes = round(RUNTIME_MIN + RUNTIME_FACTOR * seconds / 60.0)
    return [threads, max(1, memory_bytes // MEGABYTE), minutes, max(1, disk_bytes // MEGABYTE)]


def _gpu(stage: str, plan: Plan) -> str:
    return "        gpu=1,\n" if plan.gpu and stage in GPU_STAGES else ""


def write_workflow(call: Call, plan: Plan, stages: Sequence[Stage]) -> Path:
    """Write the Snakefile into the call's folder."""
    path = call.folder / SNAKEFILE
    path.write_text(workflow_text(call, plan, stages), encoding="utf-8")
    return path
