"""The kernels' folders: each includes only files of its own and of those below it, by their whole path."""

import re
from pathlib import Path

import pytest
from repository import ROOT

NATIVE = ROOT / "pipeline" / "native"
# Lowest first; the last is bind.cpp's.
FOLDERS = ("base", "adam descriptors loss patch_match sky surface", "raster", "cuda", ".")
LEVELS = {folder: level for level, folders in enumerate(FOLDERS) for folder in folders.split()}
INCLUDE = re.compile(r'^\s*#\s*include "(.+)"', re.MULTILINE)
SOURCES = (".h", ".cpp", ".cuh", ".cu")
HARNESS = ("base/device.h", "cuda_on_cpu.h")  # the stand-in for CUDA, in tests/harness


def upward(native: Path) -> list[str]:
    """Return the includes that do not exist below the including folder or in it."""
    found = []
    for path in sorted(path for path in native.rglob("*") if path.suffix in SOURCES):
        name = path.relative_to(native).as_posix()
        own = path.parent.relative_to(native).as_posix()
        for included in INCLUDE.findall(path.read_text(encoding="utf-8")):
            other = Path(included).parent.as_posix()
            is_lower = other == own or LEVELS.get(other, len(FOLDERS)) < LEVELS[own]
            if (name, included) != HARNESS and not (is_lower and (native / included).is_file()):
                found.append(f"{name} includes {included}")
    return found


def test_folders_include_only_those_below_them() -> None:
    assert upward(NATIVE) == []
    assert {path.name for path in NATIVE.iterdir() if any(path.glob("*.h"))} == LEVELS.keys() - {"."}


@pytest.mark.parametrize(("file", "included"), [("base/simd.h", "sky/sky.h"), ("sky/sky.h", "loss/loss.h")])
def test_an_include_of_a_folder_not_below_is_noticed(tmp_path: Path, file: str, included: str) -> None:
    for name, text in ((file, f'#include "{included}"\n'), (included, "")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert upward(tmp_path) == [f"{file} includes {included}"]
