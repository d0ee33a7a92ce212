"""Measure how soon a large model's site (`web/`) shows all of it, first coarse, then in full, over a slow network.

`viewer.html` of the same model is measured beside it. The browser uses software rendering. The model is a run's, with
each Gaussian replaced by several smaller ones within it; see `viewer_page`.

    python benchmarks web_page OUT --folder /tmp/site
"""

from __future__ import annotations

import argparse
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from opened_run import OpenedRun, open_run
from playwright.sync_api import Browser, CDPSession, Page, sync_playwright
from viewer_page import FLAGS, multiplied

from splatpipe.pipeline.delivery.delivery_frame import in_world
from splatpipe.pipeline.splat.levels.levels import build_levels
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.web.site import write_site
from splatpipe.pipeline.web.viewer_scene import viewer_rendering, viewer_scene, write_viewer

SITE, PAGE = "web", "viewer.html"
TIMEOUT_S = 420.0


def main() -> None:
    """Write both, unless they exist, and print how each loads at each window size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="OUT of a finished run")
    parser.add_argument("--folder", type=Path, required=True, help="for the two pages; reused where they are there")
    parser.add_argument("--gaussians", type=int, default=3_000_000)
    parser.add_argument("--sizes", default="390x844,1280x800", help="of the window")
    parser.add_argument("--pages", default=f"{SITE}/index.html,{PAGE}")
    parser.add_argument("--megabits", type=float, default=20.0, help="a second")
    parser.add_argument("--latency-ms", type=float, default=20.0)
    parser.add_argument("--first-only", action="store_true", help="not until it is there in full")
    options = parser.parse_args()
    if not (options.folder / SITE).exists():
        write_pages(open_run(options.out), options.gaussians, options.folder)
    for name in (SITE, PAGE):
        files = [path for path in (options.folder, *(options.folder / name).rglob("*")) if path.is_file()]
        files = files or [options.folder / name]
        print(f"{name}: {sum(path.stat().st_size for path in files) / 1e6:.1f} MB in {len(files)} files")
    with served(options.folder) as address, sync_playwright() as playwright:
        path = shutil.which("chromium") or shutil.which("google-chrome")
        for size in options.sizes.split(","):
            for page in options.pages.split(","):
                browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
                PageVisit(browser, size, options).go(f"{address}/{page}", options.folder)
                browser.close()


def write_pages(run: OpenedRun, count: int, folder: Path) -> None:
    """Write a site and a page of a model with that many Gaussians."""
    gaussians, sky = run.model
    frame = load_frame(run.parts["georef.frame"].path)
    rendering = viewer_rendering(run.options, sky)
    scene = viewer_scene(
        run.parts["undistort.dataset"].path, frame, rendering, run.held_out, count, f"{count:,} Gaussians"
    )
    many = in_world(multiplied(gaussians, count), frame)
    folder.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    write_viewer(folder, scene, many, largest_bytes=1e9)
    print(f"{PAGE}: {time.perf_counter() - began:.0f} s")
    began = time.perf_counter()
    root = build_levels(many)
    print(f"levels: {time.perf_counter() - began:.0f} s")
    began = time.perf_counter()
    write_site(folder / SITE, scene, Scene(many, SceneFacts("z up", antialias=rendering.antialias)), root)
    print(f"site: {time.perf_counter() - began:.0f} s")


@dataclass
class Traffic:
    """Network requests of a page.

    Attributes:
        hosts: Hosts of its requests.
        requests: IDs of its requests.
        received: Bytes received over the network.
    """

    hosts: set[str] = field(default_factory=set)
    requests: set[str] = field(default_factory=set)
    received: float = 0.0

    def listen(self, session: CDPSession) -> None:
        """Count the browser's network events."""

        def asked(event: dict) -> None:
            url = event["request"]["url"]
            if url.startswith("http"):
                self.requests.add(event["requestId"])
                self.hosts.add(url.split("/")[2])

        def received(event: dict) -> None:
            if event["requestId"] in self.requests:  # excludes data embedded in the page
                self.received += event["dataLength"]  # the host does not compress

        session.on("Network.requestWillBeSent", asked)
        session.on("Network.dataReceived", received)

    def summary(self) -> str:
        """Summarise the traffic."""
        return f"{self.received / 1e6:.1f} MB in {len(self.requests)} requests to {len(self.hosts)} host"


class PageVisit:
    """One page in a fresh browser on a slow network.

    Args:
        browser: A fresh browser.
        size: Window size, e.g. ``390x844``; a narrow one emulates a phone.
        options: The command's options.
    """

    def __init__(self, browser: Browser, size: str, options: argparse.Namespace) -> None:
        self._browser, self._size, self._options = browser, size, options
        width, height = (int(side) for side in size.split("x"))
        phone = width <= 640
        context = browser.new_context(viewport={"width": width, "height": height}, has_touch=phone, is_mobile=phone)
        context.set_default_timeout(1e3 * TIMEOUT_S)
        self._page = context.new_page()
        self._traffic = Traffic()

    def go(self, address: str, pictures: Path) -> None:
        """Open the page and print its timings."""
        options, page = self._options, self._page
        session = page.context.new_cdp_session(page)
        session.send("Network.enable")
        rate = options.megabits * 1e6 / 8.0
        limits = {"latency": options.latency_ms, "downloadThroughput": rate, "uploadThroughput": rate, "offline": False}
        session.send("Network.emulateNetworkConditions", limits)
        self._traffic.listen(session)
        name = address.rpartition("/")[2]
        began = time.perf_counter()
        page.goto(address, wait_until="commit")
        page.wait_for_function("() => window.splatpipe?.facts")
        print(f"\n{name} at {self._size}: script after {time.perf_counter() - began:.1f} s, {self._traffic.summary()}")
        page.evaluate("() => splatpipe.ready")
        print(f"  first whole picture after {time.perf_counter() - began:.1f} s, {self._traffic.summary()}")
        self._print_memory()
        page.screenshot(path=pictures / f"{name}-{self._size}-first.png")
        if options.first_only:
            return
        page.evaluate("() => splatpipe.complete()")
        print(f"  in full after {time.perf_counter() - began:.1f} s, {self._traffic.summary()}")
        self._print_memory()
        page.screenshot(path=pictures / f"{name}-{self._size}-full.png")
        nearer(page)
        page.evaluate("() => splatpipe.complete()")
        print(f"  nearer in full after {time.perf_counter() - began:.1f} s, {self._traffic.summary()}")
        self._print_memory()
        page.screenshot(path=pictures / f"{name}-{self._size}-near.png")

    def _print_memory(self) -> None:
        """Print the memory of the browser's processes: the page's own, and the renderer's, in place of GPU memory."""
        session = self._browser.new_browser_cdp_session()
        sizes = {}
        for process in session.send("SystemInfo.getProcessInfo")["processInfo"]:
            if process["type"] in ("renderer", "GPU"):
                sizes[process["type"]] = max(sizes.get(process["type"], 0.0), resident_bytes(process["id"]))
        session.detach()
        words = ", ".join(f"{name} {size / 1e6:.0f} MB" for name, size in sorted(sizes.items()))
        heap = self._page.evaluate("() => performance.memory.usedJSHeapSize")
        print(f"    resident: {words}; JS heap {heap / 1e6:.0f} MB")


def nearer(page: Page) -> None:
    """Move two thirds of the way to the scene's centre."""
    page.evaluate(
        """() => {
          const { position } = splatpipe.cameraState();
          const target = splatpipe.facts.centre;
          splatpipe.setCamera({ position: position.map((at, axis) => at + (target[axis] - at) / 1.5), target });
        }"""
    )


def resident_bytes(process: int) -> float:
    """Return a process's memory, with shared pages counted proportionally (PSS)."""
    for line in Path(f"/proc/{process}/smaps_rollup").read_text(encoding="utf-8").splitlines():
        if line.startswith("Pss:"):
            return 1024.0 * float(line.split()[1])
    return 0.0


class QuietHandler(SimpleHTTPRequestHandler):
    """A plain host without compression."""

    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        """Log nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on this machine; yield the address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


if __name__ == "__main__":
    main()
