"""A finished run's table of CPU seconds has its limits beside."""

import sys
from pathlib import Path

import line_limits
import line_speed
import pytest


def test_a_finished_run_is_printed_with_its_limits(
    demo_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["line_speed", str(demo_run)])
    line_speed.main()
    printed = capsys.readouterr().out
    assert all(heading in printed for heading in ("limit s", "times", "ms a pair", "a core, 10⁹/s: operations"))
    rows = {cells[1].strip(): cells[2:] for line in printed.splitlines() if len(cells := line.split("│")) == 9}
    limited = {stage for stage, (_spent, limit, *_) in rows.items() if limit.strip() != "-"}
    assert limited == {*line_limits.LIMITS, "all stages"} and "sparse" in rows


def test_training_is_counted_from_its_plan_and_history(demo_run: Path) -> None:
    numbers = line_limits.counts(demo_run)
    iterations = line_limits.last_artifacts(demo_run)["train"].summary["iterations"]
    assert 0.02e6 < numbers["trained_pixels"] / iterations <= 0.1e6  # coarser at first
    assert 1.0 < numbers["pairs_a_pixel"] < 200.0
    assert 100.0 < numbers["stepped"] / iterations < 1e5
