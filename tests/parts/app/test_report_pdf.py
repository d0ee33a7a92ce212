"""The report as PDF: the page's figures, a few pages, the same bytes; texts of the run cannot be markup."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from pypdf import PdfReader

from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
from splatpipe.pipeline.app.report.page import report_content, report_page, run_labels
from splatpipe.pipeline.app.report.pdf import MAX_ENTRIES, MAX_MARKS, report_pdf
from splatpipe.pipeline.app.report.verdict import VerdictLine

NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?")
PAGE = re.compile(r"\d+ / \d+")


@dataclass(frozen=True)
class Report:
    """The report of the finished run in both forms."""

    content: Mapping[str, Any]
    page: str
    pdf: bytes
    labels: Any


@pytest.fixture(scope="module")
def report(demo_run: Path) -> Report:
    inputs = read_report_inputs(demo_run)
    content, labels = report_content(inputs, drawn=True), run_labels(inputs)
    return Report(content, report_page(inputs, content), report_pdf(content, labels), labels)


def text_of(pdf: bytes) -> str:
    return " ".join(PAGE.sub(" ", page.extract_text()) for page in PdfReader(io.BytesIO(pdf)).pages)


def fonts_of(pdf: bytes) -> Iterator[Any]:
    for page in PdfReader(io.BytesIO(pdf)).pages:
        for font in page["/Resources"]["/Font"].values():
            yield from font.get_object()["/DescendantFonts"]


def test_every_figure_is_one_of_the_page(report: Report) -> None:
    text = text_of(report.pdf)
    of_page = html.unescape(re.sub(r"<style.*?</style>|<script.*?</script>|<[^>]*>", " ", report.page, flags=re.DOTALL))
    left_out = set(re.findall(r"(\d[\d,]*) more [^.]* report\.html", text))
    strange = set(NUMBER.findall(text)) - set(NUMBER.findall(of_page)) - left_out
    assert not strange, strange


def test_it_has_the_verdict_the_key_figures_and_the_accuracy(report: Report) -> None:
    text = " ".join(text_of(report.pdf).split())
    cards = [figure for _, figure, _ in report.content["key_figures"]["cards"]]
    accuracy = [value for row in report.content["georeferencing"]["tables"] for value in row["rmse"]]
    verdict = report.content["verdict"]
    for expected in (verdict.headline, *(finding.title for finding in verdict.findings), *cards, *accuracy):
        assert expected in text


def test_it_is_short_and_has_its_fonts_in_it(report: Report) -> None:
    reader = PdfReader(io.BytesIO(report.pdf))
    assert 4 <= len(reader.pages) <= 10
    assert len(report.pdf) < 10e6
    assert all(abs(float(page.mediabox.width) - 595.28) < 0.1 for page in reader.pages)
    fonts = list(fonts_of(report.pdf))
    assert fonts and all(
        "DejaVuSans" in font["/BaseFont"] and "/FontFile2" in font["/FontDescriptor"] for font in fonts
    )


def test_the_same_content_gives_the_same_bytes(report: Report) -> None:
    assert report_pdf(report.content, report.labels) == report.pdf


def test_of_long_lists_the_worst_stay_and_the_rest_is_counted(report: Report) -> None:
    whole = report.content["georeferencing"]
    points = [
        {**whole["points"][0], "name": f"N{k}", "residual": [f"{k / 1000:.3f}", "0.000", "–"]} for k in range(200)
    ]
    marks = [{**whole["marks"][0], "name": f"M{k}"} for k in range(60)]
    rows = [{**report.content["views"]["rows"][0], "name": f"V{k}.JPG"} for k in range(200)]
    long = {
        **report.content,
        "georeferencing": {**whole, "points": points, "points_more": 50, "marks": marks},
        "views": {**report.content["views"], "rows": rows, "rows_more": 7},
    }
    pdf = report_pdf(long, report.labels)
    text, kept = text_of(pdf), MAX_ENTRIES["georeferencing"]["points"]
    assert len(PdfReader(io.BytesIO(pdf)).pages) <= 10
    assert f"{250 - kept} more points" in " ".join(text.split())
    assert f"{207 - MAX_ENTRIES['views']['rows']} more photos" in " ".join(text.split())
    assert "N199" in text and "N0 " not in text
    assert len(re.findall(r"\bM\d+\b", text)) == MAX_MARKS


def test_texts_of_the_run_are_set_as_they_stand(report: Report) -> None:
    name = '#panic("x") *b* $x^2$ `c` <l> @r \\ // [ ] "'
    finding = VerdictLine("bad", name, "\u202etxt\x00 /home/anna/photos/a.jpg " + 10_000 * "word ")
    verdict = replace(report.content["verdict"], findings=(finding,))
    text = text_of(report_pdf({**report.content, "name": name, "verdict": verdict}, report.labels))
    assert name.split()[0] in text and "$x^2$" in text and "`c`" in text
    assert "anna" not in text and "\u202e" not in text
    assert text.count("word") < 200


def test_a_damaged_chapter_says_so(report: Report) -> None:
    text = text_of(
        report_pdf({**report.content, "views": {"trouble": "This part could not be read: x"}}, report.labels)
    )
    assert "This part could not be read" in text
