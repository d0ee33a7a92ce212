"""Pages of ``splatpipe view`` in a real browser."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from command import answered
from finished_run import linked_copy
from served import Served, serving
from view_home import SECRET, WEB, refused

# Not by wait_for_function: it evaluates text in the page, which the page's policy forbids.
WAIT_FOR_VIDEO = """new Promise(done => {
  const video = document.querySelector('video');
  video.readyState >= 2 ? done() : video.addEventListener('loadeddata', () => done());
})"""


@pytest.fixture(scope="module")
def home(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run in it, and secrets around and inside that it does not deliver."""
    home = tmp_path_factory.mktemp("home")
    out = linked_copy(demo_run, home / "out")
    for place in (home / "secret.txt", out / "secret.txt", out / "stages" / "secret.txt"):
        place.write_bytes(SECRET)
    (home / "elsewhere").mkdir()
    (home / "elsewhere" / "secret.txt").write_bytes(SECRET)
    (out / "cameras.json").unlink()
    (out / "cameras.json").symlink_to(home / "secret.txt")
    (out / "sparse.glb").unlink()
    (out / "sparse.glb").symlink_to("splat.ply")  # even to a deliverable
    # What a stage delivers as a folder names files below it; here the folder of that name in OUT is a link.
    sky = next((out / "stages").glob("export-*")) / "sky" / "deep"
    sky.mkdir(parents=True)
    (sky / "secret.txt").write_bytes(b"its own")
    (out / "deep").symlink_to(home / "elsewhere")
    # The viewer for web hosts, as in OUT.
    for folder in (sky.parent, out):
        for name, content in WEB.items():
            (folder / "web" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "web" / name).write_bytes(content)
    (out / "web/secret.txt").write_bytes(SECRET)
    return home


@pytest.fixture(scope="module")
def served(home: Path) -> Iterator[Served]:
    with serving(home / "out") as server:
        yield server


def test_a_browser_that_was_led_here_by_another_name_sees_nothing(served: Served, open_page: Callable) -> None:
    """Chromium resolves every name under localhost to this machine, as a rebound name would be."""
    watched = open_page(f"http://rebound.localhost:{served.port}{served.pages}/run")
    assert "answers to 127.0.0.1 and localhost" in watched.page.content()


def test_the_opened_address_is_replaced_and_leads_to_the_page(served: Served, home: Path, open_page: Callable) -> None:
    page = open_page(served.page("live")).page
    assert page.url == f"{served.address}{served.pages}/live"
    assert page.evaluate("document.cookie") == "" and page.evaluate("document.referrer") == ""
    assert page.evaluate("performance.getEntriesByType('resource').every(each => !each.name.includes('key='))")
    page.go_back()
    assert page.url == "about:blank"
    # From a page of another site, as of a terminal in a browser, which a strict cookie does not follow.
    link = home / "link.html"
    link.write_text(f'<!doctype html><a href="{served.page()}">view</a>')
    elsewhere = open_page(link.as_uri()).page
    elsewhere.get_by_text("view").click()
    elsewhere.wait_for_url(f"**{served.pages}/run")
    assert elsewhere.locator("h1").inner_text() == "out"


FOREIGN = """async (addresses) => Promise.all(addresses.map(async (address) => {
  const get = (how) => fetch(address, { credentials: "include", ...how }).then(() => "read", () => "refused");
  const loaded = new Promise((done) => {
    const script = Object.assign(document.createElement("script"), { src: address });
    script.onload = () => done("read");
    script.onerror = () => done("refused");
    document.head.append(script);
  });
  return [await get({}), await get({ mode: "no-cors" }), await loaded];
}))"""


def test_a_page_of_another_origin_reads_nothing(served: Served, home: Path, open_page: Callable) -> None:
    """Not even one that knows the addresses, in the browser that has the cookie."""
    page = open_page(served.page()).page
    elsewhere = home / "elsewhere.html"
    elsewhere.write_text("<!doctype html><title>elsewhere</title>")
    ours = [
        f"{served.address}{path}" for path in ("/", *(served.pages + path for path in ("/live", "/assets/live.js")))
    ]
    with hosted(home) as (port, cookies):
        for address in (elsewhere.as_uri(), f"http://127.0.0.1:{port}/elsewhere.html"):
            page.goto(address)
            page.reload()
            assert page.evaluate(FOREIGN, ours) == [["refused"] * 3] * 3
        assert page.evaluate(FOREIGN, [served.file("metrics.json")])[0][0] == "refused"
        assert len(cookies) >= 2 and set(cookies) == {None}  # another port receives no cookie of ours
    for foreign in (
        "Origin: null",
        "Origin: http://localhost:1",
        "Sec-Fetch-Site: cross-site",
        "Sec-Fetch-Site: same-site",
    ):
        assert refused(served.ask(f"{served.pages}/api/live", foreign))
    assert served.ask(f"{served.pages}/run", "Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate").status == 200


@contextlib.contextmanager
def hosted(folder: Path) -> Iterator[tuple[int, list[str | None]]]:
    """Another server on this machine: its port, and the Cookie headers that it receives."""
    cookies: list[str | None] = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            cookies.append(self.headers["cookie"])

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port, cookies
        server.shutdown()


@pytest.mark.parametrize(("width", "height", "touch"), [(1440, 900, False), (390, 844, True)])
def test_the_landing_page_links_to_existing_files(
    served: Served, open_page: Callable, width: int, height: int, touch: bool
) -> None:
    watched = open_page(served.page(), width, height, touch)
    page = watched.page
    assert page.locator("h1").inner_text() == "out" and "Finished" in page.locator(".state").inner_text()
    names = [link.get_attribute("href") for link in page.locator("table a").all()]
    names = [str(name).removeprefix(served.files) for name in names]
    assert {"/splat.ply", "/metrics.json", "/georef.json"} <= set(names)
    assert not {"/cameras.json", "/sparse.glb", "/deep/secret.txt"} & set(names)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for title in ("3D viewer", "Report", "Film"):
        link = page.locator("a.way", has_text=title).get_attribute("href")
        assert served.ask(str(link), method="HEAD").status == 200
    page.get_by_text("Training", exact=True).click()
    page.wait_for_url("**/live")
    assert watched.errors == []
    assert all(url.startswith(served.address) for url in watched.requests)


def test_a_finished_run_shows_its_model_beside_the_photos(served: Served, open_page: Callable) -> None:
    watched = open_page(served.page("live"))
    watched.page.locator("#photo:not([hidden])").wait_for()
    assert "finished, iteration" in watched.page.locator("#iteration").inner_text()
    assert "(held out)" in watched.page.locator("#view option:checked").inner_text()
    sizes = watched.page.evaluate("['render', 'photo'].map(id => document.getElementById(id).naturalWidth)")
    assert sizes[0] == sizes[1] > 100
    assert watched.errors == []


def test_the_viewer_opens_from_here_with_its_splat_inside_or_beside_it(served: Served, open_page: Callable) -> None:
    """The page of the finished run carries its splat; that of the training loads it from this server."""
    page = open_page(served.page("live")).page
    page.locator("#viewer:not([hidden])").wait_for()
    for address in (f"{served.files}/viewer.html", str(page.locator("#viewer").get_attribute("href"))):
        watched = open_page(served.address + address, 390, 400)
        watched.page.evaluate("splatpipe.ready")
        assert watched.errors == []
        assert [url.rpartition("/")[2] for url in watched.requests] == (["splat.spz"] if "live" in address else [])


def test_report_film_files_and_web_viewer_work_in_their_sandbox(
    demo_run: Path, tmp_path: Path, open_page: Callable
) -> None:
    out = linked_copy(demo_run, tmp_path / "out")
    answered("export", out, "--format", "web")
    with serving(out) as server:
        pages = [open_page(server.file(name), 390, 400) for name in ("web/index.html", "viewer.html")]  # in software
        for watched in pages:
            watched.page.evaluate("splatpipe.ready")
            assert watched.page.evaluate("origin") == "null"
        with pages[1].page.expect_download() as saved:
            pages[1].page.keyboard.press("x")  # the picture of the view
        assert saved.value.suggested_filename.endswith(".png")
        report = open_page(server.file("report.html"))
        page = report.page
        assert page.locator("h1").count() == 1
        assert page.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
        assert [watched.errors for watched in (*pages, report)] == [[], [], []]
        with page.expect_download() as saved:
            page.locator("a[href='splat.ply']").first.click()
        assert Path(saved.value.path()).read_bytes() == (out / "splat.ply").read_bytes()
        page.goto(server.file("flythrough.webm"))
        page.evaluate(WAIT_FOR_VIDEO)
        page.goto(server.file("metrics.json"))
        assert "psnr" in page.content()
