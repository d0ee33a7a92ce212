"""A node: its tasks, jobs and scheduler, and what clients may ask of them. No HTTP here."""

from __future__ import annotations

import re
import threading
import uuid as uuids
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.node.tasks.disk import free_bytes
from splatpipe.pipeline.app.node.tasks.jobs import JobStore
from splatpipe.pipeline.app.node.tasks.log import log_lines
from splatpipe.pipeline.app.node.tasks.names import kind_of, plain_name
from splatpipe.pipeline.app.node.tasks.options import NO_OPTIONS, GivenOptions
from splatpipe.pipeline.app.node.tasks.outgoing import (
    WEBHOOK_DELAY_S,
    WEBHOOK_TRIES,
    AllowedHosts,
    OutgoingError,
    fetch,
    post_json,
)
from splatpipe.pipeline.app.node.tasks.record import Task
from splatpipe.pipeline.app.node.tasks.scheduler import RefusedTaskError, Scheduler
from splatpipe.pipeline.app.node.tasks.settings import (
    DAY_S,
    GIVEN_UP_S,
    MAX_FILES,
    MAX_FILM_BYTES,
    MAX_PHOTO_BYTES,
    MAX_SURVEY_BYTES,
    MAX_TASK_BYTES,
    MAX_TASKS,
    MAX_UPLOADING,
    SPARE_BYTES,
    Settings,
)
from splatpipe.pipeline.app.node.tasks.store import TaskStore, UnknownTaskError, now_ms
from splatpipe.pipeline.app.node.tasks.uploads import NameTakenError, PartFile
from splatpipe.pipeline.app.node.tasks.zip_upload import BadZipError, unpack
from splatpipe.pipeline.engine.files.output_file import new_file

UUID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}", re.IGNORECASE)
MAX_NAME_LETTERS = 255
UNFIT = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")  # of names: what cannot be stored, or steers a terminal
HOUSEKEEPING_S = 30.0
MAX_NOTED = 50  # files that were left out are named in the log
NOT_USED = "{} was not used: it is neither a photo nor a survey file."
FETCH_TRIES = 5
FETCH_DELAY_S = 30.0


@dataclass(frozen=True)
class NewTask:
    """What a client asks for.

    Attributes:
        name: The task's name.
        options: Its options.
        webhook: Address to tell the end to; empty for none.
        zip_url: Address of a zip with the photos; empty if they are uploaded.
        outputs: Paths that make up all.zip; empty for the usual ones.
        created_ms: When the client says it was created; 0 for now.
        uuid: The UUID that the client wants; empty for any.
    """

    name: str = ""
    options: GivenOptions = NO_OPTIONS
    webhook: str = ""
    zip_url: str = ""
    outputs: tuple[str, ...] = ()
    created_ms: int = 0
    uuid: str = ""


class Node:
    """A node.

    Args:
        settings: Its settings.
        allow_hosts: Hosts that zips are fetched from and ends are reported to.
        tell: Receives lines for the node's user.

    Raises:
        UsageError: if a host is none.
        OSError: if the folder cannot be used.
    """

    def __init__(
        self, settings: Settings, allow_hosts: Collection[str] = (), tell: Callable[[str], None] = lambda _line: None
    ) -> None:
        self.settings = settings
        self.tasks, self.jobs = TaskStore(settings.folder, tell), JobStore(settings.folder, tell)
        self.scheduler = Scheduler(self.tasks, self.jobs, settings, tell)
        self._hosts = AllowedHosts(allow_hosts)
        self._tell = tell
        self._stopping = threading.Event()
        self._busy: set[str] = set()  # tasks whose zip is being fetched, or whose webhook is being told
        self._housekeeper = threading.Thread(target=self._keep_house, name="housekeeper", daemon=True)

    def start(self) -> None:
        """Begin to run what is wanted."""
        self.scheduler.start()
        self._housekeeper.start()

    def stop(self) -> None:
        """End everything; it goes on when the node is started again."""
        self._stopping.set()
        self.scheduler.stop()
        if self._housekeeper.is_alive():
            self._housekeeper.join(5.0)

    def create(self, wanted: NewTask) -> Task:
        """Begin a task.

        Raises:
            RefusedTaskError: if it cannot be done, or not now; said before anything is uploaded.
            OutgoingError: if an address may not be contacted.
            OSError: if the disk is full.
        """
        self._check_hosts(wanted)
        uuid = wanted.uuid.lower()
        if uuid and UUID.fullmatch(uuid) is None:
            raise RefusedTaskError(f"Invalid set-uuid: {wanted.uuid[:60]}")
        self.require_room()
        tasks = self.tasks.all()
        if len(tasks) >= MAX_TASKS or sum(not task.is_committed for task in tasks) >= MAX_UPLOADING:
            raise RefusedTaskError("This node keeps as many tasks as it can: remove some, or wait.")
        task = _with(Task(uuid or str(uuids.uuid4()), "", now_ms()), wanted)
        if self.tasks.create(task):
            return task
        if self.tasks.get(task.uuid).is_committed:
            raise RefusedTaskError(f"Invalid set-uuid: {task.uuid}")
        return self.amend(task.uuid, wanted)  # its client begins again, after an error in between

    def amend(self, uuid: str, wanted: NewTask) -> Task:
        """State what is wanted of a task that is being uploaded.

        Raises:
            UnknownTaskError: if there is no such task.
            OutgoingError: if an address may not be contacted.
            OSError: if the disk is full.
        """
        self._check_hosts(wanted)
        return self.tasks.replace(_with(self.tasks.get(uuid), wanted))

    def give_up(self, uuid: str) -> None:
        """Remove a task whose upload failed; one that is committed stays.

        Raises:
            UnknownTaskError: if there is no such task.
            OSError: if its folder cannot be moved.
        """
        if not self.tasks.get(uuid).is_committed:
            self.scheduler.remove(uuid)

    def _check_hosts(self, wanted: NewTask) -> None:
        for url in filter(None, (wanted.webhook, wanted.zip_url)):
            self._hosts.check(url)

    def require_room(self) -> None:
        """Check that there is disk for another task.

        Raises:
            RefusedTaskError: if there is not.
        """
        free = free_bytes(self.settings.folder)
        if free < self.settings.least_free_bytes:
            raise RefusedTaskError(
                f"The node's disk is nearly full ({free / 1e9:.1f} GB free): nothing can be uploaded until its owner "
                "makes room, or old tasks are removed."
            )

    def committed(self, uuid: str) -> Task:
        """A task that is committed: before, clients know it only as an upload.

        Raises:
            UnknownTaskError: if there is none.
        """
        task = self.tasks.get(uuid)
        if not task.is_committed:
            raise UnknownTaskError(uuid)
        return task

    def begin_file(self, uuid: str, given_name: str) -> PartFile | None:
        """Begin to receive a file of a task; None if a run has no use for it, so that it is not kept.

        Args:
            uuid: The task.
            given_name: Its name as the client states it.

        Raises:
            UnknownTaskError: if there is no such task.
            BadNameError: if its name is refused.
            RefusedTaskError: if the task has too many files, or the disk too little room.
            OSError: if the disk is full.
        """
        name = plain_name(given_name)
        task = self.tasks.get(uuid)
        upload = self.tasks.uploads(uuid)
        if kind_of(name) == "other":
            if not task.is_committed:
                self.tasks.note(uuid, NOT_USED.format(name), MAX_NOTED)
            return None
        if upload.count() >= MAX_FILES:
            raise RefusedTaskError(f"A task has at most {MAX_FILES:,} files.")
        if upload.size() >= MAX_TASK_BYTES:
            raise RefusedTaskError(f"A task has at most {MAX_TASK_BYTES / 1e9:,.0f} GB.")
        self.reserve(0)
        self.tasks.keep_open(uuid)
        return upload.begin(name)

    def limit_of(self, name: str) -> int:
        """The most bytes that a file of a name may have."""
        return {"photo": MAX_PHOTO_BYTES, "film": MAX_FILM_BYTES}.get(kind_of(name), MAX_SURVEY_BYTES)

    def reserve(self, size: int) -> None:
        """Check that the disk has room for bytes that are about to be written, and some to spare.

        Raises:
            OSError: if not.
        """
        if free_bytes(self.settings.folder) - size < SPARE_BYTES:
            raise OSError(28, "No space left on device")

    def commit(self, uuid: str) -> Task:
        """Close a task's upload; one whose photos are fetched is queued when they are there.

        Raises:
            UnknownTaskError: if there is no such task.
            RefusedTaskError: if it has no photos.
            OSError: if the disk is full.
        """
        task = self.tasks.get(uuid)
        if task.zip_url and task.state == "uploading":
            task = self.tasks.change(uuid, state="fetching")
            self._fetch_soon(task)
            return task
        return task if task.state == "fetching" else self.scheduler.commit(uuid)

    def lines(self, task: Task, line: int = 0) -> list[str]:
        """The lines of a task's log from one on; a negative number counts from the end."""
        if not task.job:
            return list(task.notes)[line:]
        plain = self.jobs.labels(task.job).plain
        return [plain(each) for each in log_lines(task.notes, self.jobs.output(task.job))[line:]]

    def restart(self, uuid: str, options: GivenOptions | None) -> Task:
        """Run an ended task again, with other options if some are given; valid results are reused.

        Raises:
            UnknownTaskError: if there is no such task.
            RefusedTaskError: if it has not ended, or the disk is nearly full.
            OSError: if the disk is full.
        """
        self.require_room()
        return self.scheduler.restart(uuid, options)

    def results(self, uuid: str) -> Path | None:
        """The folder of what clients download of a task; None if it has not completed.

        Raises:
            UnknownTaskError: if there is no such task.
        """
        task = self.committed(uuid)
        return self.jobs.assets(task.job) if task.state == "completed" else None

    def info(self, task: Task) -> dict[str, Any]:
        """What ``/task/UUID/info`` answers."""
        status = self.scheduler.status(task.uuid)
        code: dict[str, Any] = {"code": status.code}
        if status.error:
            code["errorMessage"] = status.error
        return {
            "uuid": task.uuid,
            "name": task.name,
            "dateCreated": task.created_ms,
            "processingTime": status.processing_ms,
            "status": code,
            "options": [{"name": name, "value": value} for name, value in task.options.items()],
            "imagesCount": task.images,
            "progress": round(status.progress, 1),
        }

    def _keep_house(self) -> None:
        while True:
            for work in (self.tasks.empty_trash, self.remove_old, self.scheduler.remove_unused, self._resume):
                with suppress(OSError):
                    work()
            if self._stopping.wait(HOUSEKEEPING_S):
                return

    def remove_old(self) -> None:
        """Remove ended tasks whose time is over, and uploads that were given up."""
        now, keep_ms = now_ms(), 1000 * DAY_S * self.settings.keep_days
        for task in self.tasks.all():
            old = task.has_ended and 0 < keep_ms < now - task.ended_ms
            given_up = task.state == "uploading" and now - task.touched_ms > 1000 * GIVEN_UP_S
            if old or given_up:
                with suppress(UnknownTaskError):
                    self.scheduler.remove(task.uuid)

    def _resume(self) -> None:
        for task in self.tasks.all():
            if task.state == "fetching":
                self._fetch_soon(task)
            if task.has_ended and task.webhook and not task.told:
                self._start_once(task.uuid, self._tell_end)

    def _fetch_soon(self, task: Task) -> None:
        self._start_once(task.uuid, self._fetch)

    def _start_once(self, uuid: str, work: Callable[[str], None]) -> None:
        if uuid in self._busy:
            return
        self._busy.add(uuid)

        def run() -> None:
            try:
                with suppress(UnknownTaskError):
                    work(uuid)
            finally:
                self._busy.discard(uuid)

        threading.Thread(target=run, daemon=True).start()

    def _fetch(self, uuid: str) -> None:
        """Load a task's zip and unpack it; a host that does not answer is tried again."""
        task, error = self.tasks.get(uuid), ""
        place = self.tasks.path(uuid) / "fetched.zip"
        for attempt in range(FETCH_TRIES):
            try:
                parts = self._hosts.check(task.zip_url)
                with new_file(place) as file:

                    def write(block: bytes, into: Any = file) -> None:
                        if self.tasks.get(uuid).state != "fetching":  # it was cancelled
                            raise UnknownTaskError(uuid)
                        self.reserve(len(block))
                        into.write(block)

                    fetch(parts, write, MAX_TASK_BYTES)
                left_out = unpack(place, self.tasks.uploads(uuid), self.limit_of, self.reserve)
                notes = tuple(NOT_USED.format(name) for name in left_out[:MAX_NOTED])
                for line in notes:
                    self.tasks.note(uuid, line, MAX_NOTED)
                self.scheduler.commit(uuid)
                return
            except (OutgoingError, BadZipError, RefusedTaskError, NameTakenError) as trouble:
                error = str(trouble)
                break
            except OSError as trouble:
                error = f"The zip could not be loaded: {trouble.strerror or trouble}."
                if self._stopping.wait(FETCH_DELAY_S * (attempt + 1)):
                    return
            finally:
                place.unlink(missing_ok=True)
        if self.tasks.get(uuid).state == "fetching":
            self.tasks.change(uuid, later=True, state="failed", error=error, ended_ms=now_ms())

    def _tell_end(self, uuid: str) -> None:
        """Report the end of a task to its webhook, some times until it is taken."""
        for attempt in range(1, WEBHOOK_TRIES + 1):
            task = self.tasks.get(uuid)
            if not task.has_ended or task.told:
                return
            with suppress(OutgoingError):
                images = sorted(name for name in self.tasks.uploads(uuid).names() if kind_of(name) in ("photo", "film"))
                if post_json(self._hosts.check(task.webhook), {**self.info(task), "images": images}):
                    break
            if self._stopping.wait(WEBHOOK_DELAY_S * attempt):
                return
        self.tasks.change(uuid, later=True, told=True)


def _with(task: Task, wanted: NewTask) -> Task:
    """A task with what a client asks for."""
    return replace(
        task,
        name=UNFIT.sub("?", wanted.name[:MAX_NAME_LETTERS]),
        created_ms=wanted.created_ms or task.created_ms,
        options=dict(wanted.options.values),
        dropped=wanted.options.dropped,
        outputs=wanted.outputs,
        webhook=wanted.webhook,
        zip_url=wanted.zip_url,
        touched_ms=now_ms(),
    )
