"""What the page shows of the node and of its tasks, as JSON, from memory and from the names of files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.node.page.checks import Checks, Upload
from splatpipe.pipeline.app.node.page.gate import PageAccess
from splatpipe.pipeline.app.node.page.results import Results
from splatpipe.pipeline.app.node.tasks.disk import free_bytes
from splatpipe.pipeline.app.node.tasks.jobs import Job
from splatpipe.pipeline.app.node.tasks.names import CONTROL_NAMES, RAW_SUFFIXES, control_file, kind_of
from splatpipe.pipeline.app.node.tasks.node import Node
from splatpipe.pipeline.app.node.tasks.options import LISTED
from splatpipe.pipeline.app.node.tasks.record import QUEUED, RUNNING, Task
from splatpipe.pipeline.app.node.tasks.run_options import MARK_FIRST
from splatpipe.pipeline.app.node.tasks.settings import MAX_FILES
from splatpipe.pipeline.app.node.tasks.status import TaskStatus
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.runs.source import FILM_SUFFIXES, MAX_NAMED_BYTES
from splatpipe.pipeline.photos.files.names import PHOTO_SUFFIXES
from splatpipe.stages.line import LINE

MOST_TASKS = 200  # shown; the newest, and all that have not ended
DAY_MS = 86_400_000
CHECK_FOLDER = "check"
SURVEY = {
    "source.control": "control points",
    "source.geo": "positions",
    "source.scale_bars": "scale bars",
    "source.boundary": "boundary",
    "source.lens": "lens calibration",
}


@dataclass
class Listings:
    """Sizes of the files of uploads; a folder is read again only if it has changed."""

    known: dict[Path, tuple[int, dict[str, int]]] = field(default_factory=dict)

    def sizes(self, folder: Path) -> dict[str, int]:
        """Size of each whole file by name; empty if the folder is gone."""
        try:
            changed = folder.stat().st_mtime_ns
            if folder not in self.known or self.known[folder][0] != changed:
                with os.scandir(folder) as entries:
                    found = {each.name: each.stat().st_size for each in entries if not each.name.startswith(".")}
                self.known[folder] = changed, found
            return self.known[folder][1]
        except OSError:
            self.known.pop(folder, None)
            return {}


class Facts:
    """The facts of a node.

    Args:
        node: The node.
        access: The page's secrets: addresses of results have one.
        checks: Its checks.
    """

    def __init__(self, node: Node, access: PageAccess, checks: Checks) -> None:
        self._scheduler, self._checks = node.scheduler, checks
        self._tasks, self._jobs, self._settings = node.tasks, node.jobs, node.settings
        self._listings = Listings()
        self._results = Results(access, node.jobs)
        self._digests: dict[tuple[Path, int, int], str] = {}

    def state(self, version: str) -> dict[str, Any]:
        """Everything that the page shows."""
        tasks = sorted(self._tasks.all(), key=lambda task: task.created_ms, reverse=True)
        alive = [task for task in tasks if not task.has_ended]
        shown = [*alive, *[task for task in tasks if task.has_ended][: max(0, MOST_TASKS - len(alive))]]
        statuses = {task.uuid: self._scheduler.status(task.uuid) for task in shown if task.is_committed}
        places = self._places(shown, statuses)
        starts = self._scheduler.start_times()
        listed = [self.task(task, statuses.get(task.uuid), places.get(task.uuid), starts) for task in shown]
        order = {"running": 0, "marks": 1, "waiting": 2}
        listed.sort(key=lambda each: (order.get(each["state"], 0), each["place"] or 0))
        return {
            "node": self._node(version, sum(each.code == RUNNING for each in statuses.values())),
            "options": [option.as_json() for option in LISTED],
            "tasks": listed,
            "more": len(tasks) - len(shown),
        }

    def upload(self, task: Task) -> Upload:
        """What a check of a task reads."""
        folder = self._tasks.path(task.uuid) / "upload"
        sizes = self._listings.sizes(folder)
        control = control_file(sizes)
        options = {} if control is None else {"georef": {"control": str(folder / control)}}
        return Upload(folder, sizes, options)

    def check_folder(self, uuid: str) -> Path:
        """Where the check of a task is kept."""
        return self._tasks.path(uuid) / CHECK_FOLDER

    def files(self, task: Task) -> dict[str, int]:
        """Size of each whole file of a task's upload."""
        return self._listings.sizes(self._tasks.path(task.uuid) / "upload")

    def result_names(self, task: Task) -> tuple[str, ...]:
        """The files of a task's run that may be fetched."""
        return self._results.names(task) if task.has_ended else ()

    def control(self, task: Task) -> str | None:
        """Name of the control file in a task's upload."""
        names = self.files(task)
        found = next((name for name in sorted(names) if name.casefold() in CONTROL_NAMES), None)
        return found or control_file(names)

    def task(
        self, task: Task, status: TaskStatus | None, place: int | None = None, starts: Mapping[str, float] | None = None
    ) -> dict[str, Any]:
        """A task."""
        starts = starts or {}
        files, state = self.files(task), state_of(task, status)
        facts: dict[str, Any] = {
            "uuid": task.uuid,
            "name": task.name or "without a name",
            "state": state,
            "created_ms": task.created_ms,
            "photos": task.images or sum(kind_of(name) in ("photo", "film") for name in files),
            "files": len(files),
            "bytes": sum(files.values()),
            "place": place,
            "options": [{"name": name, "value": value} for name, value in task.options.items()],
            "can": self._can(task, state),
        }
        if state == "uploading":
            return facts | {"check": self._check(task)}
        assert status is not None
        facts |= {"progress": round(status.progress, 1), "stage": status.stage, "what": status.what}
        facts |= {
            "left_s": round(status.left_s),
            "why": status.waiting,
            "starts_in_s": round(starts.get(task.job, 0.0)),
        }
        facts |= {"message": self._without_paths(status.error, task.job)}
        if task.has_ended:
            facts |= {"ended_ms": task.ended_ms, "seconds": status.processing_ms / 1000.0}
            if self._settings.keep_days:
                facts["delete_ms"] = task.ended_ms + self._settings.keep_days * DAY_MS
            if task.state != "canceled":
                facts["results"] = self._results.listed(task)
        return facts

    def _check(self, task: Task) -> dict[str, Any]:
        found = self._checks.state(task.uuid, self.upload(task), self.check_folder(task.uuid))
        found.pop("key", None)
        return found | {"page": f"check/{task.uuid}/"} if found["state"] == "done" else found

    def _can(self, task: Task, state: str) -> dict[str, bool]:
        control, job = self.control(task), self._jobs.get(task.job)
        placed = job is not None and any((self._jobs.out(job.key) / "stages").glob("sparse-*"))
        ended = state in ("done", "marks", "failed")
        return {
            "restart": task.has_ended,
            "pause": control is not None,
            "mark": ended and control is not None and placed,
            "marked": ended and control is not None and job is not None and self._has_new_marks(task, control, job),
            "watch": state == "running",
        }

    def _has_new_marks(self, task: Task, control: str, job: Job) -> bool:
        """Whether the control file was changed since the run read it."""
        before = job.photos.get(control)
        digest = self._digest(self._tasks.path(task.uuid) / "upload" / control)
        return before is not None and bool(digest) and digest != before.sha256

    def _digest(self, path: Path) -> str:
        with suppress(OSError):
            facts = path.stat()
            key = path, facts.st_mtime_ns, facts.st_size
            if key not in self._digests:
                self._digests[key] = hashlib.sha256(read_small(path, MAX_NAMED_BYTES)).hexdigest()
            return self._digests[key]
        return ""

    def _places(self, tasks: Sequence[Task], statuses: Mapping[str, TaskStatus]) -> dict[str, int]:
        """Places in the queue by task; equal tasks have the same place."""
        waiting = [task for task in tasks if task.uuid in statuses and statuses[task.uuid].code == QUEUED]
        jobs = {task.job: self._jobs.get(task.job) for task in waiting}
        order = sorted((job.queued_ms, job.key) for job in jobs.values() if job is not None)
        number = {key: k for k, (_, key) in enumerate(order, 1)}
        return {task.uuid: number[task.job] for task in waiting if task.job in number}

    def _node(self, version: str, running: int) -> dict[str, Any]:
        settings = self._settings
        return {
            "version": version,
            "free_bytes": max(0, free_bytes(settings.folder) - settings.least_free_bytes),
            "parallel": settings.parallel,
            "running": running,
            "keep_days": settings.keep_days,
            "max_photos": MAX_FILES,
            "accepts": accepted(),
        }

    def _without_paths(self, text: str, job: str) -> str:
        """A message without the folders of this machine."""
        for folder in (self._jobs.photos(job), self._jobs.out(job), self._jobs.path(job), self._settings.folder):
            text = text.replace(f"{folder}/", "").replace(str(folder), "the run")
        return text


def state_of(task: Task, status: TaskStatus | None) -> str:
    """The page's word for a task's state."""
    if status is None:
        return "uploading"
    if task.state == "completed":
        return "marks" if task.options.get(MARK_FIRST) else "done"
    if task.has_ended:
        return "failed" if task.state == "failed" else "cancelled"
    return "running" if status.code == RUNNING else "waiting"


def accepted() -> dict[str, Any]:
    """What a run takes: suffixes of photos, of raw photos and of films; survey files by name, with what each is."""
    return {
        "photos": [*PHOTO_SUFFIXES],
        "raws": [suffix.lstrip(".") for suffix in RAW_SUFFIXES],
        "films": [suffix.lstrip(".") for suffix in FILM_SUFFIXES],
        "survey": _survey_names(),
    }


def _survey_names() -> dict[str, str]:
    return {
        name: SURVEY.get(file.part, file.part) for stage in LINE for file in stage.files.values() for name in file.names
    }
