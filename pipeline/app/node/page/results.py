"""The results of a task, as the page lists them and as they are served."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

from splatpipe.pipeline.app.node.page.gate import PageAccess
from splatpipe.pipeline.app.node.tasks.jobs import JobStore
from splatpipe.pipeline.app.node.tasks.record import Task
from splatpipe.pipeline.app.report import PDF_FILE, REPORT_FILE
from splatpipe.pipeline.app.view.landing import BROWSER_SUFFIXES, VIEWER, WHAT, downloadable_files
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.run_folder import RunFolder, open_run_folder
from splatpipe.pipeline.web.measured_page import SITE_PAGE
from splatpipe.stages.line import LINE

ALL, PDF = "all.zip", ".pdf"
MAIN = {REPORT_FILE: "Report", VIEWER: "3D viewer", PDF_FILE: "Report as PDF"}
MOST_KNOWN = 500  # runs whose files are remembered


class Results:
    """The files of runs, read once for each end of a run.

    Args:
        access: The page's secrets.
        jobs: The jobs.
    """

    def __init__(self, access: PageAccess, jobs: JobStore) -> None:
        self._access, self._jobs = access, jobs
        self._known: dict[tuple[str, int], tuple[str, ...]] = {}

    def run_of(self, task: Task) -> RunFolder | None:
        """The run of a task; None if there is none yet."""
        try:
            return open_run_folder(self._jobs.out(task.job), LINE) if task.job else None
        except SplatpipeError:
            return None

    def names(self, task: Task) -> tuple[str, ...]:
        """The files of a task's run that may be fetched, relative to its OUT."""
        key = task.job, task.ended_ms
        if key not in self._known:
            run = self.run_of(task)
            while len(self._known) >= MOST_KNOWN:
                del self._known[next(iter(self._known))]
            self._known[key] = () if run is None else downloadable_files(run)
        return self._known[key]

    def listed(self, task: Task) -> list[dict[str, Any]]:
        """The results of a task that has ended, those that people open first in front."""
        folder, out, names = self._access.results(task.uuid), self._jobs.out(task.job), self.names(task)
        found = []
        for name in sorted(names, key=lambda each: list(MAIN).index(each) if each in MAIN else len(MAIN)):
            if "/" in name and name != SITE_PAGE:  # tiles and the like are thousands; all.zip has them
                continue
            try:
                size = (out / name).lstat().st_size
            except OSError:
                continue
            suffix = PurePosixPath(name).suffix
            inside = suffix in BROWSER_SUFFIXES and suffix != PDF  # browsers show none in a sandbox
            entry = {
                "title": name,
                "text": WHAT.get(name, ""),
                "href": f"/{folder}/{name}",
                "bytes": size,
                "inside": inside,
            }
            found += [entry | {"title": MAIN[name], "main": True}] if name in MAIN else []
            found.append(entry)
        packed = self._jobs.assets(task.job) / ALL
        if task.state == "completed" and packed.is_file():
            address = f"task/{task.uuid}/download/{ALL}"
            whole = {"title": f"All files ({ALL})", "text": "", "href": address, "bytes": packed.stat().st_size}
            found.append(whole | {"inside": False, "main": True})
        return found
