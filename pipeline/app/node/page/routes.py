"""The addresses of the page: entrance, our pages and their JSON behind a cookie, and the files of runs in a sandbox.

/                              the entrance: asks for the token, or takes the key of the printed address
/page/enter, /page/assets/…    what it needs
/page/SECRET/                  the page; below it its JSON, the node's API as clients use it, check pages, views
/results/UUID/MAC/…            files of a run
"""

from __future__ import annotations

import threading
from pathlib import PurePosixPath

import jinja2
from anyio import to_thread
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route

from splatpipe.pipeline.app.node.page.checks import Checks
from splatpipe.pipeline.app.node.page.facts import Facts
from splatpipe.pipeline.app.node.page.gate import OURS, RESULTS, PageAccess
from splatpipe.pipeline.app.node.page.our_pages import HTML, TEMPLATES, OurPages, asset_answer, json_of, said
from splatpipe.pipeline.app.node.page.view_children import ViewChildren
from splatpipe.pipeline.app.node.tasks.node import Node
from splatpipe.pipeline.app.node.tasks.record import Task
from splatpipe.pipeline.app.node.tasks.store import UnknownTaskError
from splatpipe.pipeline.app.serving.files import TYPES, FileAnswer, FileNotServedError, open_inside
from splatpipe.pipeline.app.view.guard import CSP_OF_RUN, CSP_OF_SITE, ENTRANCE, OF_RUN
from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.web.measured_page import SITE

MAX_TOKEN_LETTERS = 512
MAX_ENTER_BYTES = 8 << 10  # strangers send it
LOOK_S = 0.3
LIVE = "live/"  # what a run has not finished


class Page:
    """The page of a node.

    Args:
        node: The node.
        access: The page's secrets.
    """

    def __init__(self, node: Node, access: PageAccess) -> None:
        self._tasks, self._jobs, self._access = node.tasks, node.jobs, access
        self._checks, self._views = Checks(node.settings.threads), ViewChildren()
        self.facts = Facts(node, access, self._checks)
        self._ours = OurPages(node, access, self._checks, self._views, self.facts)
        self._templates = jinja2.Environment(loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._look_after, name="page", daemon=True)

    def routes(self) -> list[BaseRoute]:
        """The routes."""
        return [
            Route("/", self._entrance),
            Route(f"/{OURS}/enter", self._enter, methods=["POST"]),
            Route(f"/{OURS}/assets/{{name}}", asset_answer),
            Mount(f"/{OURS}/{{pages}}", app=self._ours.app()),
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
        self._checks.close()
        self._views.close()

    def _look_after(self) -> None:
        while not self._closing.wait(LOOK_S):
            self._checks.advance()
            self._views.advance()

    def _entrance(self, request: Request) -> Response:
        if request.query_params and self._access.keys.opens(
            request.scope["query_string"], request.scope["client"], request.scope["server"]
        ):
            headers = {"set-cookie": self._access.set_cookie(encrypted=_encrypted(request))}
            return HTMLResponse(ENTRANCE.format(to=self._access.address), headers=HTML | headers)
        text = self._templates.get_template("entrance.html.j2").render(asks=bool(self._access.token))
        return HTMLResponse(text, headers=HTML)

    async def _enter(self, request: Request) -> Response:
        body = await json_of(request, MAX_ENTER_BYTES)
        token = body.get("token")
        if not isinstance(token, str) or len(token) > MAX_TOKEN_LETTERS or not self._access.takes(token):
            return said(403, "This is not the token of this node.")
        headers = {"set-cookie": self._access.set_cookie(encrypted=_encrypted(request))}
        return JSONResponse({"to": self._access.address}, headers=headers)

    async def _result(self, request: Request) -> Response:
        """A file of a run; its name is only compared with the known ones. What is not finished comes from a view."""
        given = request.path_params
        try:
            task = self._tasks.get(given["uuid"])
            if given["path"].startswith(LIVE) and self._access.opens_results(task.uuid, given["mac"]):
                return await self._ours.from_view(task, request, given["path"], {})
            return await to_thread.run_sync(self._file_of, task, given["mac"], given["path"])
        except (UnknownTaskError, MachineError) as error:
            raise HTTPException(404) from error

    def _file_of(self, task: Task, mac: str, path: str) -> Response:
        if not self._access.opens_results(task.uuid, mac) or path not in self.facts.result_names(task):
            raise HTTPException(404)
        try:
            file = open_inside(self._jobs.out(task.job), path)
        except FileNotServedError as error:
            raise HTTPException(404) from error
        kind = TYPES.get(PurePosixPath(path).suffix, "application/octet-stream")
        policy = CSP_OF_SITE if path.startswith(SITE) else CSP_OF_RUN
        return FileAnswer(file, kind, {**OF_RUN, "content-security-policy": policy})


def _encrypted(request: Request) -> bool:
    """Whether the browser speaks TLS; its Origin tells, whatever a proxy makes of the rest."""
    return request.headers.get("origin", "").startswith("https://")
