"""The server of ``splatpipe view``, on 127.0.0.1 unless a container publishes its port."""

from __future__ import annotations

import ipaddress
import math
import socket
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import jinja2
import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.types import ASGIApp

from splatpipe.pipeline.app.view.access import KEY, Access
from splatpipe.pipeline.app.view.connection import Connection
from splatpipe.pipeline.app.view.files import TYPES, FileAnswer, FileNotServedError, open_inside
from splatpipe.pipeline.app.view.guard import CSP_OF_RUN, CSP_OF_SITE, FIRST_PAGE, OF_RUN, Guard
from splatpipe.pipeline.app.view.landing import downloadable_files, landing
from splatpipe.pipeline.app.view.live import Live
from splatpipe.pipeline.engine.errors import EXIT_INTERRUPTED, MachineError, SplatpipeError, StopSignal, UsageError
from splatpipe.pipeline.engine.run_folder import RunFolder, open_run_folder
from splatpipe.pipeline.web import asset
from splatpipe.pipeline.web.measured_page import SITE
from splatpipe.stages.line import LINE

ADDRESS, EVERYWHERE = "127.0.0.1", "0.0.0.0"
# If free: unsent marks in the browser's storage belong to an address, which the next server must have too.
MARKING_PORT = 8474
ASSETS = {
    "landing.css": "text/css",
    "live.css": "text/css",
    "live.js": "text/javascript",
    "mark.css": "text/css",
    "mark.js": "text/javascript",
}
PAGE_OF_RUN = {**OF_RUN, "content-security-policy": CSP_OF_RUN}
PAGE_OF_SITE = {**OF_RUN, "content-security-policy": CSP_OF_SITE}
FILES_CACHED_S = 1.0  # the list of files is cached, since a page may request thousands of files
ALONE = {"cross-origin-opener-policy": "same-origin"}  # a page that opened it, or that it opens, has no handle of it


@dataclass(frozen=True)
class ViewOptions:
    """Options of the server.

    Attributes:
        port: The port; 0 for any free one.
        bind: The IPv4 address to listen on. Other addresses than 127.0.0.1 are for containers, where requests through a
            published port come from outside, under any name.
        open_browser: Whether to open the page.
        mark: Whether control points can be marked.
        points: File of points to mark.
    """

    port: int = 0
    bind: str = ADDRESS
    open_browser: bool = True
    mark: bool = False
    points: Path | None = None


def serve(out: Path, options: ViewOptions, print_line: Callable[[str], None]) -> None:
    """Serve a run until Ctrl-C.

    Args:
        out: Its folder.
        options: Options of the server.
        print_line: Prints a line for the user.

    Raises:
        SplatpipeError: if there is no run, or nothing to mark.
        MachineError: if the port is taken.
    """
    bind = _check_address(options.bind)
    run = open_run_folder(out, LINE)
    listening = _listen_for_marks(bind) if options.mark and options.port == 0 else _listen(bind, options.port)
    live, access = Live(run), Access()
    pages = Pages(run, live, access)
    try:
        ours = [*(_marking(pages, options, print_line) if options.mark else ()), *pages.routes()]
        start = f"http://{ADDRESS if bind == EVERYWHERE else bind}:{listening.getsockname()[1]}/"
        start += "mark" if options.mark else "live" if run.is_running else ""

        def ready() -> None:
            if bind != ADDRESS:
                print_line(f"Listening on {bind}: everyone who has this address can use it, and it is not encrypted.")
            print_line(f"Open {start}{KEY}{access.key} (Ctrl-C to stop)")
            if options.open_browser:
                own = f"{start}{KEY}{access.own_key}"
                threading.Thread(target=webbrowser.open, args=(own,), daemon=True).start()

        routes = [Mount(f"/{access.pages}", routes=ours), Mount(f"/{access.files}", routes=pages.files())]
        _Server(_settings(make_app(routes, access, any_host=bind != ADDRESS)), ready).run(sockets=[listening])
    except StopSignal as stopped:
        if stopped.exit_code != EXIT_INTERRUPTED:  # Ctrl-C is the normal way to end the server
            raise
    finally:
        live.close()
        listening.close()


class _Server(uvicorn.Server):
    """Calls ``ready`` once it is listening and handles signals."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start listening."""
        await super().startup(sockets)
        self._ready()


def _marking(pages: Pages, options: ViewOptions, print_line: Callable[[str], None]) -> list[Route]:
    """The routes for marking."""
    from splatpipe.pipeline.app.view.mark_routes import MarkPages
    from splatpipe.pipeline.app.view.marking import Marking
    from splatpipe.pipeline.app.view.marking_job import open_job

    marking = Marking(open_job(pages.run, options.points))
    pages.marking = True
    print_line(f"Marks are saved to {marking.job.text.path}")
    return MarkPages(marking, pages).routes()


def _settings(app: ASGIApp) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        http=Connection,
        ws="none",
        lifespan="off",
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,  # of no proxy that we know: anyone could send them
        timeout_graceful_shutdown=1,
        limit_concurrency=64,
    )


def _check_address(bind: str) -> str:
    try:
        return str(ipaddress.IPv4Address(bind))
    except ValueError as error:
        raise UsageError(
            f'"{bind}" is not an IPv4 address to listen on.',
            hint="In a container --bind 0.0.0.0, otherwise omit --bind.",
        ) from error


def _listen_for_marks(bind: str) -> socket.socket:
    try:
        return _listen(bind, MARKING_PORT)
    except MachineError:
        return _listen(bind, 0)


def _listen(bind: str, port: int) -> socket.socket:
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((bind, port))
    except OSError as error:
        listening.close()
        raise MachineError(
            f"Port {port} of {bind} cannot be used: {error.strerror}.", hint="Choose another: --port N, --bind ADDRESS."
        ) from error
    listening.listen(64)
    return listening


def make_app(routes: Sequence[BaseRoute], access: Access, any_host: bool) -> ASGIApp:
    """The application behind the guard."""
    handlers: dict[Any, Any] = {SplatpipeError: _failed, HTTPException: _refused}
    app = Starlette(routes=routes, exception_handlers=handlers)
    app.router.redirect_slashes = False
    return Guard(app, access, any_host)


def _failed(_request: Request, error: Exception) -> Response:
    assert isinstance(error, SplatpipeError)
    return JSONResponse({"message": error.message, "hint": error.hint}, 500)


def _refused(_request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return PlainTextResponse(f"{error.detail}\n", error.status_code)


class Pages:
    """The pages that every view has.

    Args:
        run: The run.
        live: Its training.
        access: The server's secrets: its addresses are below them.
    """

    marking = False

    def __init__(self, run: RunFolder, live: Live, access: Access) -> None:
        self.run, self.live, self._access = run, live, access
        self._known: tuple[float, frozenset[str]] = (-math.inf, frozenset())
        folder = Path(__file__).parent / "pages"
        self._templates = jinja2.Environment(loader=jinja2.FileSystemLoader(folder), autoescape=True)

    def routes(self) -> list[Route]:
        """The routes of our pages."""
        return [
            Route(f"/{FIRST_PAGE}", self._landing),
            Route("/live", self._live),
            Route("/api/live", self._state),
            Route(
                "/live/{stamp}/{number:int}/{what}.jpg", self._picture
            ),  # the page sets the stamp: a new one means new images
            Route("/assets/{name}", self._asset),
        ]

    def files(self) -> list[Route]:
        """The routes of what the run itself made."""
        return [
            Route("/live/{stamp}/viewer.html", self._viewer),
            Route("/live/{stamp}/splat.spz", self._splat),
            Route("/{path:path}", self._file),
        ]

    def page(self, template: str, values: dict[str, Any]) -> Response:
        """Render one of our pages."""
        style = PurePosixPath(template).stem
        text = self._templates.get_template(template).render(style=style, folder=f"/{self._access.files}", **values)
        return HTMLResponse(text, headers=ALONE)

    def _landing(self, _request: Request) -> Response:
        return self.page("landing.html", landing(self.run, self.marking))

    def _live(self, _request: Request) -> Response:
        return self.page("live.html", {"name": self.run.name})

    def _state(self, _request: Request) -> Response:
        return JSONResponse(self.live.state())

    def _picture(self, request: Request) -> Response:
        given = request.path_params
        if given["what"] not in ("render", "photo"):
            raise HTTPException(404)
        made = self.live.picture(given["number"], given["what"])
        if made is None:
            raise HTTPException(404)
        return Response(made, media_type="image/jpeg", headers={"cache-control": "no-store"})

    def _viewer(self, _request: Request) -> Response:
        page = self.live.viewer("page")
        if page is None:
            raise HTTPException(404)
        return Response(page, media_type="text/html", headers=PAGE_OF_RUN)

    def _splat(self, _request: Request) -> Response:
        splat = self.live.viewer("splat")
        if splat is None:
            raise HTTPException(404)
        return Response(splat, media_type="application/octet-stream", headers=PAGE_OF_RUN)

    def _asset(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ASSETS:
            raise HTTPException(404)
        return Response(asset(name), media_type=ASSETS[name])

    def _file(self, request: Request) -> Response:
        """A deliverable of the run; its name is only compared with the known ones."""
        path = request.path_params["path"]
        if path not in self._downloadable_files():
            raise HTTPException(404)
        try:
            file = open_inside(self.run.out, path)
        except FileNotServedError as error:
            raise HTTPException(404) from error
        kind = TYPES.get(PurePosixPath(path).suffix, "application/octet-stream")
        return FileAnswer(file, kind, PAGE_OF_SITE if path.startswith(SITE) else PAGE_OF_RUN)

    def _downloadable_files(self) -> frozenset[str]:
        now = time.monotonic()
        since, names = self._known
        if now - since > FILES_CACHED_S:
            names = frozenset(downloadable_files(self.run))
            self._known = now, names
        return names
