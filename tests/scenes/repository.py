"""Folders of the repository, for tests that start programs or read sources."""

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HARNESS = ROOT / "tests" / "harness"
LINES = ROOT / "tests" / "lines"
SCENES = ROOT / "tests" / "scenes"


def benchmark(name: str, *arguments: object) -> list[str]:
    """Return the command that runs a benchmark."""
    return [sys.executable, str(ROOT / "benchmarks"), name, *map(str, arguments)]


def environment(*folders: Path, **variables: str) -> dict[str, str]:
    """Return the environment of a program that also imports modules of the given folders."""
    known = os.environ.get("PYTHONPATH", "")
    return {**os.environ, **variables, "PYTHONPATH": os.pathsep.join([*map(str, folders), *filter(None, [known])])}
