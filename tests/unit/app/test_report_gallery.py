"""The pictures kept between reports: used again only for the same facts, and never if they are not our own."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markupsafe import Markup
from typst import compile as compile_typst

from splatpipe.pipeline.app.report import PICTURES_FILE
from splatpipe.pipeline.app.report.charts import charts
from splatpipe.pipeline.app.report.charts.bars import stage_bars
from splatpipe.pipeline.app.report.charts.drawing import new_figure, styled, to_svg
from splatpipe.pipeline.app.report.charts.gallery import Gallery
from splatpipe.pipeline.app.report.charts.picture_check import is_plain_picture
from splatpipe.pipeline.app.report.facts.picture_sources import path_facts

SVG = (
    '<svg role="img" viewBox="0 0 1 1"><g><path d="M 0 0" style="fill: none"/><text x="1">a &amp; b</text></g></svg>\n'
)
JPEG = "data:image/jpeg;base64,/9j/4AAQ"


@dataclass(frozen=True)
class Crop:
    picture: Markup
    turn_deg: int


CHAPTER = {"charts": ({"svg": Markup(SVG), "text": "<b>"},), "crop": Crop(Markup(JPEG), 90), "share": 0.1}
PLAIN = {
    "charts": [{"svg": Markup(SVG), "text": "<b>"}],
    "crop": {"picture": Markup(JPEG), "turn_deg": 90},
    "share": 0.1,
}


class Drawing:
    """Draws a chapter, and counts how often."""

    def __init__(self, value: Any = CHAPTER) -> None:
        self.count, self._value = 0, value

    def __call__(self) -> Any:
        self.count += 1
        return self._value


def kept(out: Path, facts: Any = "facts", value: Any = CHAPTER) -> tuple[Any, int]:
    """What a report shows that finds the gallery of OUT, and how often it drew."""
    gallery, drawing = Gallery.read(out), Drawing(value)
    shown = gallery.keep("views", facts, drawing)
    gallery.write()
    return shown, drawing.count


def edit(out: Path, **changed: Any) -> None:
    """Change the kept entry as somebody would who knows how it is made: its digest fits its content."""
    from splatpipe.pipeline.app.report.charts.gallery import _digest

    path = out / PICTURES_FILE
    entries = json.loads(path.read_text())
    entries["views"] |= changed
    if isinstance(changed.get("content"), str):
        entries["views"]["digest"] = _digest(changed["content"])
    path.write_text(json.dumps(entries))


def test_a_kept_picture_is_shown_as_if_drawn(tmp_path: Path) -> None:
    assert kept(tmp_path) == (PLAIN, 1)
    shown, drawn = kept(tmp_path)
    assert (shown, drawn) == (PLAIN, 0)
    assert isinstance(shown["charts"][0]["svg"], Markup)
    assert not isinstance(shown["charts"][0]["text"], Markup)  # texts are escaped when they are shown


def test_changed_facts_are_drawn_again(tmp_path: Path) -> None:
    kept(tmp_path, [1])
    assert kept(tmp_path, [2], {"new": True}) == ({"new": True}, 1)
    assert kept(tmp_path, [2]) == ({"new": True}, 0)


def test_changed_code_draws_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept(tmp_path)
    monkeypatch.setattr("splatpipe.pipeline.app.report.charts.gallery.code_digest", lambda: "another")
    assert kept(tmp_path) == (PLAIN, 1)


def test_what_is_not_shown_any_more_is_not_kept(tmp_path: Path) -> None:
    kept(tmp_path)
    gallery = Gallery.read(tmp_path)
    gallery.keep("training", "facts", Drawing())
    gallery.write()
    assert list(json.loads((tmp_path / PICTURES_FILE).read_text())) == ["training"]


@pytest.mark.parametrize(
    "content", [b"", b"\xff", b"[]", b"7", b'{"views": 7}', b'{"views": {}}', b'{"views": {"key": 1}}']
)
def test_a_broken_file_is_drawn_again_and_replaced(tmp_path: Path, content: bytes) -> None:
    kept(tmp_path)
    (tmp_path / PICTURES_FILE).write_bytes(content)
    assert kept(tmp_path) == (PLAIN, 1)
    assert kept(tmp_path) == (PLAIN, 0)


def test_every_damaged_byte_is_found(tmp_path: Path) -> None:
    kept(tmp_path)
    path = tmp_path / PICTURES_FILE
    whole = path.read_bytes()
    for at in range(0, len(whole), 7):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert kept(tmp_path)[0] == PLAIN


@pytest.mark.parametrize(
    "content",
    [
        json.dumps({"picture": "<script>alert(1)</script>"}),
        json.dumps({"picture": SVG + "<script>alert(1)</script>"}),
        json.dumps([{"picture": 7}]),
        "[" * 100_000,
        "not JSON",
        7,
        None,
    ],
)
def test_somebody_elses_content_is_drawn_again(tmp_path: Path, content: Any) -> None:
    kept(tmp_path)
    edit(tmp_path, content=content)
    assert kept(tmp_path) == (PLAIN, 1)


def test_a_link_is_replaced_and_its_target_left_alone(tmp_path: Path) -> None:
    target, out = tmp_path / "target", tmp_path / "out"
    target.write_text("mine")
    (out / PICTURES_FILE).parent.mkdir(parents=True)
    (out / PICTURES_FILE).symlink_to(target)
    kept(out)
    assert target.read_text() == "mine"
    assert not (out / PICTURES_FILE).is_symlink()


def test_nothing_is_written_through_a_linked_folder(tmp_path: Path) -> None:
    elsewhere, out = tmp_path / "elsewhere", tmp_path / "out"
    elsewhere.mkdir()
    out.mkdir()
    (out / PICTURES_FILE).parent.symlink_to(elsewhere)
    assert kept(out) == (PLAIN, 1)
    assert not list(elsewhere.iterdir())


@pytest.mark.parametrize(
    "markup",
    [
        "",
        "text",
        "<p>a</p>",
        SVG[:-8],
        SVG + SVG,
        SVG.replace("<g>", "<g><!-- -->"),
        SVG.replace("<g>", "<g><![CDATA[a]]>"),
        SVG.replace("<g>", "<?a?><g>"),
        "<!DOCTYPE svg>" + SVG,
        SVG.replace("<g>", '<g onload="alert(1)">'),
        SVG.replace("<g>", '<g style="fill: url(https://a.b/c)">'),
        SVG.replace("<g>", '<g style="position: fixed">'),
        SVG.replace("<g>", '<g fill="url(https://a.b/c)">'),
        SVG.replace("<g>", '<g><image xlink:href="https://a.b/c.png"/>'),
        SVG.replace("<g>", '<g><image xlink:href="data:image/svg+xml;base64,AAAA"/>'),
        SVG.replace("<g>", '<g><use xlink:href="file.svg#a"/>'),
        SVG.replace("<g>", "<g><foreignObject></foreignObject>"),
        SVG.replace("<g>", "<g><style>* { display: none }</style>"),
        SVG.replace("<g>", "<g></p>"),
        SVG.replace("&amp;", "&other;"),
        "data:text/html;base64,AAAA",
        "data:image/svg+xml;base64,AAAA",
        'data:image/png;base64,AAAA" onerror="alert(1)',
        "data:image/png;base64,AAAA\n",
    ],
)
def test_what_is_no_plain_picture_is_refused(markup: str) -> None:
    assert not is_plain_picture(markup)


@pytest.mark.parametrize("markup", [SVG, JPEG, "data:image/png;base64,AAA="])
def test_plain_pictures_are_accepted(markup: str) -> None:
    assert is_plain_picture(markup)


def test_the_libraries_charts_are_plain_pictures() -> None:
    with styled():
        figure, axes = new_figure()
        axes.scatter([0, 1], [0, 1], s=3, rasterized=True)
        axes.quiver([0, 1], [0, 1], [1, 1], [1, 2], width=0.004)
        axes.imshow(np.eye(3))
        axes.fill_between([0, 1], [0, 1], alpha=0.3)
        axes.annotate("A & <b>", (0, 0), rotation=30)
        axes.plot([0, 1], [1, 0], "o--", label="ü “x”")
        axes.legend(title="photos")
        assert is_plain_picture(to_svg(figure, "A & 'b' \"c\" <d>"))
        assert is_plain_picture(charts.training_curve("loss", {1.0: 0.5, 2.0: 0.05}, 3.0, True))
        assert is_plain_picture(charts.view_bars([("a", 20.0), ("b", 30.0)], "dB"))


def test_path_facts_follow_content_and_never_a_link_out(tmp_path: Path) -> None:
    folder = tmp_path / "part"
    (folder / "below").mkdir(parents=True)
    (folder / "below" / "a").write_text("one")
    before = path_facts(folder)
    assert path_facts(folder) == before
    (folder / "below" / "a").write_text("two")  # as long, perhaps within the clock's step
    assert path_facts(folder) != before
    assert path_facts(tmp_path / "missing") == path_facts(tmp_path / "missing")
    (folder / "link").symlink_to("/")
    assert path_facts(folder) != path_facts(folder)


@pytest.mark.parametrize("values", [[3.0, 30.0, 0.0], [0.0], [0.02], [1e9, 1.0], [float("nan"), 2.0], []])
def test_bars_are_a_picture_that_others_read(values: list[float], tmp_path: Path) -> None:
    rows = [(f"stage <{number}>", value) for number, value in enumerate(values)]
    svg = stage_bars(rows, "seconds & more", "Time")
    assert is_plain_picture(svg)
    (tmp_path / "a.svg").write_text(svg)
    (tmp_path / "a.typ").write_text('#image("a.svg")')
    assert compile_typst(str(tmp_path / "a.typ"), format="pdf")


def test_bars_are_as_long_as_their_values() -> None:
    svg = stage_bars([("a", 10.0), ("b", 5.0), ("c", 0.0)], "seconds", "Time")
    widths = [float(width) for width in re.findall(r'<rect x="[^"]*" y="[^"]*" width="([^"]*)"', svg)][1:]
    assert widths == pytest.approx([2.0 * widths[1], widths[1], 0.0], abs=0.02)
    assert re.findall(r">([^<\n]+)</text>", svg) == ["0", "2", "4", "6", "8", "10", "a", "b", "c", "seconds"]
