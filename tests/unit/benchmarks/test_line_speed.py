"""The table of stages' CPU seconds from a run's events."""

import json
from pathlib import Path

import line_speed
import pytest


def run(out: Path, *stages: tuple[str, float], photos: int = 4) -> Path:
    out.mkdir()
    summary = {"photos": photos, "megapixels": 2.0 * photos}
    rows = [
        {
            "kind": "stage_finished",
            "stage": stage,
            "data": {"summary": summary, "cpu_seconds": seconds, "seconds": 1.0, "key": "k"},
            "time_s": 1.0,
        }
        for stage, seconds in stages
    ]
    (out / "events.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + "no event\n")
    return out


def test_last_attempts_and_shards_count_towards_their_stage(tmp_path: Path) -> None:
    out = run(tmp_path / "a", ("ingest", 2.0), ("train.0", 5.0), ("train.1", 7.0), ("clean", 9.0), ("clean", 4.0))
    costs = line_speed.read_costs(out)
    assert costs.cpu_s == {"ingest": 2.0, "train": 12.0, "clean": 4.0}
    rows = {row["stage"]: row[str(out)] for row in line_speed.seconds_table([costs])}
    assert rows["all stages"] == 18.0 and rows["a photo"] == 4.5 and rows["a megapixel"] == 2.25


def test_ratios_of_each_capture_and_of_all_together(tmp_path: Path) -> None:
    new = [line_speed.read_costs(run(tmp_path / f"n{k}", ("ingest", 1.0), ("clean", 2.0 + k))) for k in range(2)]
    old = [line_speed.read_costs(run(tmp_path / f"o{k}", ("ingest", 2.0), ("clean", 4.0))) for k in range(2)]
    rows = {row["stage"]: row for row in line_speed.ratio_table(new, old)}
    assert [rows["clean"][cost.name] for cost in new] == [0.5, 0.75] and rows["clean"]["together"] == 0.625
    assert rows["all stages"]["together"] == pytest.approx(7.0 / 12.0)


def test_a_run_without_photos_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no finished ingest"):
        line_speed.read_costs(run(tmp_path / "a", ("clean", 1.0)))
