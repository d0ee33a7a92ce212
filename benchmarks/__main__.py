"""Run the benchmark of a name, or list all of them.

    python benchmarks                       # lists what can be run, by folder
    python benchmarks NAME ARGUMENT …       # runs it

The benchmarks import each other by plain names, so every folder is put on the path, also for the processes that they
start. Only the standard library is used here: a visit to a GPU begins on a bare machine.
"""

from __future__ import annotations

import ast
import os
import runpy
import sys
from contextlib import suppress
from itertools import groupby
from pathlib import Path

HOME = Path(__file__).resolve().parent
RUNNABLE = 'if __name__ == "__main__":'


def main(words: list[str]) -> str | None:
    """Run or list; return what is wrong with the name, if anything is."""
    folders = sorted({path.parent for path in HOME.glob("*/*.py")})
    scripts = {path.stem: path for folder in folders for path in sorted(folder.glob("*.py")) if runnable(path)}
    if not words:
        print("python benchmarks NAME ARGUMENT …   (NAME --help: its arguments)")
        for folder, paths in groupby(scripts.values(), lambda path: path.parent):
            print(f"\n{folder.name}/")
            for path in paths:
                print(f"  {path.stem:22} {first_sentence(path)}")
        return None
    name, *arguments = words
    if name not in scripts:
        return f"There is no benchmark {name}; `python benchmarks` lists them."
    paths = [str(folder) for folder in folders]
    sys.path[:1] = paths  # in place of this folder
    os.environ["PYTHONPATH"] = os.pathsep.join([*paths, *filter(None, [os.environ.get("PYTHONPATH")])])
    sys.argv = [name, *arguments]
    find_generator()
    runpy.run_path(str(scripts[name]), run_name="__main__")
    return None


def find_generator() -> None:
    """Let the generator of the demo capture be found, which no wheel contains."""
    with suppress(ImportError):  # on a bare machine
        import splatpipe.demo

        splatpipe.demo.__path__.append(str(HOME.parent / "demo"))


def runnable(path: Path) -> bool:
    """Whether a module is a command, not only imported by others."""
    return RUNNABLE in path.read_text(encoding="utf-8")


def first_sentence(path: Path) -> str:
    """Return the first sentence of a module's docstring."""
    text = ast.get_docstring(ast.parse(path.read_bytes())) or ""
    return " ".join(text.split("\n\n")[0].split()).split(". ")[0]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
