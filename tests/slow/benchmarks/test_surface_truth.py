"""benchmarks/surface_truth, as a command."""

import subprocess
import sys
from pathlib import Path

from repository import BENCHMARKS


def test_nothing_to_measure_is_reported(tmp_path: Path) -> None:
    command = [sys.executable, BENCHMARKS / "surface_truth.py", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "has none of" in done.stderr
