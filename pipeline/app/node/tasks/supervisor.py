"""Runs the jobs that tasks want: one thread starts, follows and ends all processes.

What is to be done follows from the records alone, so that after any end of the node the next one goes on.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.node.tasks.disk import free_bytes
from splatpipe.pipeline.app.node.tasks.endings import Verdict, judge_run
from splatpipe.pipeline.app.node.tasks.jobs import Forecast, Job, JobStore
from splatpipe.pipeline.app.node.tasks.log import last_line
from splatpipe.pipeline.app.node.tasks.queue import Running, Waiting, next_run
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
from splatpipe.pipeline.app.node.tasks.store import TaskStore, now_ms
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
STALLED = "It stood still for hours and was stopped."


class Supervisor:
    """Starts, follows and ends the processes of the jobs that tasks want, in one thread.

    Args:
        tasks: The node's tasks.
        jobs: Its jobs.
        settings: Its settings.
        tell: Receives lines for the node's user.

    Attributes:
        changed: The lock of everything that is done with several records, and what wakes the thread.
        processes: The processes under way, by the keys of their jobs.
    """

    def __init__(self, tasks: TaskStore, jobs: JobStore, settings: Settings, tell: Callable[[str], None]) -> None:
        self.tasks, self.jobs, self.settings = tasks, jobs, settings
        self._tell = tell
        self.changed = threading.Condition(threading.RLock())
        self.processes: dict[str, JobProcess] = {}
        self._not_before: dict[str, float] = {}  # when a job may be tried again, time.monotonic()
        self._forecast_tries: dict[str, int] = {}
        self._stopping = False
        self._followed_s = 0.0
        self._thread = threading.Thread(target=self._work, name="supervisor", daemon=True)

    def start(self) -> None:
        """Begin to run what is wanted."""
        self._thread.start()

    def stop(self) -> None:
        """End all processes; their jobs go on when the node is started again."""
        with self.changed:
            self._stopping = True
            self.changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def try_now(self, key: str) -> None:
        """Forget why a job was put off."""
        self._not_before.pop(key, None)
        self._forecast_tries.pop(key, None)

    def await_end(self, key: str) -> None:
        """Wait until a job that no task wants any more has no process."""
        until_s = time.monotonic() + WAIT_S
        with self.changed:
            while key in self.processes and key not in self.wanted() and time.monotonic() < until_s:
                self.changed.wait(BUSY_S)

    def wanted(self) -> set[str]:
        """Keys of the jobs that tasks want."""
        return {task.job for task in self.tasks.all() if task.state == "wanted"}

    def waiting(self) -> list[Waiting]:
        """The jobs that wait for their turn, in the order of the queue."""
        wanted, now_s = self.wanted(), time.monotonic()
        return [
            Waiting(job.key, round(MEMORY_MARGIN * job.forecast.memory_bytes), job.forecast.seconds)
            for job in self.jobs.all()
            if job.key in wanted
            and job.state == "queued"
            and job.key not in self.processes
            and self._not_before.get(job.key, 0.0) <= now_s
        ]

    def running(self) -> list[Running]:
        """The runs under way."""
        return [
            Running(round(MEMORY_MARGIN * each.forecast.memory_bytes), each.progress.left_s)
            for each in list(self.processes.values())
            if each.progress is not None
        ]

    def _work(self) -> None:
        try:
            while not self._stopping:
                with self.changed:
                    self._look()
                    self.changed.wait(BUSY_S if self.processes else IDLE_S)
        finally:
            self._end_all()

    def _end_all(self) -> None:
        with self.changed:
            processes, self.processes = list(self.processes.values()), {}
            for process in processes:
                process.child.ask_to_end()
            until_s = time.monotonic() + END_S
            for process in processes:
                process.child.wait_or_kill(until_s)
            self.jobs.write_late()
            self.tasks.write_late()

    def _look(self) -> None:
        """Do everything that can be done now."""
        wanted, now_s = self.wanted(), time.monotonic()
        for process in list(self.processes.values()):
            self._follow(process, process.key in wanted, now_s)
        if now_s - self._followed_s > FOLLOW_S:
            self._followed_s = now_s
            self.tasks.write_late()
            self.jobs.write_late()
            for process in self.processes.values():
                if process.progress is not None:
                    process.progress.read()
        for job in self.jobs.all():
            if job.key in wanted and job.key not in self.processes:
                self._advance(job, now_s)
        self._start_next()

    def _follow(self, process: JobProcess, wanted: bool, now_s: float) -> None:
        code = process.child.poll()
        if code is not None:
            del self.processes[process.key]
            self.changed.notify_all()
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
            if sum(each.phase == "forecast" for each in self.processes.values()) < FORECASTS:
                self._begin(job, self._forecast)
        elif job.state == "packing":
            self._begin(job, lambda each: start_pack(each, self.jobs))

    def _forecast(self, job: Job) -> JobProcess:
        source = next((task.uuid for task in self.tasks.all() if task.job == job.key), None)
        if source is None:
            raise FileNotFoundError(f"no task has the photos of {job.key}")
        prepare(job, self.jobs, self._source_of(job, source))
        return start_forecast(job, self.jobs, self.settings.threads)

    def _source_of(self, job: Job, uuid: str) -> Path:
        """Where a new job's files are: with the task that wants it, or with the job that it was before."""
        upload = self.tasks.uploads(uuid).path
        return upload if all((upload / name).exists() for name in job.photos) else self.jobs.photos(job.seed)

    def _begin(self, job: Job, start: Callable[[Job], JobProcess]) -> None:
        try:
            self.processes[job.key] = start(job)
        except OSError as error:
            self._put_off(job, f"{error.strerror or error}")
        except SplatpipeError as error:
            self._put_off(job, error.message)

    def _start_next(self) -> None:
        memory, free = available_memory_bytes(), free_memory_bytes()
        while True:
            waiting = [each for each in self.waiting() if self._disk_suffices(each.key)]
            running = self.running()
            key = next_run(waiting, running, self.settings.parallel, memory, free)
            job = None if key is None else self.jobs.get(key)
            if job is None:
                return
            job = self.jobs.change(job.key, state="running", began_ms=job.began_ms or now_ms(), waiting="")
            self._begin(job, lambda each: start_run(each, self.jobs, self.settings))
            if job.key not in self.processes:
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
        why = self.jobs.labels(job.key).plain(why)  # clients read it
        self.jobs.change(job.key, waiting=why)
        self._tell(f"{job.key[:8]} is tried again in {delay_s:.0f} s: {why}")

    def _settle(self, job: Job) -> None:
        """Pass the end of a job on to the tasks that want it."""
        ended: dict[str, Any] = {"ended_ms": now_ms(), "processing_ms": int(1000 * job.seconds), "error": job.error}
        state = "completed" if job.state == "done" else "failed"
        for task in self.tasks.all():
            if task.state == "wanted" and task.job == job.key:
                self.tasks.change(task.uuid, later=True, state=state, told=False, **ended)
