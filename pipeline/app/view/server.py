"""The server of ``splatpipe view``, on 127.0.0.1 unless a container publishes its port."""

from __future__ import annotations

import ipaddress
import socket
import threading
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.types import ASGIApp

from splatpipe.pipeline.app.serving.connection import Connection
from splatpipe.pipeline.app.view.access import KEY, Access
from splatpipe.pipeline.app.view.guard import Guard
from splatpipe.pipeline.app.view.live import Live
from splatpipe.pipeline.app.view.run_pages import Pages
from splatpipe.pipeline.engine.errors import EXIT_INTERRUPTED, MachineError, SplatpipeError, StopSignal, UsageError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.stages.line import LINE

ADDRESS, EVERYWHERE = "127.0.0.1", "0.0.0.0"
# If free: unsent marks in the browser's storage belong to an address, which the next server must have too.
MARKING_PORT = 8474


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
    from splatpipe.pipeline.app.view.marking.mark_routes import MarkPages
    from splatpipe.pipeline.app.view.marking.marking import Marking
    from splatpipe.pipeline.app.view.marking.marking_job import open_job

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
        proxy_headers=False,  # anyone could send them: we know no proxy
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
