"""Copies of the sources, to be changed."""

import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from os import environ
from pathlib import Path

import record
from repository import ROOT

DOOR = "pipeline/door/__init__.py"  # the package's own file: without it, an installed splatpipe comes first
MADE = ("*.so", "__pycache__", "dist", "node_modules", record.RECORD)


def copy_sources(target: Path, *besides: str) -> Path:
    """Copy the sources except build products and ``besides``; record them."""
    for folder in ("pipeline", "stages", "configs", "demo"):
        shutil.copytree(ROOT / folder, target / folder, ignore=shutil.ignore_patterns(*MADE, *besides))
    shutil.copy2(ROOT / DOOR, target)
    record.write(target, record.present(target))
    return target


def replace(file: Path, pattern: str, text: str) -> None:
    """Replace the single match of a pattern."""
    changed, count = re.subn(pattern, text, file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert count == 1, f"{pattern} is in {file.name} {count} times"
    file.write_text(changed, encoding="utf-8")


def append(file: Path, text: str) -> None:
    file.write_text(file.read_text(encoding="utf-8") + text, encoding="utf-8")


def run(arguments: list[str], folder: Path, extra: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env={**environ, **extra}, capture_output=True, text=True, check=False)
