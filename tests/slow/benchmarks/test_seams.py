"""benchmarks/seams finds planted seams in a finished run."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import building_site
import pytest
import torch
from repository import BENCHMARKS

from splatpipe.pipeline.splat.gaussians import Gaussians


@pytest.fixture(scope="module")
def splat() -> Gaussians:
    return building_site.model(building_site.surface())


@pytest.fixture(scope="module")
def coarse(splat: Gaussians) -> Gaussians:
    """Return the scene as from another training: positions, sizes and colours differ slightly everywhere."""
    generator = torch.Generator().manual_seed(6)
    noise = torch.randn(len(splat), 7, generator=generator)
    return replace(
        splat,
        means=splat.means + 0.03 * noise[:, :3],
        log_scales=splat.log_scales + 0.15 * noise[:, 3:4],
        sh=splat.sh + 0.1 * noise[:, None, 4:],
    )


def test_benchmark_finds_planted_seams(demo_run: Path) -> None:
    """On the demo, whose splat also serves as the model without blocks: no alarm, and some of each kind found."""
    coarse = next((demo_run / "stages").glob("train-*/model.ply"))
    script = BENCHMARKS / "seams.py"
    command = [sys.executable, str(script), str(demo_run), str(coarse), "--blocks", "2", "--plant"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "0 seams on 1 borders" in done.stdout
    rows = [[cell.strip() for cell in line.split("│")] for line in done.stdout.splitlines() if line.startswith("│")]
    assert {row[3] for row in rows if row[3] == row[5]} == {"-", "gap", "doubled", "colour"}, done.stdout
