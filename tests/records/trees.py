"""Source trees that can run side by side: of a commit, and of the working folder, each with its kernels."""

from __future__ import annotations

import importlib.util
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sources import PACKAGE, data_digests, sha

FOLDERS = ("pipeline", "stages", "configs", "demo")  # as pyproject.toml maps them
KERNELS = {"pipeline/native": "pipeline/native", "pipeline/raster/native": "pipeline/raster"}
"""Folders of the kernels' sources, now and before, and those of the module made from them."""
PAGES = Path("pipeline/web")
DOOR = Path("pipeline/door/__init__.py")
Say = Callable[[str], None]


@dataclass(frozen=True)
class Tree:
    """Sources that can be imported.

    Attributes:
        path: Value of PYTHONPATH.
        command: The module of the command line.
    """

    path: Path
    command: str

    @property
    def root(self) -> Path:
        """Return the folder with ``pipeline`` and ``stages``."""
        return self.path / PACKAGE

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run Python so that ``splatpipe`` is this tree's; its output is kept for error messages."""
        environment = {**os.environ, "PYTHONPATH": str(self.path), "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(
            [sys.executable, *arguments], env=environment, capture_output=True, text=True, check=False
        )


def git(checkout: Path, *arguments: str) -> bytes:
    """Return git's output; raises if it fails."""
    return subprocess.run(["git", "-C", str(checkout), *arguments], capture_output=True, check=True).stdout


def take_commit(checkout: Path, commit: str, folder: Path) -> Tree:
    """Export the sources of a commit, without build products."""
    packed = git(checkout, "archive", commit, *FOLDERS)
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        archive.extractall(folder / PACKAGE, filter="data")
    _make_package(folder / PACKAGE)
    return Tree(folder, _command(git(checkout, "show", f"{commit}:pyproject.toml").decode()))


def take_working(checkout: Path, folder: Path) -> Tree:
    """Copy the sources of the working folder, including new files."""
    listed = git(checkout, "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *FOLDERS)
    for name in filter(None, listed.decode().split("\0")):
        if (checkout / name).is_file():
            target = folder / PACKAGE / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(checkout / name, target)
    _make_package(folder / PACKAGE)
    return Tree(folder, _command((checkout / "pyproject.toml").read_text(encoding="utf-8")))


def _make_package(folder: Path) -> None:
    """Write the package's own file, empty where a commit has none: without it, an installed splatpipe comes first."""
    door = folder / DOOR
    (folder / "__init__.py").write_bytes(door.read_bytes() if door.is_file() else b"")


def _command(project: str) -> str:
    script: str = tomllib.loads(project)["project"]["scripts"][PACKAGE]
    return script.partition(":")[0]


def complete(trees: Sequence[Tree], working: Tree, builds: Path, say: Say) -> None:
    """Provide trees with their kernels and the pages' scripts: the installed ones, or newly built ones.

    Args:
        trees: The trees.
        working: The working folder's tree, from which the installation was built.
        builds: Folder that keeps builds.
        say: Receives progress messages.
    """
    installed = _installed()
    for tree in trees:
        sources, module = _kernels(tree)
        present, beside = _kernels(working)
        same = data_digests(tree.root / sources) == data_digests(working.root / present)
        for library in (installed / beside if same else _build(tree.root / sources, builds, say)).glob("_native*.so"):
            shutil.copy2(library, tree.root / module)
        shutil.copytree(installed / PAGES / "dist", tree.root / PAGES / "dist")
        _run([sys.executable, str(tree.root / PAGES / "build.py")])  # does nothing if dist/ matches these sources


def _installed() -> Path:
    """Return the folder of the ``splatpipe`` that this Python imports, which contains the build."""
    found = importlib.util.find_spec(f"{PACKAGE}.pipeline")
    assert found is not None and found.origin is not None
    return Path(found.origin).resolve().parent.parent


def _kernels(tree: Tree) -> tuple[str, str]:
    """Return the folders of a tree's kernels and of their module, relative to its root."""
    return next(pair for pair in KERNELS.items() if (tree.root / pair[0]).is_dir())


def _build(kernels: Path, builds: Path, say: Say) -> Path:
    """Build kernels from their sources' folder, once; return the module's folder."""
    folder = builds / sha(data_digests(kernels))[:16]
    if any(folder.glob("_native*.so")):
        return folder
    say("building the kernels of that state (a minute or two, once)")
    programs = Path(sys.prefix) / "bin"
    nanobind = subprocess.check_output([sys.executable, "-m", "nanobind", "--cmake_dir"], text=True).strip()
    defines = [
        "CMAKE_BUILD_TYPE=Release",
        f"CMAKE_MAKE_PROGRAM={programs / 'ninja'}",
        f"Python_EXECUTABLE={sys.executable}",
        f"nanobind_DIR={nanobind}",
        *filter(None, [os.environ.get("SKBUILD_CMAKE_DEFINE")]),  # where the Makefile has downloaded Python's headers
    ]
    work = folder / "work"
    made = [str(programs / "cmake"), "-S", str(kernels), "-B", str(work), "-G", "Ninja"]
    _run([*made, *(f"-D{define}" for define in defines)])
    _run([str(programs / "cmake"), "--build", str(work), "--target", "_native"])
    for library in work.glob("_native*.so"):
        shutil.copy2(library, folder)
    shutil.rmtree(work)
    return folder


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
