"""Pages of ``splatpipe view`` in a real browser."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from finished_run import linked_copy
from served import Served, serving
from view_home import SECRET, WEB, refused


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
    watched = open_page(f"http://rebound.localhost:{served.port}/")
    assert "answers to 127.0.0.1 and localhost" in watched.page.content()


def test_a_page_of_another_origin_reads_nothing(served: Served, home: Path, open_page: Callable) -> None:
    page = home / "elsewhere.html"
    page.write_text("<!doctype html><title>elsewhere</title>")
    watched = open_page(page.as_uri())
    url = f"{served.address}/metrics.json"
    assert watched.page.evaluate(f"fetch('{url}').then(() => 'read', () => 'refused')") == "refused"
    script = "(url) => new Promise(done => { const s = document.createElement('script'); s.src = url;"
    script += " s.onload = () => done('read'); s.onerror = () => done('refused'); document.head.append(s) })"
    assert watched.page.evaluate(script, f"{served.address}/assets/live.js") == "refused"
    for foreign in ("Origin: null", "Origin: http://localhost:1", "Sec-Fetch-Site: cross-site"):
        assert refused(served.ask("/metrics.json", foreign))
    assert served.ask("/", "Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate").status == 200  # a link leads here


@pytest.mark.parametrize(("width", "height", "touch"), [(1440, 900, False), (390, 844, True)])
def test_the_landing_page_links_to_existing_files(
    served: Served, open_page: Callable, width: int, height: int, touch: bool
) -> None:
    watched = open_page(f"{served.address}/", width, height, touch)
    page = watched.page
    assert page.locator("h1").inner_text() == "out" and "Finished" in page.locator(".state").inner_text()
    names = [link.get_attribute("href") for link in page.locator("table a").all()]
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
    watched = open_page(f"{served.address}/live")
    watched.page.locator("#photo:not([hidden])").wait_for()
    assert "finished, iteration" in watched.page.locator("#iteration").inner_text()
    assert "(held out)" in watched.page.locator("#view option:checked").inner_text()
    sizes = watched.page.evaluate("['render', 'photo'].map(id => document.getElementById(id).naturalWidth)")
    assert sizes[0] == sizes[1] > 100
    assert watched.errors == []


def test_the_viewer_opens_from_here_with_its_splat_inside_or_beside_it(served: Served, open_page: Callable) -> None:
    """The page of the finished run carries its splat; that of the training loads it from this server."""
    page = open_page(f"{served.address}/live").page
    page.locator("#viewer:not([hidden])").wait_for()
    for address in ("/viewer.html", str(page.locator("#viewer").get_attribute("href"))):
        watched = open_page(served.address + address, 390, 400)
        watched.page.evaluate("splatpipe.ready")
        assert watched.errors == []
        assert [url.rpartition("/")[2] for url in watched.requests] == (["splat.spz"] if "live" in address else [])
