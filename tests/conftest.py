"""Shared by all tests: the location of the real photos, and a browser."""

import fcntl
import gc
import importlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import checked_on_call
import pytest
from finished_run import folder_digest, linked_copy
from jaxtyping import install_import_hook
from playwright.sync_api import Browser, Page, sync_playwright
from timeouts import TIMEOUT_S

import splatpipe.demo
from splatpipe.pipeline.engine.heap import imports_outside_gc

DEMO = (
    "features.extractor=opencv-sift",
    "features.max_image_size=1000",
    "features.max_features=3000",
    "matches.neighbours=8",
    "undistort.max_megapixels=0.1",
    "train.iterations=600",
    "flythrough.seconds=2.0",
    "depths.max_megapixels=0.01",
    "dsm.cell_m=0.3",
    "ortho.gsd_m=0.3",
    "split.every=4",
)
WORKER = "PYTEST_XDIST_WORKER"  # set where tests run in several parallel processes

splatpipe.demo.__path__.append(str(Path(__file__).parents[1] / "demo"))  # its generator, which no wheel contains


def _modules_with_shapes() -> Iterator[str]:
    """Yield the names of splatpipe's modules whose annotations give the shapes of arrays."""
    namespace = importlib.util.find_spec("splatpipe")
    assert namespace is not None and namespace.submodule_search_locations is not None, "splatpipe is not installed"
    for folder in (child for place in namespace.submodule_search_locations for child in Path(place).iterdir()):
        for path in folder.rglob("*.py"):
            if b"jaxtyping" in path.read_bytes():
                inside = path.relative_to(folder).with_suffix("").parts
                yield ".".join(["splatpipe", folder.name, *(part for part in inside if part != "__init__")])


def _check_shapes() -> None:
    """Let tests check the annotations of arrays when a module of ours is imported.

    All other modules are left to mypy: to instrument them, too, doubles the import time. Libraries are imported before:
    from within an instrumented module, they would be compiled again.
    """
    for library in ("kornia", "pycolmap", "torch"):
        importlib.import_module(library)
    checked_on_call.install()
    install_import_hook(list(_modules_with_shapes()), "beartype.beartype")


def pytest_configure(config: pytest.Config) -> None:
    """Restore Ctrl-C, and check shapes where tests run: not in the process that only hands them to workers.

    Background test runs ignore SIGINT, and so would all their children. Workers inherit the number of threads before
    they load a library: the other cores belong to other workers, and threads that wait for them cost CPU time as well.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if config.getoption("numprocesses", None):
        os.environ.setdefault("OMP_NUM_THREADS", "1")
    else:
        _check_shapes()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Import the tests' modules and what they test without garbage collection; later collections leave them out."""
    with imports_outside_gc():
        result = yield
        gc.freeze()
    return result


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--captures", default=None, help="Folder of real captures, for the tests marked captures.")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run tests that use ``isa`` on each instruction set of this CPU; kernels load only where they are tested."""
    if "isa" in metafunc.fixturenames:
        from splatpipe.pipeline.raster.isa import isa_names

        metafunc.parametrize("isa", isa_names(), indirect=True)


@pytest.fixture
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run the native kernels on an instruction set; restore it and the number of threads after the test."""
    from splatpipe.pipeline.native import _native

    before, threads = _native.isa(), _native.threads()
    _native.set_isa(request.param)
    yield request.param
    _native.set_isa(before)
    _native.set_threads(threads)


@pytest.fixture(scope="session")
def captures(request: pytest.FixtureRequest) -> Path:
    """Return the folder of real captures."""
    folder = request.config.getoption("--captures")
    assert folder, "give the folder of real captures with --captures"
    return Path(folder)


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes find the small pipelines of `tests/lines`."""
    folder = Path(__file__).parent / "lines"
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))


@pytest.fixture(scope="session")
def demo_options() -> list[str]:
    """The options of ``demo_run``, to continue a copy of it."""
    return [part for text in DEMO for part in ("--set", text)]


@pytest.fixture(scope="session")
def demo_run(demo_options: list[str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A finished run of the whole demo capture with its control, at 0.1 megapixels: 26 dB. To be read only.

    One for all workers of a test run. Whoever continues it takes a ``demo_copy``; that nobody writes into the run is
    checked at the end, since root may write into read-only files.
    """
    from splatpipe.demo import capture_path

    out = shared_folder(tmp_path_factory) / "demo_run"
    command = [
        sys.executable,
        "-m",
        "splatpipe.pipeline.app.cli.main",
        "run",
        str(capture_path()),
        str(out),
        *demo_options,
    ]
    with (out.parent / "demo_run.lock").open("a+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the first worker makes it, the others wait
        if not os.fstat(lock.fileno()).st_size:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            lock.write(folder_digest(out))
            lock.flush()
        lock.seek(0)
        made = lock.read()
    yield out
    assert folder_digest(out) == made, "a test wrote into demo_run"


@pytest.fixture
def demo_copy(demo_run: Path, tmp_path: Path) -> Path:
    """A copy of ``demo_run`` that a test may continue, of the same name: reports state it, and stay valid."""
    return linked_copy(demo_run, tmp_path / demo_run.name)


def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a temporary folder, the same for all workers of one test run."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if WORKER in os.environ else folder


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Yield headless Chromium, which renders WebGL2 in software; tests that use it fail without one."""
    with sync_playwright() as playwright:
        path = shutil.which("chromium") or shutil.which("google-chrome")
        assert path, "the pages are tested in a real browser: apt install chromium"
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
        yield playwright.chromium.launch(executable_path=path, args=flags)


@dataclass
class WatchedPage:
    """A page, with all its requests and errors since it was opened."""

    page: Page
    requests: list[str] = field(default_factory=list)  # addresses, except the page itself, data: and blob:
    errors: list[str] = field(default_factory=list)  # console errors, uncaught errors, failed requests

    def open(self, address: str) -> None:
        """Open an address, and wait for its load event; one with a key leads on to a page."""
        self.page.on("request", lambda request: self._asked(address, request.url))
        self.page.on("requestfailed", lambda request: self.errors.append(f"failed: {request.url[:200]}"))
        self.page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address, wait_until="load")
        self.page.wait_for_url(lambda url: "?key=" not in url)

    def _asked(self, address: str, url: str) -> None:
        if url.split("#")[0] != address.split("#")[0] and not url.startswith(("data:", "blob:")):
            self.requests.append(url)


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Callable[..., WatchedPage]]:
    """Yield ``open_page(address, width=1440, height=900, touch=False)``: it opens a watched page in a fresh profile."""
    contexts = []

    def open_page(address: str, width: int = 1440, height: int = 900, touch: bool = False) -> WatchedPage:
        context = browser.new_context(viewport={"width": width, "height": height}, has_touch=touch, is_mobile=touch)
        context.set_default_timeout(1000.0 * TIMEOUT_S)
        contexts.append(context)
        watched = WatchedPage(context.new_page())
        watched.open(address)
        return watched

    yield open_page
    for context in contexts:
        context.close()
