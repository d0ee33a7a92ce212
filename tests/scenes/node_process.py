"""A real ``splatpipe start`` process, and folders dropped on its page as a person drops them."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Locator, Page
from timeouts import TIMEOUT_S

PAGE = re.compile(r"Page: (http://127\.0\.0\.1:\d+)/\?key=(\w+)")


@dataclass(frozen=True)
class StartedNode:
    """A running node.

    Attributes:
        address: Its address without a path.
        page: The address of its page that it printed.
        process: Its process.
    """

    address: str
    page: str
    process: subprocess.Popen[str]


@contextlib.contextmanager
def started(folder: Path, *options: object) -> Iterator[StartedNode]:
    """Run ``splatpipe start FOLDER`` while the context lasts."""
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "start", str(folder), "--no-browser"]
    command += map(str, options)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        assert process.stderr is not None
        output = ""
        for line in process.stderr:
            output += line
            if found := PAGE.search(line):
                yield StartedNode(found.group(1), found.group(0).removeprefix("Page: "), process)
                break
        else:
            raise AssertionError(output)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()  # no effect if it has ended


def drop(page: Page, onto: Locator, paths: Sequence[Path]) -> None:
    """Drop files and folders on an element, as from a file manager: the browser itself reads them."""
    onto.scroll_into_view_if_needed()
    box = onto.bounding_box()
    assert box is not None
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    where = {"x": box["x"] + box["width"] / 2.0, "y": box["y"] + 20.0, "data": data}
    session = page.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, **where})
    session.detach()
