"""A real ``splatpipe start`` process, and folders dropped on its page as a person drops them."""

from __future__ import annotations

import contextlib
import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from announced import announced
from playwright.sync_api import Locator, Page

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
    with announced(PAGE, "start", folder, "--no-browser", *options) as (found, process):
        yield StartedNode(found.group(1), found.group(0).removeprefix("Page: "), process)


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
