"""Our page behind the cookie: its JSON, uploads, checks, the node's API as clients use it, and views of runs.

All addresses are below ``/page/SECRET/``.
"""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from anyio import to_thread
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route
from starlette.types import ASGIApp, Receive, Scope, Send

from splatpipe.pipeline.app.node.api.answers import DISK_FULL
from splatpipe.pipeline.app.node.api.bodies import drain_rest, limited
from splatpipe.pipeline.app.node.api.multipart import BLOCK_BYTES, BadBodyError
from splatpipe.pipeline.app.node.api.received import UploadedFile
from splatpipe.pipeline.app.node.api.routes import Api
from splatpipe.pipeline.app.node.page.checks import PAGE, Checks
from splatpipe.pipeline.app.node.page.facts import Facts
from splatpipe.pipeline.app.node.page.gate import PageAccess
from splatpipe.pipeline.app.node.page.view_children import ViewChildren
from splatpipe.pipeline.app.node.tasks.names import BadNameError
from splatpipe.pipeline.app.node.tasks.node import NewTask, Node
from splatpipe.pipeline.app.node.tasks.options import GivenOptions, WrongOptionsError, parse_options
from splatpipe.pipeline.app.node.tasks.record import Task
from splatpipe.pipeline.app.node.tasks.run_options import MARK_FIRST
from splatpipe.pipeline.app.node.tasks.scheduler import RefusedTaskError
from splatpipe.pipeline.app.node.tasks.store import UnknownTaskError
from splatpipe.pipeline.app.node.tasks.uploads import NameTakenError
from splatpipe.pipeline.app.serving.files import TYPES, FileAnswer, FileNotServedError, open_inside
from splatpipe.pipeline.app.serving.refusals import RefusedError
from splatpipe.pipeline.app.view.guard import CSP_OF_RUN, CSP_OURS
from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.web import asset

TEMPLATES = Path(__file__).parent / "templates"
ASSETS = {"node.css": "text/css", "node.js": "text/javascript", "entrance.js": "text/javascript"}
MAX_JSON_BYTES = 3 << 20  # options with a boundary
MAX_NAME_LETTERS = 200
HTML = {"content-security-policy": CSP_OURS, "cross-origin-opener-policy": "same-origin"}
VIEW_PAGES = ("mark", "live")
PASSED_ON = ("content-type", "if-none-match", "accept")


class OurPages:
    """Our page.

    Args:
        node: The node.
        access: The page's secrets.
        checks: Checks of uploads.
        views: Processes that show runs.
        facts: What the page shows.
    """

    def __init__(self, node: Node, access: PageAccess, checks: Checks, views: ViewChildren, facts: Facts) -> None:
        self._node, self._scheduler = node, node.scheduler
        self._tasks, self._jobs = node.tasks, node.jobs
        self._access, self._checks, self._views, self._facts = access, checks, views, facts
        self._version = version("splatpipe")

    def app(self) -> ASGIApp:
        """The application behind its gate."""
        routes: list[BaseRoute] = [
            Route("/", self._page),
            Route("/assets/{name}", asset_answer),
            Route("/api/state", self._state),
            Route("/api/new", self._new, methods=["POST"]),
            Route("/api/files/{uuid}", self._files),
            Route("/api/upload/{uuid}", self._upload, methods=["POST"]),
            Route("/api/check/{uuid}", self._check, methods=["POST"]),
            Route("/api/start/{uuid}", self._start, methods=["POST"]),
            Route("/api/again/{uuid}", self._again, methods=["POST"]),
            Route("/check/{uuid}/", self._check_page),
            Route("/view/{uuid}/{path:path}", self._view, methods=["GET", "POST"]),
            Route("/api/remove/{uuid}", self._remove, methods=["POST"]),
            Mount("/", routes=Api(self._node).routes()),
        ]
        refusals: dict[Any, int] = {UnknownTaskError: 404, RefusedTaskError: 409, NameTakenError: 409}
        refusals |= {WrongOptionsError: 422, BadNameError: 422, BadBodyError: 400}

        async def refused(request: Request, error: Exception) -> Response:
            await drain_rest(request)  # otherwise a browser that still sends does not read the answer
            if isinstance(error, HTTPException):
                return said(error.status_code, str(error.detail))
            if isinstance(error, MachineError):
                return said(503, f"{error.message} {error.hint}".strip())
            if isinstance(error, OSError):
                return said(507, DISK_FULL)
            return said(next(refusals[kind] for kind in refusals if isinstance(error, kind)), _words(error))

        handled = (*refusals, MachineError, OSError, HTTPException)
        return _Gate(self._access, Starlette(routes=routes, exception_handlers=dict.fromkeys(handled, refused)))

    def _page(self, _request: Request) -> Response:
        return HTMLResponse((TEMPLATES / "node.html").read_text(encoding="utf-8"), headers=HTML)

    def _state(self, _request: Request) -> Response:
        return JSONResponse(self._facts.state(self._version))

    async def _new(self, request: Request) -> Response:
        task = await to_thread.run_sync(self._node.create, NewTask(_name(await json_of(request))))
        return JSONResponse({"uuid": task.uuid})

    def _files(self, request: Request) -> Response:
        return JSONResponse({"files": self._facts.files(self._uploading(request))})

    async def _upload(self, request: Request) -> Response:
        """Receive one file, whose name is in the query; it gets that name once it is whole."""
        uuid, name = self._uploading(request).uuid, request.query_params.get("name", "")
        length = request.headers.get("content-length", "")
        if not (length.isascii() and length.isdigit()):
            raise HTTPException(411, "Content-Length is required.")
        await to_thread.run_sync(self._node.reserve, int(length))
        file = await to_thread.run_sync(UploadedFile.begin, self._node, uuid, name, {})
        block = bytearray()
        try:
            async for chunk in limited(request, self._node.limit_of(name)):
                block += chunk
                if len(block) >= BLOCK_BYTES:
                    full, block = bytes(block), bytearray()
                    await to_thread.run_sync(file.write, full)
            await to_thread.run_sync(file.write, bytes(block))
        except BaseException:
            file.discard()
            raise
        await to_thread.run_sync(file.finish)
        return JSONResponse({"success": True})

    async def _remove(self, request: Request) -> Response:
        task = self._tasks.get(request.path_params["uuid"])

        def remove() -> None:
            self._checks.stop(task.uuid)
            self._views.stop(task.uuid)
            self._scheduler.remove(task.uuid)

        await to_thread.run_sync(remove)
        return JSONResponse({"success": True})

    async def _check(self, request: Request) -> Response:
        task = self._uploading(request)
        self._checks.ask(task.uuid, self._facts.upload(task), self._facts.check_folder(task.uuid))
        return JSONResponse({"success": True})

    async def _start(self, request: Request) -> Response:
        task, body = self._uploading(request), await json_of(request)
        given = await to_thread.run_sync(_options, body)
        values = {**given.values, **({MARK_FIRST: True} if body.get("pause") is True else {})}
        wanted = NewTask(_name(body), GivenOptions(values, given.dropped), created_ms=task.created_ms)

        def commit() -> None:
            self._checks.stop(task.uuid)
            self._node.amend(task.uuid, wanted)
            self._node.commit(task.uuid)

        await to_thread.run_sync(commit)
        return JSONResponse({"success": True})

    async def _again(self, request: Request) -> Response:
        task, body = self._tasks.get(request.path_params["uuid"]), await json_of(request)
        given = None if body.get("options") is None else await to_thread.run_sync(_options, body)
        values = dict(task.options if given is None else given.values)
        values.pop(MARK_FIRST, None)
        values |= {MARK_FIRST: True} if body.get("pause") is True else {}

        def restart() -> None:
            self._views.stop(task.uuid)
            control = self._facts.control(task)
            if control is not None:  # the page for marking has changed it where it lies
                self._tasks.uploads(task.uuid).forget(control)
            self._node.restart(task.uuid, GivenOptions(values, task.dropped))

        await to_thread.run_sync(restart)
        return JSONResponse({"success": True})

    def _uploading(self, request: Request) -> Task:
        task = self._tasks.get(request.path_params["uuid"])
        if task.is_committed:
            raise RefusedTaskError("This job has been started already.")
        return task

    # Pages of others: checks, views, results.

    def _check_page(self, request: Request) -> Response:
        task = self._tasks.get(request.path_params["uuid"])
        headers = {"content-security-policy": CSP_OF_RUN}
        try:
            file = open_inside(self._facts.check_folder(task.uuid), PAGE)
        except FileNotServedError as error:
            raise HTTPException(404, "There is no check of this job.") from error
        return FileAnswer(file, TYPES[".html"], headers)

    async def _view(self, request: Request) -> Response:
        task, path = self._tasks.get(request.path_params["uuid"]), request.path_params["path"]
        if path == "run":  # the pages' way back
            return RedirectResponse(self._access.address, 303)
        if path in VIEW_PAGES:
            self._open_view(task)
        return await self.from_view(task, request, path, HTML if path in VIEW_PAGES else {})

    async def from_view(self, task: Task, request: Request, path: str, own: dict[str, str]) -> Response:
        """What the process that shows a task answers.

        Raises:
            MachineError: if it has ended.
        """
        query = request.url.query
        headers = {name: value for name in PASSED_ON if (value := request.headers.get(name)) is not None}
        target, body = f"/{path}{'?' if query else ''}{query}", await _whole_body(request)
        found = await to_thread.run_sync(self._views.ask, task.uuid, request.method, target, headers, body)
        return StreamingResponse(found.body, found.status, dict(found.headers) | own)

    def _open_view(self, task: Task) -> None:
        what = {"out": str(self._jobs.out(task.job)), "name": task.name, "files": self._access.results(task.uuid)}
        control = self._facts.control(task)
        if control is not None and task.has_ended:
            shown = f"{control} of this job ({task.uuid[:8]})"
            what |= {"upload": str(self._tasks.uploads(task.uuid).path), "shown": shown}
        self._views.start(task.uuid, what, self._jobs.path(task.job) / "view.log")


class _Gate:
    """Passes only requests of our own page, in a browser that has the cookie."""

    def __init__(self, access: PageAccess, app: ASGIApp) -> None:
        self._access, self._app = access, app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope, receive)
        try:
            self._access.require_ours(request.headers, scope["path_params"]["pages"])
        except RefusedError as error:
            await drain_rest(request)
            await said(error.status, str(error))(scope, receive, send)
            return
        await self._app(scope, receive, send)


def asset_answer(request: Request) -> Response:
    """A script or style."""
    name = request.path_params["name"]
    if name not in ASSETS:
        raise HTTPException(404)
    return Response(asset(name), media_type=ASSETS[name])


def said(status: int, text: str) -> Response:
    """An answer that says no."""
    return JSONResponse({"error": text}, status)


async def _whole_body(request: Request, max_bytes: int = MAX_JSON_BYTES) -> bytes:
    return b"".join([chunk async for chunk in limited(request, max_bytes)])


async def json_of(request: Request, max_bytes: int = MAX_JSON_BYTES) -> dict[str, Any]:
    """The JSON object in a request's body.

    Args:
        request: The request.
        max_bytes: The most that its body may have.

    Raises:
        HTTPException: if it is none.
        BadBodyError: if it is too large.
    """
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise HTTPException(415, "The request must be JSON.")
    try:
        found = json.loads(await _whole_body(request, max_bytes))
    except (ValueError, RecursionError) as error:
        raise HTTPException(400, "The request must be JSON.") from error
    if not isinstance(found, dict):
        raise HTTPException(400, "The request must be a JSON object.")
    return found


def _name(body: dict[str, Any]) -> str:
    name = body.get("name")
    if not isinstance(name, str):
        raise HTTPException(400, "The request must have a name.")
    return "".join(letter if letter.isprintable() else " " for letter in name).strip()[:MAX_NAME_LETTERS]


def _words(error: Exception) -> str:
    return "This job is not there any more." if isinstance(error, UnknownTaskError) else str(error)


def _options(body: dict[str, Any]) -> GivenOptions:
    return parse_options(json.dumps(body.get("options") or []))
