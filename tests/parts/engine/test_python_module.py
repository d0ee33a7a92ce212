"""Children of ours do not run what lies in the current folder."""

import re
import subprocess
from pathlib import Path

from repository import ROOT

from splatpipe.pipeline.engine.python_module import SAFE_PATH, python_module
from splatpipe.pipeline.engine.runs.session import _worker_environment

PLANTED = "open('planted-was-run', 'w').close()\nraise SystemExit(7)\n"
SOURCES = sorted((ROOT / "pipeline").rglob("*.py")) + sorted((ROOT / "stages").glob("*.py"))


def test_modules_planted_in_the_current_folder_are_not_run(tmp_path: Path) -> None:
    for name in ("numpy", "splatpipe", "json", "torch"):
        (tmp_path / f"{name}.py").write_text(PLANTED)
    command = python_module("splatpipe.pipeline.splat.model.gaussians")  # imports all of them
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "planted-was-run").exists()


def test_children_of_a_worker_are_as_safe() -> None:
    assert SAFE_PATH.items() <= _worker_environment(1).items()


def test_python_is_started_in_one_way() -> None:
    starting = [path.name for path in SOURCES if re.search(r"[\"']-m[\"']", path.read_text(encoding="utf-8"))]
    assert len(SOURCES) > 300
    assert starting == ["python_module.py"], "use engine.python_module"
