"""The stress test of benchmarks, small: cut uploads, a kill -9, hostile requests."""

import subprocess
from pathlib import Path

from repository import benchmark

SMALL = ("--uploads", 8, "--clients", 4, "--finish", 1, "--kills", 1, "--hostile", 170, "--linger", 4, "--no-full-disk")


def test_nothing_is_lost_half_or_left_running(tmp_path: Path) -> None:
    command = benchmark("node_stress", tmp_path / "work", *SMALL)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "hostile requests" in done.stdout
