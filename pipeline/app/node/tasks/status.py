"""The status of a task, as a client is told it: from memory only."""

from __future__ import annotations

import time
from dataclasses import dataclass

from splatpipe.pipeline.app.node.tasks.jobs import NO_FORECAST, Forecast, Job
from splatpipe.pipeline.app.node.tasks.record import (
    CANCELED,
    COMPLETED,
    FAILED,
    NEVER_STARTED,
    QUEUED,
    RUNNING,
    Task,
)
from splatpipe.pipeline.app.node.tasks.run import JobProcess

PACKING, PACKING_PERCENT = "packing the results", 99.0


@dataclass(frozen=True)
class TaskStatus:
    """What a client is told of a task.

    Attributes:
        code: The API's status code.
        progress: Per cent.
        processing_ms: Duration so far; -1 before its start or after a cancellation.
        error: Why it failed; empty otherwise.
        stage: The stage that is running; empty otherwise.
        what: What it is doing.
        left_s: Forecast seconds until its end; 0 if unknown.
        waiting: What it waits for besides its turn, a sentence; empty for nothing.
        forecast: What its run needs.
    """

    code: int
    progress: float
    processing_ms: int
    error: str = ""
    stage: str = ""
    what: str = ""
    left_s: float = 0.0
    waiting: str = ""
    forecast: Forecast = NO_FORECAST


def task_status(task: Task, job: Job | None, process: JobProcess | None) -> TaskStatus:
    """The status of a task.

    Args:
        task: The task, committed.
        job: Its job; None before its photos are there.
        process: The job's process; None if it has none now.
    """
    forecast = NO_FORECAST if job is None else job.forecast
    if task.state == "completed":
        return TaskStatus(COMPLETED, 100.0, task.processing_ms, forecast=forecast)
    if task.state == "failed":
        return TaskStatus(FAILED, 0.0, task.processing_ms, task.error, forecast=forecast)
    if task.state == "canceled":
        return TaskStatus(CANCELED, 0.0, NEVER_STARTED, forecast=forecast)
    if job is None:
        return TaskStatus(QUEUED, 0.0, NEVER_STARTED)
    if job.state in ("packing", "done", "failed"):  # it has run; the task is about to be told
        spent_ms = int(1000 * job.seconds)
        return TaskStatus(RUNNING, PACKING_PERCENT, spent_ms, what=PACKING, waiting=job.waiting, forecast=forecast)
    if process is None or process.progress is None:
        return TaskStatus(QUEUED, 0.0, NEVER_STARTED, waiting=job.waiting, forecast=forecast)
    progress = process.progress
    return TaskStatus(
        RUNNING,
        progress.percent,
        int(1000 * (job.seconds + time.monotonic() - process.child.began_s)),
        stage=progress.stage,
        what=progress.what,
        left_s=progress.left_s,
        forecast=forecast,
    )
