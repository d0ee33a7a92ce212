"""benchmarks/seams finds planted seams in a finished run."""

import subprocess
from pathlib import Path

from repository import benchmark


def test_benchmark_finds_planted_seams(demo_run: Path) -> None:
    """On the demo, whose splat also serves as the model without blocks: no alarm, and some of each kind found."""
    coarse = next((demo_run / "stages").glob("train-*/model.ply"))
    command = benchmark("seams", demo_run, coarse, "--blocks", 2, "--plant")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "0 seams on 1 borders" in done.stdout
    rows = [[cell.strip() for cell in line.split("│")] for line in done.stdout.splitlines() if line.startswith("│")]
    assert {row[3] for row in rows if row[3] == row[5]} == {"-", "gap", "doubled", "colour"}, done.stdout
