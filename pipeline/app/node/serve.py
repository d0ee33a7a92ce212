"""``splatpipe node``: the server."""

from __future__ import annotations

import ipaddress
import logging
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp

from splatpipe.pipeline.app.node.api.connection import NodeConnection
from splatpipe.pipeline.app.node.api.guard import PAGES, Guard
from splatpipe.pipeline.app.node.api.routes import Api, make_app
from splatpipe.pipeline.app.node.page.gate import own_token, page_access
from splatpipe.pipeline.app.node.page.routes import Page
from splatpipe.pipeline.app.node.tasks.folder_lock import locked_folder
from splatpipe.pipeline.app.node.tasks.node import Node
from splatpipe.pipeline.app.node.tasks.settings import Settings
from splatpipe.pipeline.app.view.access import KEY
from splatpipe.pipeline.engine.errors import MachineError, StopSignal, UsageError
from splatpipe.pipeline.engine.machine import available_cores

LOOPBACK, PORT = "127.0.0.1", 3000
# For one person, if free: marks that a browser has not sent yet belong to an address, which the next server needs, too.
OWN_PORT = 8473
LEAST_TOKEN_LETTERS = 16
BACKLOG = 512
DRAIN_S = 2  # an upload that is under way at the end is sent again by its client


@dataclass(frozen=True)
class NodeOptions:
    """Options of the server.

    Attributes:
        folder: Where everything is kept.
        port: The port; 0 for any free one.
        host: The IPv4 or IPv6 address to listen on.
        token: What clients have to know; empty for none, on this machine only.
        parallel: Runs at once.
        keep_days: Ended tasks are removed after so many days; 0 for never.
        allow_hosts: Hosts that the node may contact for a client.
        own: Whether it is for one person: only who has its printed address gets in, by a token that nobody knows.
    """

    folder: Path
    port: int = PORT
    host: str = LOOPBACK
    token: str = ""
    parallel: int = 1
    keep_days: float = 0.0
    allow_hosts: tuple[str, ...] = ()
    own: bool = False


def serve(
    options: NodeOptions, print_line: Callable[[str], None], ready: Callable[[str], None] = lambda _address: None
) -> None:
    """Serve until Ctrl-C or SIGTERM.

    Args:
        options: Options of the server.
        print_line: Prints a line for the user.
        ready: Called when it listens, with the address of its page for a browser of this user.

    Raises:
        UsageError: if others could reach the node and it has no token.
        MachineError: if the port is taken, or another node works in the folder.
    """
    check_options(options)
    logging.getLogger("python_multipart").setLevel(logging.CRITICAL)  # bodies that it cannot read are the client's
    with locked_folder(options.folder):
        threads = max(1, available_cores() // options.parallel)
        settings = Settings(options.folder.resolve(), options.parallel, threads, options.keep_days)
        node = Node(settings, options.allow_hosts, print_line)
        token = own_token(settings.folder) if options.own else options.token
        access = page_access(settings.folder, token)
        page = Page(node, access)
        listening = _listen_as(options)  # all tasks are known by now: no poll misses one
        host = f"[{options.host}]" if ":" in options.host else options.host
        address = f"http://{host}:{listening.getsockname()[1]}/"

        def listens() -> None:
            node.start()
            page.start()
            kept = f"ended tasks are kept {options.keep_days:g} days" if options.keep_days else "tasks are kept"
            print_line(f"Listening on {address}; {kept}. Ctrl-C to stop: what runs goes on at the next start.")
            if options.own or not token:
                print_line(f"Page: {address}{KEY}{access.keys.key}")
            else:
                print_line(f"Page: {address} asks for the token.")
            ready(f"{address}{KEY}{access.keys.own_key}")

        try:
            _Server(_settings(make_guarded(node, page, token, local=options.own)), listens).run(sockets=[listening])
        except StopSignal:  # Ctrl-C and SIGTERM are the normal ways to end the node
            print_line("Stopped: what was running goes on at the next start.")
        finally:
            listening.close()
            page.close()
            node.stop()


def make_guarded(node: Node, page: Page, token: str, *, local: bool = False) -> ASGIApp:
    """The application behind its guard."""
    return Guard(make_app(Api(node), page.routes()), token, PAGES, local=local)


def check_options(options: NodeOptions) -> None:
    """Check what can be checked without the folder.

    Raises:
        UsageError: if the address is none, or others could reach the node without a good token.
    """
    try:
        loopback = ipaddress.ip_address(options.host).is_loopback
    except ValueError as error:
        raise UsageError(
            f'"{options.host}" is not an address to listen on.', hint="Give an IP address: --host 127.0.0.1 or 0.0.0.0."
        ) from error
    if not loopback and not options.token:
        raise UsageError(
            f"On {options.host} everybody could use this node.", hint="Give a token: --token, or SPLATPIPE_NODE_TOKEN."
        )
    if options.token and (len(options.token) < LEAST_TOKEN_LETTERS or not options.token.isascii()):
        raise UsageError(
            f"The token has fewer than {LEAST_TOKEN_LETTERS} letters, or others than ASCII.",
            hint="Make one: openssl rand -hex 16",
        )
    if options.folder.exists() and not options.folder.is_dir():
        raise UsageError(f"{options.folder} is a file.", hint="Give a folder for the node's tasks.")


class _Server(uvicorn.Server):
    """Calls ``ready`` once it is listening; ends on SIGINT and SIGTERM."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start listening."""
        await super().startup(sockets)
        self._ready()


def _settings(app: ASGIApp) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        http=NodeConnection,
        ws="none",
        lifespan="off",
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,  # addresses are not told apart, so nothing is believed of a proxy
        timeout_graceful_shutdown=DRAIN_S,
        timeout_keep_alive=60,
        backlog=BACKLOG,
    )


def _listen_as(options: NodeOptions) -> socket.socket:
    if options.own and options.port == 0:
        try:
            return _listen(options.host, OWN_PORT)
        except MachineError:
            pass
    return _listen(options.host, options.port)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OSError as error:
        listening.close()
        raise MachineError(
            f"Port {port} of {host} cannot be used: {error.strerror}.", hint="Choose another: --port N, --host ADDRESS."
        ) from error
    listening.listen(BACKLOG)
    return listening
