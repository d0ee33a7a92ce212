"""Runs the jobs that tasks want: one thread starts, follows and ends all processes.

A task is committed, cancelled, restarted and removed by other threads; each changes records under the scheduler's lock
and wakes it. What is to be done follows from the records alone, so that after any end of the node the next one goes on.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from splatpipe.pipeline.app.node.tasks.disk import free_bytes
from splatpipe.pipeline.app.node.tasks.endings import Verdict, judge_run
from splatpipe.pipeline.app.node.tasks.jobs import NO_FORECAST, Forecast, Job, JobStore, job_key
from splatpipe.pipeline.app.node.tasks.log import last_line
from splatpipe.pipeline.app.node.tasks.names import kind_of
from splatpipe.pipeline.app.node.tasks.options import GivenOptions
from splatpipe.pipeline.app.node.tasks.queue import Running, Waiting, next_run, start_times
from splatpipe.pipeline.app.node.tasks.record import (
    CANCELED,
    COMPLETED,
    FAILED,
    NEVER_STARTED,
    QUEUED,
    RUNNING,
    Task,
)
from splatpipe.pipeline.app.node.tasks.run import (
    JobProcess,
    forecast_fields,
    prepare,
    read_forecast,
    start_forecast,
    start_pack,
    start_run,
)
from splatpipe.pipeline.app.node.tasks.settings import Settings
from splatpipe.pipeline.app.node.tasks.store import TaskStore, UnknownTaskError, now_ms
from splatpipe.pipeline.app.node.tasks.uploads import FileFacts
from splatpipe.pipeline.engine.errors import EXIT_MACHINE, EXIT_STAGE, SplatpipeError
from splatpipe.pipeline.engine.machine import available_memory_bytes, free_memory_bytes

BUSY_S, IDLE_S = 0.1, 1.0  # between looks at the processes, and at the queue if there are none
FOLLOW_S = 1.0  # between reads of the running processes' events
FORECASTS = 2  # at once: each loads the libraries that read photos
END_S = 5.0  # from SIGTERM to SIGKILL
STALLED_S = 6 * 3600.0  # without any event, a run is ended and tried again
WAIT_S = 20.0  # an answer waits at most so long for a run's end: clients wait 30 s
MEMORY_MARGIN = 1.3  # a forecast is within 30 % of what is used
FORECAST_TRIES = 3
DROPPED = "Options that this node does not offer were ignored"
STALLED = "It stood still for hours and was stopped."


class RefusedTaskError(ValueError):
    """A request that a task's state or content does not allow; the message is a sentence for the client."""


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


class Scheduler:
    """Carries out the tasks of a node.

    Args:
        tasks: Its tasks.
        jobs: Its jobs.
        settings: Its settings.
        tell: Receives lines for the node's user.
    """

    def __init__(self, tasks: TaskStore, jobs: JobStore, settings: Settings, tell: Callable[[str], None]) -> None:
        self.tasks, self.jobs, self.settings = tasks, jobs, settings
        self._tell = tell
        self._changed = threading.Condition(threading.RLock())
        self._processes: dict[str, JobProcess] = {}
        self._not_before: dict[str, float] = {}  # when a job may be tried again, time.monotonic()
        self._forecast_tries: dict[str, int] = {}
        self._stopping = False
        self._followed_s = 0.0
        self._thread = threading.Thread(target=self._work, name="scheduler", daemon=True)

    def start(self) -> None:
        """Begin to run what is wanted."""
        self.restore()
        self._thread.start()

    def restore(self) -> None:
        """Go on from the records of an earlier process, however it ended."""
        for job in self.jobs.all():
            if job.state == "running":
                self.jobs.change(job.key, state="queued")
        for task in self.tasks.all():
            if task.state == "wanted" and self.jobs.get(task.job) is None:  # its record was lost
                with suppress(OSError):
                    self._join(task.job, self.tasks.uploads(task.uuid).digests(), task)

    def stop(self) -> None:
        """End all processes; their jobs go on when the node is started again."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def commit(self, uuid: str) -> Task:
        """Close a task's upload and queue it; a second time changes nothing.

        Raises:
            UnknownTaskError: if there is no such task.
            RefusedTaskError: if it has no photos.
            OSError: if the disk is full; the task can be committed later.
        """
        if self.tasks.get(uuid).state not in ("uploading", "fetching"):
            return self.tasks.get(uuid)
        uploads = self.tasks.uploads(uuid)
        uploads.close()
        try:
            return self._commit(uuid, uploads.digests())
        except BaseException:
            uploads.reopen()
            raise

    def _commit(self, uuid: str, photos: Mapping[str, FileFacts]) -> Task:
        images = sum(kind_of(name) in ("photo", "film") for name in photos)
        if not images:
            raise RefusedTaskError("There are no photos in this task: send JPEG, PNG or TIFF files.")
        with self._changed:
            task = self.tasks.get(uuid)
            if task.state not in ("uploading", "fetching"):
                return task
            job = self._join(job_key(photos, task.options, task.outputs), photos, task)
            notes = (*task.notes, *_dropped_note(task.dropped))
            task = self.tasks.change(uuid, state="wanted", job=job.key, images=images, notes=notes)
            self._changed.notify_all()
        self._store_once(job, uuid)
        return task

    def _join(self, key: str, photos: Mapping[str, Any], task: Task, seed: str = "") -> Job:
        """The job of a key: an existing one, tried again if it failed, or a new one."""
        job = self.jobs.get(key)
        if job is None:
            others = [each for each in self.jobs.all() if each.photos == photos and each.key != key]
            seed = seed or next((each.key for each in others if each.has_ended), others[0].key if others else "")
            job = Job(key, photos, dict(task.options), task.outputs, task.name, seed=seed, queued_ms=now_ms())
            self.jobs.put(job)
        elif job.state == "failed":
            self.jobs.output(key).unlink(missing_ok=True)
            job = self.jobs.change(
                key, state="new", error="", tries=0, seconds=0.0, waiting="", queued_ms=now_ms(), began_ms=0, ended_ms=0
            )
            self._not_before.pop(key, None)
        return job

    def _store_once(self, job: Job, uuid: str) -> None:
        """Let an equal upload share the bytes on the disk with the job's files."""
        with suppress(OSError, UnknownTaskError):
            photos, uploads = self.jobs.photos(job.key), self.tasks.uploads(uuid)
            for name in job.photos:
                there = photos / name
                if there.exists() and not there.samefile(uploads.path / name):
                    uploads.replace_by(name, there)

    def cancel(self, uuid: str) -> Task:
        """Cancel a task in any state; returns once its run has ended, unless another task wants it.

        Raises:
            UnknownTaskError: if there is no such task.
        """
        with self._changed:
            task = self.tasks.get(uuid)
            if task.state != "canceled":
                ended: dict[str, Any] = {
                    "ended_ms": now_ms(),
                    "processing_ms": NEVER_STARTED,
                    "error": "",
                    "told": False,
                }
                task = self.tasks.change(uuid, later=True, state="canceled", **ended)
            self._changed.notify_all()
        self._await_end(task.job)
        return task

    def remove(self, uuid: str) -> None:
        """Remove a task and its files; returns once its run has ended, unless another task wants it.

        Raises:
            UnknownTaskError: if there is no such task.
            OSError: if its folder cannot be moved.
        """
        with self._changed:
            task = self.tasks.get(uuid)
            self.tasks.remove(uuid)
            self._changed.notify_all()
        self._await_end(task.job)

    def restart(self, uuid: str, options: GivenOptions | None) -> Task:
        """Run an ended task again, with other options if some are given; valid results are reused.

        Raises:
            UnknownTaskError: if there is no such task.
            RefusedTaskError: if it has not ended.
            OSError: if the disk is full.
        """
        with self._changed:
            task = self.tasks.get(uuid)
            photos = self.tasks.uploads(uuid).digests() if task.has_ended else {}
            if not photos:
                raise RefusedTaskError("Task cannot be restarted")
            notes = tuple(line for line in task.notes if not line.startswith(DROPPED))
            if options is not None:
                task = replace(task, options=dict(options.values), dropped=options.dropped)
            notes += _dropped_note(task.dropped)
            job = self._join(job_key(photos, task.options, task.outputs), photos, task, seed=task.job)
            task = self.tasks.replace(
                replace(
                    task,
                    state="wanted",
                    job=job.key,
                    notes=notes,
                    error="",
                    processing_ms=NEVER_STARTED,
                    ended_ms=0,
                    told=False,
                )
            )
            self._changed.notify_all()
        return task

    def remove_unused(self) -> None:
        """Remove the jobs that no task refers to, and folders of jobs that cannot be read.

        Raises:
            OSError: if one cannot be moved.
        """
        with self._changed:
            used = {task.job for task in self.tasks.all()} | set(self._processes)
            used |= {job.seed for job in self.jobs.all() if job.state == "new" and job.key in used}
            for job in self.jobs.all():
                if job.key not in used:
                    self.jobs.forget(job.key)
                    self.tasks.discard(self.jobs.path(job.key))

    def _await_end(self, key: str) -> None:
        until_s = time.monotonic() + WAIT_S
        with self._changed:
            while key in self._processes and key not in self._wanted() and time.monotonic() < until_s:
                self._changed.wait(BUSY_S)

    def status(self, uuid: str) -> TaskStatus:
        """The status of a committed task, from memory only.

        Raises:
            UnknownTaskError: if there is no such task.
        """
        task = self.tasks.get(uuid)
        job, process = self.jobs.get(task.job), self._processes.get(task.job)
        forecast = job.forecast if job is not None else NO_FORECAST
        if task.state == "completed":
            return TaskStatus(COMPLETED, 100.0, task.processing_ms, forecast=forecast)
        if task.state == "failed":
            return TaskStatus(FAILED, 0.0, task.processing_ms, task.error, forecast=forecast)
        if task.state == "canceled":
            return TaskStatus(CANCELED, 0.0, NEVER_STARTED, forecast=forecast)
        if job is None or process is None or process.phase == "forecast" or job.state in ("new", "queued"):
            waiting = "" if job is None else job.waiting
            return TaskStatus(QUEUED, 0.0, NEVER_STARTED, waiting=waiting, forecast=forecast)
        progress = process.progress
        spent_s = job.seconds + time.monotonic() - process.child.began_s
        return TaskStatus(
            RUNNING,
            99.0 if progress is None else progress.percent,
            max(0, int(1000 * spent_s)),
            stage="" if progress is None else progress.stage,
            what="packing the results" if progress is None else progress.what,
            left_s=0.0 if progress is None else progress.left_s,
            forecast=forecast,
        )

    def counts(self) -> tuple[int, int]:
        """Number of tasks that are queued and that are running."""
        active = [task.job for task in self.tasks.all() if task.state in ("fetching", "wanted")]
        under_way = {key for key, each in list(self._processes.items()) if each.phase != "forecast"}
        running = sum(key in under_way for key in active)
        return len(active) - running, running

    def start_times(self) -> dict[str, float]:
        """Estimated seconds until each waiting job starts, by its key, in the order of the queue."""
        return start_times(self._waiting(), self._running(), self.settings.parallel)

    def _wanted(self) -> set[str]:
        return {task.job for task in self.tasks.all() if task.state == "wanted"}

    def _waiting(self) -> list[Waiting]:
        wanted, now_s = self._wanted(), time.monotonic()
        return [
            Waiting(job.key, round(MEMORY_MARGIN * job.forecast.memory_bytes), job.forecast.seconds)
            for job in self.jobs.all()
            if job.key in wanted
            and job.state == "queued"
            and job.key not in self._processes
            and self._not_before.get(job.key, 0.0) <= now_s
        ]

    def _running(self) -> list[Running]:
        return [
            Running(round(MEMORY_MARGIN * each.forecast.memory_bytes), each.progress.left_s)
            for each in list(self._processes.values())
            if each.progress is not None
        ]

    def _work(self) -> None:
        try:
            while not self._stopping:
                with self._changed:
                    self._look()
                    self._changed.wait(BUSY_S if self._processes else IDLE_S)
        finally:
            self._end_all()

    def _end_all(self) -> None:
        with self._changed:
            processes, self._processes = list(self._processes.values()), {}
            for process in processes:
                process.child.ask_to_end()
            until_s = time.monotonic() + END_S
            for process in processes:
                process.child.wait_or_kill(until_s)
            self.jobs.write_late()
            self.tasks.write_late()

    def _look(self) -> None:
        """Do everything that can be done now."""
        wanted, now_s = self._wanted(), time.monotonic()
        for process in list(self._processes.values()):
            self._follow(process, process.key in wanted, now_s)
        if now_s - self._followed_s > FOLLOW_S:
            self._followed_s = now_s
            self.tasks.write_late()
            self.jobs.write_late()
            for process in self._processes.values():
                if process.progress is not None:
                    process.progress.read()
        for job in self.jobs.all():
            if job.key in wanted and job.key not in self._processes:
                self._advance(job, now_s)
        self._start_next()

    def _follow(self, process: JobProcess, wanted: bool, now_s: float) -> None:
        code = process.child.poll()
        if code is not None:
            del self._processes[process.key]
            self._changed.notify_all()
            self._ended(process, code, wanted and (process.stalled or not process.ending_s))
        elif process.ending_s:
            if now_s - process.ending_s > END_S:
                process.child.wait_or_kill(now_s)
        else:
            process.stalled = process.progress is not None and now_s - process.progress.moved_s > STALLED_S
            if process.stalled or not wanted:
                process.ending_s = now_s
                process.child.ask_to_end()

    def _advance(self, job: Job, now_s: float) -> None:
        """Take the next step of a wanted job that has no process."""
        if self._not_before.get(job.key, 0.0) > now_s:
            return
        if job.has_ended:
            self._settle(job)
        elif job.state == "new":
            if sum(each.phase == "forecast" for each in self._processes.values()) < FORECASTS:
                self._begin(job, self._forecast)
        elif job.state == "packing":
            self._begin(job, lambda each: start_pack(each, self.jobs))

    def _forecast(self, job: Job) -> JobProcess:
        source = next((task.uuid for task in self.tasks.all() if task.job == job.key), None)
        if source is None:
            raise FileNotFoundError(f"no task has the photos of {job.key}")
        prepare(job, self.jobs, self._source_of(job, source))
        return start_forecast(job, self.jobs, self.settings.threads)

    def _source_of(self, job: Job, uuid: str) -> Any:
        """Where a new job's files are: with the task that wants it, or with the job that it was before."""
        upload = self.tasks.uploads(uuid).path
        return upload if all((upload / name).exists() for name in job.photos) else self.jobs.photos(job.seed)

    def _begin(self, job: Job, start: Callable[[Job], JobProcess]) -> None:
        try:
            self._processes[job.key] = start(job)
        except OSError as error:
            self._put_off(job, f"{error.strerror or error}")
        except SplatpipeError as error:
            self._put_off(job, error.message)

    def _start_next(self) -> None:
        memory, free = available_memory_bytes(), free_memory_bytes()
        while True:
            waiting = [each for each in self._waiting() if self._disk_suffices(each.key)]
            running = self._running()
            key = next_run(waiting, running, self.settings.parallel, memory, free)
            job = None if key is None else self.jobs.get(key)
            if job is None:
                return
            job = self.jobs.change(job.key, state="running", began_ms=job.began_ms or now_ms(), waiting="")
            self._begin(job, lambda each: start_run(each, self.jobs, self.settings.threads))
            if job.key not in self._processes:
                self.jobs.change(job.key, state="queued")
                return

    def _disk_suffices(self, key: str) -> bool:
        """Whether the disk has what a run needs; if not, it waits, and its task says for what."""
        job = self.jobs.get(key)
        if job is None:
            return False
        lacking = job.forecast.disk_bytes - free_bytes(self.settings.folder)
        text = f"It waits for {lacking / 1e9:.1f} GB more of free disk on the node." if lacking > 0 else ""
        if text != job.waiting and bool(text) != bool(job.waiting):
            self.jobs.change(key, waiting=text)
        return lacking <= 0

    def _ended(self, process: JobProcess, code: int, wanted: bool) -> None:
        """Take note of the end of a process."""
        job = self.jobs.get(process.key)
        if job is None:
            return
        if process.phase == "forecast":
            self._forecast_ended(job, wanted)
            return
        spent_s = round(job.seconds + time.monotonic() - process.child.began_s, 3)
        if process.phase == "pack":
            self._pack_ended(job, code, spent_s, wanted)
            return
        if code == 0:
            self.jobs.change(job.key, state="packing", seconds=spent_s, tries=0)
            return
        job = self.jobs.change(job.key, state="queued", seconds=spent_s)
        if wanted:
            progress = process.progress
            assert progress is not None
            progress.read()
            text = STALLED if process.stalled else f"{progress.message} {progress.hint}".strip()
            last = last_line(self.jobs.output(job.key))
            self._judge(job, judge_run(EXIT_STAGE if process.stalled else code, text, last, job.tries))

    def _pack_ended(self, job: Job, code: int, spent_s: float, wanted: bool) -> None:
        if code == 0:
            self._settle(self.jobs.change(job.key, state="done", seconds=spent_s, ended_ms=now_ms(), waiting=""))
        elif wanted:
            text = last_line(self.jobs.output(job.key))
            self._judge(job, judge_run(EXIT_MACHINE if code == EXIT_MACHINE else EXIT_STAGE, text, "", job.tries))

    def _judge(self, job: Job, verdict: Verdict) -> None:
        text = self.jobs.labels(job.key).plain(verdict.text)
        if verdict.final:
            job = self.jobs.change(job.key, state="failed", error=text, ended_ms=now_ms(), waiting="")
            self._settle(job)
        else:
            self.jobs.change(job.key, tries=job.tries + 1)
            self._put_off(job, text, verdict.delay_s)

    def _forecast_ended(self, job: Job, wanted: bool) -> None:
        if not wanted:
            return
        try:
            found = read_forecast(job, self.jobs)
            if "error" in found:
                error = self.jobs.labels(job.key).plain(str(found["error"]))
                if found.get("lasting"):
                    self._judge(job, Verdict(error, final=True))
                else:
                    self._put_off(job, error)
                return
            self.jobs.change(job.key, state="queued", forecast=Forecast(**forecast_fields(found)), waiting="")
        except (OSError, ValueError) as error:
            tries = self._forecast_tries[job.key] = self._forecast_tries.get(job.key, 0) + 1
            if tries >= FORECAST_TRIES:  # what the forecast dies of, the run says better
                self.jobs.change(job.key, state="queued", forecast=Forecast(len(job.photos)))
            else:
                self._put_off(job, f"Its forecast failed: {error}", 1.0)

    def _put_off(self, job: Job, why: str, delay_s: float = 30.0) -> None:
        """Try again later: trouble that passes is not the task's."""
        self._not_before[job.key] = time.monotonic() + delay_s
        self.jobs.change(job.key, waiting=why)
        self._tell(f"{job.key[:8]} is tried again in {delay_s:.0f} s: {why}")

    def _settle(self, job: Job) -> None:
        """Pass the end of a job on to the tasks that want it."""
        ended: dict[str, Any] = {"ended_ms": now_ms(), "processing_ms": int(1000 * job.seconds), "error": job.error}
        state = "completed" if job.state == "done" else "failed"
        for task in self.tasks.all():
            if task.state == "wanted" and task.job == job.key:
                self.tasks.change(task.uuid, later=True, state=state, told=False, **ended)


def _dropped_note(dropped: Sequence[str]) -> tuple[str, ...]:
    return (f"{DROPPED}: {', '.join(dropped)}",) if dropped else ()
