"""`splatpipe node`: takes captures over HTTP, as WebODM and PyODM send them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from splatpipe.pipeline.app.terminal.parameters import expand_user

FolderArgument = Annotated[
    Path, typer.Argument(callback=expand_user, metavar="FOLDER", help="Folder for uploads, runs and results.")
]
PortOption = Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 for a free one.")]
HostOption = Annotated[
    str, typer.Option(metavar="ADDRESS", help="Address to listen on; others than this machine's need a token.")
]
TokenOption = Annotated[
    str,
    typer.Option(
        envvar="SPLATPIPE_NODE_TOKEN", show_envvar=True, help="Token that clients have to send, 16 letters or more."
    ),
]
ParallelOption = Annotated[int, typer.Option(min=1, max=64, help="Runs at once, as far as memory allows.")]
KeepOption = Annotated[
    float, typer.Option(metavar="DAYS", min=0.0, max=36500.0, help="Remove ended tasks after so many days; 0: never.")
]
AllowHostOption = Annotated[
    list[str] | None,
    typer.Option(metavar="HOST[:PORT]", help="Host that zipurl and webhook may name. Repeatable. Default: none."),
]


BrowserOption = Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")]


def start(
    folder: Annotated[
        Path,
        typer.Argument(callback=expand_user, metavar="[FOLDER]", help="Folder for uploads, runs and results."),
    ] = Path("~/splatpipe"),
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 for 8473, or another if it is taken.")
    ] = 0,
    browser: BrowserOption = True,
    keep: KeepOption = 0.0,
) -> None:
    """Open splatpipe in the browser, on this machine and for you alone: hand in photos, watch runs, open results."""
    import threading
    import webbrowser

    from splatpipe.pipeline.app.node.serve import NodeOptions, serve
    from splatpipe.pipeline.app.terminal.console import print_line

    def opened(address: str) -> None:
        if browser:
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()

    print_line(f"Photos, runs and results are kept in {folder}.")
    serve(NodeOptions(folder, port, keep_days=keep, own=True), print_line, opened)


def node(
    folder: FolderArgument,
    port: PortOption = 3000,
    host: HostOption = "127.0.0.1",
    token: TokenOption = "",
    parallel: ParallelOption = 1,
    keep: KeepOption = 0.0,
    allow_host: AllowHostOption = None,
) -> None:
    """Take captures over HTTP, as WebODM, CloudODM and PyODM send them, run them, and return the results."""
    from splatpipe.pipeline.app.node.serve import NodeOptions, serve
    from splatpipe.pipeline.app.terminal.console import print_line

    serve(NodeOptions(folder, port, host, token, parallel, keep, tuple(allow_host or ())), print_line)
