"""A process that shows one run's training and marks its control points, for the node to pass requests on to.

    python -m splatpipe.pipeline.app.node.page.view_process SOCKET RUN

These are the pages of ``splatpipe view``; they load what would make the node large (the model, PyTorch), and a fault in
them does not end it. The socket lies in a folder that only this user can open, and the node has checked each request.
RUN is JSON: ``out``, ``name``, ``files`` (address of the run's files), and for marking ``upload``, the folder of the
task's own files: marks are written to the control file there, since other tasks may share the run and its photos.
"""

from __future__ import annotations

import json
import socket
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Receive, Scope, Send

from splatpipe.pipeline.app.view.access import Access
from splatpipe.pipeline.app.view.live import Live
from splatpipe.pipeline.app.view.marking.mark_routes import MarkPages
from splatpipe.pipeline.app.view.marking.marking import Marking
from splatpipe.pipeline.app.view.marking.marking_job import MarkingJob, open_job
from splatpipe.pipeline.app.view.run_pages import Pages
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.runs.run_folder import RunFolder, open_run_folder
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.files.names import NameFinder
from splatpipe.pipeline.survey.files.control_edit import ControlText
from splatpipe.stages.line import LINE

BACKLOG = 16


class NodeMarking(Marking):
    """A marking session whose page is told no path of this machine, and to go back to the node's page at the end."""

    def __init__(self, job: MarkingJob, shown: str) -> None:
        super().__init__(job)
        self._shown = shown

    def overview(self) -> dict[str, JSON]:
        """All points and the estimates from the marks."""
        return {**super().overview(), "file": self._shown, "command": ""}


@dataclass(frozen=True)
class NodeRun(RunFolder):
    """A run that is called as its task is.

    Attributes:
        title: The task's name.
    """

    title: str = ""

    @property
    def name(self) -> str:
        """The run's display name."""
        return self.title


def main() -> None:
    """Serve the run on the command line until the process is ended."""
    address, given = sys.argv[1], json.loads(sys.argv[2])
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        app = make_app(given)
    except SplatpipeError as error:
        app = _refusing(error, given)
    listening.bind(address)
    listening.listen(BACKLOG)
    config = uvicorn.Config(app, http="h11", ws="none", lifespan="off", log_level="error", access_log=False)
    uvicorn.Server(config).run(sockets=[listening])


def make_app(given: dict[str, Any]) -> ASGIApp:
    """The application for a run, as described above.

    Raises:
        SplatpipeError: if there is no such run, or it cannot be marked.
    """
    found = open_run_folder(Path(given["out"]), LINE)
    run = NodeRun(found.out, found.stages, given["name"])
    pages = Pages(run, Live(run), Access(files=given["files"]))
    ours: list[BaseRoute] = [*pages.routes(), *pages.files()[:2]]
    if "upload" in given:
        marking = NodeMarking(_job(run, Path(given["upload"])), given["shown"])
        ours = [*MarkPages(marking, pages).routes(), *ours]
    handlers: dict[Any, Any] = {
        SplatpipeError: lambda _request, error: _failed(error, given),
        HTTPException: _refused,
    }
    return _WithBody(Starlette(routes=ours, exception_handlers=handlers))


def _job(run: RunFolder, upload: Path) -> MarkingJob:
    job = open_job(run, None)
    own = upload / job.text.path.name
    if not own.is_file():
        raise UsageError(
            "The control points are not in a file of the upload.",
            hint="Upload them as gcp_list.txt or control.csv.",
        )
    return replace(job, text=ControlText.read(own, NameFinder(sorted(job.photos))))


class _WithBody:
    """Reads a request's body, as the guard of ``splatpipe view`` does; the node has limited it."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            scope["splatpipe.body"] = await Request(scope, receive).body()
            await self._app(scope, receive, send)


def _refusing(error: SplatpipeError, given: dict[str, Any]) -> ASGIApp:
    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        await _failed(error, given)(scope, receive, send)

    return answer


def _failed(error: SplatpipeError, given: dict[str, Any]) -> Response:
    return JSONResponse(
        {"message": _without_paths(error.message, given), "hint": _without_paths(error.hint, given)}, 500
    )


def _without_paths(text: str, given: dict[str, Any]) -> str:
    for path in (given.get("upload", given["out"]), given["out"]):
        text = text.replace(f"{path}/", "").replace(path, given["name"])
    return text


def _refused(_request: Request, error: HTTPException) -> Response:
    return PlainTextResponse(f"{error.detail}\n", error.status_code)


if __name__ == "__main__":
    main()
