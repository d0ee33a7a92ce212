"""A batch whose pipeline has a sharded stage: a killed shard costs only its own job."""

import json
import os
import subprocess
import sys
from pathlib import Path

from batch_sites import NORTH, SOUTH, captures
from repository import LINES

from splatpipe.pipeline.app.batch.jobs.attempts import read_attempts
from splatpipe.pipeline.app.batch.jobs.plan import Call

TOTALS = {name: sum(number**2 for number in numbers) for name, numbers in (("north", NORTH), ("south", SOUTH))}


def batch(listed: Path, out: Path, *more: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """The whole program with the pipeline of `sharded`."""
    path = os.pathsep.join([str(LINES / "sharded_site"), str(LINES), os.environ.get("PYTHONPATH", "")])
    words = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "batch", str(listed), str(out), *more]
    return subprocess.run(
        words, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path, **variables}
    )


def test_captures_run_in_shards_and_a_killed_shard_costs_only_its_own_job(tmp_path: Path) -> None:
    """Their number is known once the stage that counts them has run; in later runs, before anything runs."""
    listed, out = captures(tmp_path), tmp_path / "night"
    output = batch(listed, out, "--dry-run")
    assert output.returncode == 0 and "sum_shard" not in output.stderr
    assert "north: read, divide, sum, show (" in output.stderr and len(output.stderr.splitlines()) < 40
    done = batch(listed, out, "--until", "sum", "--threads", "1", "--json", SHARDED_KILL="2")
    assert done.returncode == 0, done.stderr
    sums = {path.parts[-4]: json.loads(path.read_text())["total"] for path in out.glob("*/stages/sum-*/total.json")}
    assert sums == TOTALS
    tries = {
        name: [each.stage for each in read_attempts(Call(out / ".batch" / "call").attempts_files(f"000{at}-{name}"))]
        for at, name in enumerate(TOTALS, 1)
    }
    assert sorted(tries["north"]) == ["divide", "read", "sum", "sum.1", "sum.2", "sum.2", "sum.2"]
    assert sorted(tries["south"]) == ["divide", "read", "sum", "sum.1"]
    assert not list(out.glob("*/stages/.partial/*"))
    changed = batch(listed, out, "--until", "sum", "--set", "sum.offset=1", "--dry-run")
    counts = dict(line.split() for line in changed.stderr.splitlines() if len(line.split()) == 2 and "sum" in line)
    assert counts["sum_shard"] == "3" and counts["sum"] == "2"
    # A shard's command reads the options in its OUT: a job before it writes them, even if everything is valid.
    listed.write_text('[[capture]]\nphotos = "south"\n')
    assert batch(listed, out, "--until", "sum", "--set", "sum.offset=1").returncode == 0
    totals = sorted(json.loads(path.read_text())["total"] for path in out.glob("south/stages/sum-*/total.json"))
    assert totals == [TOTALS["south"], TOTALS["south"] + len(SOUTH)]
