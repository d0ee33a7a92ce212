"""The pages' bundled scripts, in a real browser."""

from collections.abc import Callable
from pathlib import Path


def test_the_browser_has_webgl2_and_reports_a_pages_errors(tmp_path: Path, open_page: Callable) -> None:
    page = tmp_path / "page.html"
    page.write_text("<!doctype html><script>fetch('https://elsewhere.invalid/x').catch(() => 0); nothing.here</script>")
    watched = open_page(page.as_uri())
    watched.page.wait_for_timeout(200)
    assert watched.page.evaluate("!!document.createElement('canvas').getContext('webgl2')")
    assert watched.requests == ["https://elsewhere.invalid/x"]
    assert any("nothing is not defined" in error for error in watched.errors)
