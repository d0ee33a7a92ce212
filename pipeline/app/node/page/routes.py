"""The addresses of the page: entrance, our pages and their JSON behind a cookie, and the files of runs in a sandbox.

/                              the entrance: asks for the token, or takes the key of the printed address
/page/enter, /page/assets/…    what it needs
/page/SECRET/                  the page; below it its JSON, the node's API as clients use it, check pages, views
/results/UUID/MAC/…            files of a run
"""

from __future__ import annotations

import json
import threading
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Any

import jinja2
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
from splatpipe.pipeline.app.node.page.gate import OURS, RESULTS, PageAccess
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
from splatpipe.pipeline.app.view.guard import CSP_OF_RUN, CSP_OF_SITE, CSP_OURS, ENTRANCE, OF_RUN
from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.web import asset
from splatpipe.pipeline.web.measured_page import SITE

TEMPLATES = Path(__file__).parent / "templates"
ASSETS = {"node.css": "text/css", "node.js": "text/javascript", "entrance.js": "text/javascript"}
MAX_JSON_BYTES = 3 << 20  # options with a boundary
MAX_TOKEN_LETTERS = 512
MAX_NAME_LETTERS = 200
LOOK_S = 0.3
HTML = {"content-security-policy": CSP_OURS, "cross-origin-opener-policy": "same-origin"}
VIEW_PAGES, LIVE = ("mark", "live"), "live/"
PASSED_ON = ("content-type", "if-none-match", "accept")


class Page:
    """The page of a node.

    Args:
        node: The node.
        access: The page's secrets.
    """

    def __init__(self, node: Node, access: PageAccess) -> None:
        self._node, self._scheduler = node, node.scheduler
        self._tasks, self._jobs = node.tasks, node.jobs
        self._access = access
        self.checks, self.views = Checks(node.settings.threads), ViewChildren()
        self._facts = Facts(node, access, self.checks)
        self._templates = jinja2.Environment(loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True)
        self._version = version("splatpipe")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._look_after, name="page", daemon=True)

    def routes(self) -> list[BaseRoute]:
        """The routes."""
        return [
            Route("/", self._entrance),
            Route(f"/{OURS}/enter", self._enter, methods=["POST"]),
            Route(f"/{OURS}/assets/{{name}}", self._asset),
            Mount(f"/{OURS}/{{pages}}", app=_Ours(self._access, self._our_app())),
            Route(f"/{RESULTS}/{{uuid}}/{{mac}}/{{path:path}}", self._result),
        ]

    def start(self) -> None:
        """Begin to look after processes."""
        self._thread.start()

    def close(self) -> None:
        """End all processes."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self.checks.close()
        self.views.close()

    def _look_after(self) -> None:
        while not self._closing.wait(LOOK_S):
            self.checks.advance()
            self.views.advance()

    def _our_app(self) -> ASGIApp:
        routes: list[BaseRoute] = [
            Route("/", self._page),
            Route("/assets/{name}", self._asset),
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
                return _said(error.status_code, str(error.detail))
            if isinstance(error, MachineError):
                return _said(503, f"{error.message} {error.hint}".strip())
            if isinstance(error, OSError):
                return _said(507, DISK_FULL)
            return _said(next(refusals[kind] for kind in refusals if isinstance(error, kind)), _words(error))

        handled = (*refusals, MachineError, OSError, HTTPException)
        return Starlette(routes=routes, exception_handlers=dict.fromkeys(handled, refused))

    # The entrance.

    def _entrance(self, request: Request) -> Response:
        if request.query_params and self._access.keys.opens(
            request.scope["query_string"], request.scope["client"], request.scope["server"]
        ):
            headers = {"set-cookie": self._access.set_cookie(encrypted=_encrypted(request))}
            return HTMLResponse(ENTRANCE.format(to=self._access.address), headers=HTML | headers)
        text = self._templates.get_template("entrance.html.j2").render(asks=bool(self._access.token))
        return HTMLResponse(text, headers=HTML)

    async def _enter(self, request: Request) -> Response:
        body = await _json(request)
        token = body.get("token")
        if not isinstance(token, str) or len(token) > MAX_TOKEN_LETTERS or not self._access.takes(token):
            return _said(403, "This is not the token of this node.")
        headers = {"set-cookie": self._access.set_cookie(encrypted=_encrypted(request))}
        return JSONResponse({"to": self._access.address}, headers=headers)

    def _asset(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ASSETS:
            raise HTTPException(404)
        return Response(asset(name), media_type=ASSETS[name])

    # Our page and its JSON.

    def _page(self, _request: Request) -> Response:
        return HTMLResponse((TEMPLATES / "node.html").read_text(encoding="utf-8"), headers=HTML)

    def _state(self, _request: Request) -> Response:
        return JSONResponse(self._facts.state(self._version))

    async def _new(self, request: Request) -> Response:
        task = await to_thread.run_sync(self._node.create, NewTask(_name(await _json(request))))
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
        file = await to_thread.run_sync(UploadedFile.begin, self._node, uuid, True, name, {})
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
            self.checks.stop(task.uuid)
            self.views.stop(task.uuid)
            self._scheduler.remove(task.uuid)

        await to_thread.run_sync(remove)
        return JSONResponse({"success": True})

    async def _check(self, request: Request) -> Response:
        task = self._uploading(request)
        self.checks.ask(task.uuid, self._facts.upload(task), self._facts.check_folder(task.uuid))
        return JSONResponse({"success": True})

    async def _start(self, request: Request) -> Response:
        task, body = self._uploading(request), await _json(request)
        given = _options(body)
        values = {**given.values, **({MARK_FIRST: True} if body.get("pause") is True else {})}
        wanted = NewTask(_name(body), GivenOptions(values, given.dropped), created_ms=task.created_ms)

        def commit() -> None:
            self.checks.stop(task.uuid)
            self._node.amend(task.uuid, wanted)
            self._node.commit(task.uuid)

        await to_thread.run_sync(commit)
        return JSONResponse({"success": True})

    async def _again(self, request: Request) -> Response:
        task, body = self._tasks.get(request.path_params["uuid"]), await _json(request)
        values = dict(task.options) if body.get("options") is None else dict(_options(body).values)
        values.pop(MARK_FIRST, None)
        values |= {MARK_FIRST: True} if body.get("pause") is True else {}

        def restart() -> None:
            self.views.stop(task.uuid)
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
        return await self._from_view(task, request, path, HTML if path in VIEW_PAGES else {})

    async def _from_view(self, task: Task, request: Request, path: str, own: dict[str, str]) -> Response:
        query = request.url.query
        headers = {name: value for name in PASSED_ON if (value := request.headers.get(name)) is not None}
        target, body = f"/{path}{'?' if query else ''}{query}", await _limited(request)
        found = await to_thread.run_sync(self.views.ask, task.uuid, request.method, target, headers, body)
        return StreamingResponse(found.body, found.status, dict(found.headers) | own)

    def _open_view(self, task: Task) -> None:
        what = {"out": str(self._jobs.out(task.job)), "name": task.name, "files": self._access.results(task.uuid)}
        control = self._facts.control(task)
        if control is not None and task.has_ended:
            shown = f"{control} of this job ({task.uuid[:8]})"
            what |= {"upload": str(self._tasks.uploads(task.uuid).path), "shown": shown}
        self.views.start(task.uuid, what, self._jobs.path(task.job) / "view.log")

    async def _result(self, request: Request) -> Response:
        """A file of a run; its name is only compared with the known ones. What is not finished comes from a view."""
        given = request.path_params
        try:
            task = self._tasks.get(given["uuid"])
            if given["path"].startswith(LIVE) and self._access.opens_results(task.uuid, given["mac"]):
                return await self._from_view(task, request, given["path"], {})
            return await to_thread.run_sync(self._file_of, task, given["mac"], given["path"])
        except (UnknownTaskError, MachineError) as error:
            raise HTTPException(404) from error

    def _file_of(self, task: Task, mac: str, path: str) -> Response:
        if not self._access.opens_results(task.uuid, mac) or path not in self._facts.result_names(task):
            raise HTTPException(404)
        try:
            file = open_inside(self._jobs.out(task.job), path)
        except FileNotServedError as error:
            raise HTTPException(404) from error
        kind = TYPES.get(PurePosixPath(path).suffix, "application/octet-stream")
        policy = CSP_OF_SITE if path.startswith(SITE) else CSP_OF_RUN
        return FileAnswer(file, kind, {**OF_RUN, "content-security-policy": policy})


class _Ours:
    """Passes only requests of our own page, in a browser that has the cookie."""

    def __init__(self, access: PageAccess, app: ASGIApp) -> None:
        self._access, self._app = access, app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope)
        try:
            self._access.require_ours(request.headers, scope["path_params"]["pages"])
        except RefusedError as error:
            await _said(error.status, str(error))(scope, receive, send)
            return
        await self._app(scope, receive, send)


def _said(status: int, text: str) -> Response:
    return JSONResponse({"error": text}, status)


def _encrypted(request: Request) -> bool:
    """Whether the browser speaks TLS; its Origin tells, whatever a proxy makes of the rest."""
    return request.headers.get("origin", "").startswith("https://")


async def _limited(request: Request) -> bytes:
    return b"".join([chunk async for chunk in limited(request, MAX_JSON_BYTES)])


async def _json(request: Request) -> dict[str, Any]:
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise HTTPException(415, "The request must be JSON.")
    try:
        found = json.loads(await _limited(request))
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
