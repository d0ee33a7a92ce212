"""The bars of stages, which are drawn without a library."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typst import compile as compile_typst

from splatpipe.pipeline.app.report.charts.bars import stage_bars


@pytest.mark.parametrize("values", [[3.0, 30.0, 0.0], [0.0], [0.02], [1e9, 1.0], [float("nan"), 2.0], []])
def test_bars_are_a_picture_that_others_read(values: list[float], tmp_path: Path) -> None:
    rows = [(f"stage <{number}>", value) for number, value in enumerate(values)]
    (tmp_path / "a.svg").write_text(stage_bars(rows, "seconds & more", "Time"))
    (tmp_path / "a.typ").write_text('#image("a.svg")')
    assert compile_typst(str(tmp_path / "a.typ"), format="pdf")


def test_bars_are_as_long_as_their_values() -> None:
    svg = stage_bars([("a", 10.0), ("b", 5.0), ("c", 0.0)], "seconds", "Time")
    widths = [float(width) for width in re.findall(r'<rect x="[^"]*" y="[^"]*" width="([^"]*)"', svg)][1:]
    assert widths == pytest.approx([2.0 * widths[1], widths[1], 0.0], abs=0.02)
    assert re.findall(r">([^<\n]+)</text>", svg) == ["0", "2", "4", "6", "8", "10", "a", "b", "c", "seconds"]
