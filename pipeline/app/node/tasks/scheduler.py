"""What clients do with tasks: commit, cancel, restart, remove; equal tasks share one job.

Each is called in a thread of its own, changes records under the supervisor's lock, and wakes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

from splatpipe.pipeline.app.node.tasks.jobs import Job, JobStore, job_key
from splatpipe.pipeline.app.node.tasks.names import kind_of
from splatpipe.pipeline.app.node.tasks.options import GivenOptions, dropped_notes
from splatpipe.pipeline.app.node.tasks.queue import start_times
from splatpipe.pipeline.app.node.tasks.record import NEVER_STARTED, Task
from splatpipe.pipeline.app.node.tasks.run_options import idle_options
from splatpipe.pipeline.app.node.tasks.settings import Settings
from splatpipe.pipeline.app.node.tasks.status import TaskStatus, task_status
from splatpipe.pipeline.app.node.tasks.store import TaskStore, UnknownTaskError, now_ms
from splatpipe.pipeline.app.node.tasks.supervisor import Supervisor
from splatpipe.pipeline.app.node.tasks.uploads import FileFacts


class RefusedTaskError(ValueError):
    """A request that a task's state or content does not allow; the message is a sentence for the client."""


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
        self._supervisor = Supervisor(tasks, jobs, settings, tell)

    def start(self) -> None:
        """Begin to run what is wanted."""
        self.restore()
        self._supervisor.start()

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
        self._supervisor.stop()

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
        with self._supervisor.changed:
            task = self.tasks.get(uuid)
            if task.state not in ("uploading", "fetching"):
                return task
            job = self._join(job_key(photos, task.options, task.outputs), photos, task)
            notes = (*task.notes, *_notes_on_options(task))
            task = self.tasks.change(uuid, state="wanted", job=job.key, images=images, notes=notes)
            self._supervisor.changed.notify_all()
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
            self._supervisor.try_now(key)
        elif job.state != "done" and key not in self._supervisor.wanted():  # a cancelled one is wanted again
            job = self.jobs.change(key, queued_ms=now_ms())
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
        with self._supervisor.changed:
            task = self.tasks.get(uuid)
            if task.state != "canceled":
                ended: dict[str, Any] = {
                    "ended_ms": now_ms(),
                    "processing_ms": NEVER_STARTED,
                    "error": "",
                    "told": False,
                }
                task = self.tasks.change(uuid, later=True, state="canceled", **ended)
            self._supervisor.changed.notify_all()
        self._supervisor.await_end(task.job)
        return task

    def remove(self, uuid: str) -> None:
        """Remove a task and its files; returns once its run has ended, unless another task wants it.

        Raises:
            UnknownTaskError: if there is no such task.
            OSError: if its folder cannot be moved.
        """
        with self._supervisor.changed:
            task = self.tasks.get(uuid)
            self.tasks.remove(uuid)
            self._supervisor.changed.notify_all()
        self._supervisor.await_end(task.job)

    def restart(self, uuid: str, options: GivenOptions | None) -> Task:
        """Run an ended task again, with other options if some are given; valid results are reused.

        Raises:
            UnknownTaskError: if there is no such task.
            RefusedTaskError: if it has not ended.
            OSError: if the disk is full.
        """
        with self._supervisor.changed:
            task = self.tasks.get(uuid)
            photos = self.tasks.uploads(uuid).digests() if task.has_ended else {}
            if not photos:
                raise RefusedTaskError("Task cannot be restarted")
            before = _notes_on_options(task)
            if options is not None:
                task = replace(task, options=dict(options.values), dropped=options.dropped)
            notes = (*(line for line in task.notes if line not in before), *_notes_on_options(task))
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
            self._supervisor.changed.notify_all()
        return task

    def remove_unused(self) -> None:
        """Remove the jobs that no task refers to, and folders of jobs that cannot be read.

        Raises:
            OSError: if one cannot be moved.
        """
        with self._supervisor.changed:
            used = {task.job for task in self.tasks.all()} | set(self._supervisor.processes)
            used |= {job.seed for job in self.jobs.all() if job.state == "new" and job.key in used}
            for job in self.jobs.all():
                if job.key not in used:
                    self.jobs.forget(job.key)
                    self.tasks.discard(self.jobs.path(job.key))

    def status(self, uuid: str) -> TaskStatus:
        """The status of a committed task, from memory only.

        Raises:
            UnknownTaskError: if there is no such task.
        """
        task = self.tasks.get(uuid)
        return task_status(task, self.jobs.get(task.job), self._supervisor.processes.get(task.job))

    def counts(self) -> tuple[int, int]:
        """Number of tasks that are queued and that are running."""
        active = [task.job for task in self.tasks.all() if task.state in ("fetching", "wanted")]
        under_way = {key for key, each in list(self._supervisor.processes.items()) if each.phase != "forecast"}
        running = sum(key in under_way for key in active)
        return len(active) - running, running

    def start_times(self) -> dict[str, float]:
        """Estimated seconds until each waiting job starts, by its key, in the order of the queue."""
        supervisor = self._supervisor
        return start_times(supervisor.waiting(), supervisor.running(), self.settings.parallel)


def _notes_on_options(task: Task) -> tuple[str, ...]:
    """Lines for the log on the options of a task that do nothing."""
    idle = idle_options(task.options)
    return (*dropped_notes(task.dropped), *([f"With fast-orthophoto there is no: {', '.join(idle)}."] if idle else []))
