"""A user's type checker finds splatpipe's types in what a wheel installs."""

import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import pytest
from mypy.fscache import FileSystemCache
from mypy.modulefinder import FindModuleCache, SearchPaths, get_search_dirs
from mypy.options import Options
from repository import ROOT

PACKAGES = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["scikit-build"]["wheel"][
    "packages"
]
GOOD = """
import splatpipe
from splatpipe.pipeline.engine import quantities
from splatpipe.pipeline.engine.errors import UsageError

run: splatpipe.Run = splatpipe.open_run("out")
size: int = len(splatpipe.read_splat("splat.ply"))
version: str = splatpipe.__version__
error: Exception = UsageError("What is wrong.", hint="What helps.")
length: float = quantities.parse_length("2cm", "--gsd")
"""
BAD = """
import splatpipe
from splatpipe.pipeline.engine.quantities import parse_length

length: str = parse_length("2cm", "--gsd")
run: str = splatpipe.open_run("out")
"""


@pytest.fixture(scope="module")
def user_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment in which the wheel's folders lie where its table has them."""
    environment = tmp_path_factory.mktemp("user") / "venv"
    venv.create(environment, with_pip=False)
    (site,) = environment.glob("lib/python3*/site-packages")
    for installed, source in PACKAGES.items():
        place = site / installed
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(ROOT / source)
    return environment / "bin" / "python"


def test_a_users_mypy_finds_splatpipe_and_its_modules_and_notices_a_wrong_use(
    user_python: Path, tmp_path: Path
) -> None:
    for name, text in (("good.py", GOOD), ("bad.py", BAD)):
        (tmp_path / name).write_text(text)
    how = ["--strict", "--config-file=", "--python-executable", str(user_python)]
    command = [sys.executable, "-m", "mypy", *how, "good.py", "bad.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert {line.partition(":")[0] for line in done.stdout.splitlines() if ": error: " in line} == {"bad.py"}
    assert 'expression has type "float", variable has type "str"' in done.stdout
    assert 'expression has type "Run", variable has type "str"' in done.stdout


def test_the_namespace_itself_can_be_checked(user_python: Path) -> None:
    search, _ = get_search_dirs(str(user_python))
    finder = FindModuleCache(SearchPaths((), (), tuple(search), ()), FileSystemCache(), Options())
    found = {source.module for source in finder.find_modules_recursive("splatpipe")}  # as mypy -p does
    assert {
        "splatpipe",
        "splatpipe.pipeline.app.cli.main",
        "splatpipe.stages.line",
        "splatpipe.demo.site.scene",
    } <= found
