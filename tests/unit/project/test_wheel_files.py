"""What a wheel leaves out, by its list in pyproject.toml, is nothing that splatpipe itself imports."""

from __future__ import annotations

import ast
import tomllib

from pathspec import GitIgnoreSpec
from repository import ROOT

BUILD = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["scikit-build"]["wheel"]
EXCLUDED = GitIgnoreSpec.from_lines(BUILD["exclude"])


def installed(folder: str) -> set[str]:
    """The files of a folder that a wheel contains, as paths below it."""
    files = (path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*") if path.is_file())
    kept = {name for name in files if not EXCLUDED.match_file(f"splatpipe/{name}")}
    return {name.removeprefix(f"{folder}/") for name in kept if "__pycache__" not in name}


def test_of_the_demo_only_the_capture_is_installed() -> None:
    kept = installed("demo")
    assert {name for name in kept if not name.startswith("capture/")} == {"__init__.py", "py.typed"}
    assert len([name for name in kept if name.startswith("capture/photos/")]) == 40


def test_the_door_is_installed_at_the_top_and_nowhere_else() -> None:
    assert BUILD["packages"]["splatpipe/__init__.py"] == "pipeline/door/__init__.py"
    assert installed("pipeline/door") == set()
    assert "app/library/run.py" in installed("pipeline")


def test_nothing_that_is_installed_imports_what_is_not() -> None:
    for path in (ROOT / folder / name for folder in ("pipeline", "stages") for name in installed(folder)):
        if path.suffix == ".py" and b"demo" in path.read_bytes():
            imports = [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.ImportFrom)]
            names = {f"{node.module}.{alias.name}" for node in imports for alias in node.names}
            assert {name for name in names if name.startswith("splatpipe.demo")} <= {"splatpipe.demo.capture_path"}, (
                path
            )
