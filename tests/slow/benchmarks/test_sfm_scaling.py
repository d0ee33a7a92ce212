"""benchmarks/sfm_scaling, as a command."""

import json
import subprocess
from pathlib import Path

import flight_scene as scene
from repository import benchmark


def test_mappings_are_measured_on_the_same_matches(tmp_path: Path) -> None:
    small = scene.make_flight(6, 2, 400)
    database = tmp_path / "stages" / "matches-0" / "database.db"
    database.parent.mkdir(parents=True)
    scene.write_database(small, database, 2)
    truth = {"photos": [{"name": f"{i:05d}.jpg", "centre_m": small.centres_m[i].tolist()} for i in range(6)]}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    words = benchmark("sfm_speed", tmp_path, "--truth", tmp_path / "truth.json")
    subprocess.run([*words, "--mappers", "before", "ours", "--json", str(tmp_path / "rows.json")], check=True)
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [row["how"] for row in rows] == ["before", "ours", "before", "ours"]
    assert all(row["placed"] == row["photos"] == 6 and row["cpu_s"] > 0 for row in rows)
    assert all(row["centres_mm"] < 5000 and row["peak_bytes"] > 1e7 for row in rows[:2])
