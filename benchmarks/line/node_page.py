"""The node's page in a browser: a folder is dropped and run to its end at two widths, with a picture of each state.

    python benchmarks node_page FOLDER PICTURES [--preset preview] [--photos 12] [--node FOLDER]

Without --photos the whole folder is dropped. Prints when each state was reached, what the node's own process took, and
what was wrong: console errors, requests to others, pages wider than the window. Widths after the first hand in the same
photos, which the node computes once.
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Locator, Page, ViewportSize, expect, sync_playwright

WIDTHS = ((1440, 900), (390, 844))
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
RUN_MS = 6 * 3600_000.0
ADDRESS = re.compile(r"Page: (http://\S+)")
PROC_STATUS = re.compile(r"VmHWM:\s+(\d+) kB")


def main(words: Sequence[str]) -> None:
    """Run the flow once at each width."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--photos", type=int, default=0, help="only the last so many photos")
    parser.add_argument("--node", type=Path, help="the node's folder; default: a temporary one")
    given = parser.parse_args(words)
    given.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splatpipe-node-page-") as home, sync_playwright() as playwright:
        dropped = _some(given.folder, Path(home), given.photos) if given.photos else given.folder.resolve()
        program = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        with _node(given.node or Path(home) / "node") as (address, pid):
            for width, height in WIDTHS:
                Visit(browser, address, (width, height), given.pictures).run(dropped, given.preset)
            print(f"the node's process: {_peak_mb(pid):.0f} MB at most")


class Visit:
    """One visit to the page, at one width.

    Args:
        browser: The browser.
        address: The page's address, with its key.
        size: Of the window.
        pictures: Folder for screenshots.
    """

    def __init__(self, browser: Browser, address: str, size: tuple[int, int], pictures: Path) -> None:
        self._width, self._pictures, self._address = size[0], pictures, address
        self._size: ViewportSize = {"width": size[0], "height": size[1]}
        narrow = size[0] < 500
        context = browser.new_context(viewport=self._size, has_touch=narrow, is_mobile=narrow)
        context.set_default_timeout(120_000.0)
        self.page = context.new_page()
        self.wrong: list[str] = []
        origin = address.partition("/?")[0]
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("console", lambda said: said.type == "error" and self.wrong.append(said.text))
        self.page.on(
            "request",
            lambda request: request.url.startswith((origin, "data:", "blob:")) or self.wrong.append(request.url),
        )
        self._began_s = time.monotonic()

    def run(self, folder: Path, preset: str) -> None:
        """Drop the folder, start the run, and open its results."""
        page = self.page
        page.goto(self._address)
        page.wait_for_url(lambda url: "?key=" not in url)
        expect(page.locator("#about")).to_contain_text("of disk free")
        self.note("empty")
        drop(page, page.locator(".zone"), [folder])
        card = page.locator(".section:not(#ended) .job", has=page.get_by_role("heading", name=folder.name, exact=True))
        expect(card).to_be_visible()
        self.note("uploading")
        expect(card.get_by_text(re.compile(r"All \d+ files are here\."))).to_be_visible()
        self.note("uploaded")
        expect(card.get_by_role("region", name="what the check found")).to_be_visible(timeout=RUN_MS)
        self.note("checked")
        card.get_by_label(preset).check()
        card.get_by_role("button", name="Start", exact=True).click()
        expect(page.locator("#prepared")).to_be_hidden()
        self.note("started")
        card = page.locator(".job").first
        seen = ""
        until_s = time.monotonic() + RUN_MS / 1000.0
        while not (state := card.locator(".state").inner_text()).startswith(("Finished", "Failed")):
            if state.split()[0] != seen:
                seen = state.split()[0]
                self.note(seen.lower().strip(",:."))
            if time.monotonic() > until_s:
                raise TimeoutError(state)
            page.wait_for_timeout(1000)
        self.note("ended")
        print(f"{self._width}: {state}")
        card.locator(".files summary").click()
        self.note("files")
        for name in ("Report", "3D viewer"):
            self._open(card, name)
        with page.expect_download() as saved:
            card.get_by_role("link", name="All files (all.zip)").click()
        print(f"{self._width}: {saved.value.suggested_filename}, {saved.value.path().stat().st_size / 1e6:.1f} MB")
        print(f"{self._width}: wrong: {self.wrong or 'nothing'}")
        page.context.close()

    def note(self, state: str) -> None:
        """Keep pictures of a state at each width, and say when it was reached."""
        for width, height in WIDTHS:
            self.page.set_viewport_size({"width": width, "height": height})
            if self.page.evaluate("document.documentElement.scrollWidth > innerWidth"):
                self.wrong.append(f"{state} is wider than {width}")
            self.page.screenshot(path=self._pictures / f"{self._width}-{state}-{width}.png", full_page=True)
        self.page.set_viewport_size(self._size)
        print(f"{self._width}: {state} after {time.monotonic() - self._began_s:.0f} s", flush=True)

    def _open(self, card: Locator, name: str) -> None:
        with self.page.expect_popup() as opened:
            card.get_by_role("link", name=name, exact=True).click()
        popup = opened.value
        popup.wait_for_load_state("load")
        if name == "3D viewer":
            popup.evaluate("splatpipe.ready")
        popup.screenshot(path=self._pictures / f"{self._width}-{name.lower().replace(' ', '-')}.png")
        popup.close()


def drop(page: Page, onto: Locator, paths: Sequence[Path]) -> None:
    """Drop files and folders on an element, as from a file manager: the browser itself reads them."""
    box = onto.bounding_box()
    assert box is not None
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    session = page.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        where = {"x": box["x"] + box["width"] / 2.0, "y": box["y"] + 20.0, "data": data}
        session.send("Input.dispatchDragEvent", {"type": kind, **where})


def _some(folder: Path, home: Path, count: int) -> Path:
    """A copy of a capture with its last photos only."""
    some = home / folder.resolve().name
    photos = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg"))[-count:]
    for path in [*photos, *folder.glob("*.txt"), *folder.glob("*.csv")]:
        (some / path.relative_to(folder)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, some / path.relative_to(folder))
    return some


@contextmanager
def _node(folder: Path) -> Iterator[tuple[str, int]]:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "start", str(folder), "--no-browser"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        found = next(filter(None, map(ADDRESS.search, process.stderr)))
        yield found.group(1), process.pid
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


def _peak_mb(pid: int) -> float:
    found = PROC_STATUS.search(Path(f"/proc/{pid}/status").read_text())
    return int(found[1]) / 1e3 if found else float("nan")


if __name__ == "__main__":
    main(sys.argv[1:])
