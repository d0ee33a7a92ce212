"""The wheels on bare Debian systems made by debootstrap: installed by pip alone, without compiler, node or network."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

SUITES = {"3.11": "bookworm", "3.13": "trixie"}
"""Debian's release by its Python: 12 and 13."""
PACKAGES = ("python3", "python3-venv")
# What a program expects to find, mounted in a namespace of its own that ends with it.
INSIDE = 'mount -t proc proc "$0/proc" && mount --rbind /dev "$0/dev" && exec chroot "$0" "$@"'


@dataclass(frozen=True)
class Root:
    """A bare Debian system.

    Attributes:
        folder: Its root on this machine.
    """

    folder: Path

    def run(self, *words: object, log: Path | None = None) -> int:
        """Run a command in it; return its exit code.

        Args:
            words: Program and arguments, paths as seen inside.
            log: Receives its output; None for the terminal.
        """
        command = ["unshare", "--mount", "sh", "-c", INSIDE, str(self.folder), *map(str, words)]
        environment = {"PATH": "/usr/bin:/bin:/usr/sbin:/sbin", "HOME": "/root", "LC_ALL": "C.UTF-8"}
        if log is None:
            return subprocess.run(command, env=environment, check=False).returncode
        with log.open("w", encoding="utf-8") as file:
            return subprocess.run(command, env=environment, stdout=file, stderr=file, check=False).returncode


def missing() -> str:
    """What is lacking to make bare systems here; empty if nothing is."""
    if os.geteuid() != 0:
        return "root"
    return ", ".join(name for name in ("debootstrap", "unshare") if shutil.which(name) is None)


def make_root(folder: Path, suite: str) -> Root:
    """Make a bare system, or take the one that an earlier call has made.

    Args:
        folder: Its root.
        suite: Debian's name of the release.
    """
    if not (folder / "usr" / "bin" / "python3").exists():
        shutil.rmtree(folder, ignore_errors=True)
        command = ["debootstrap", "--variant=minbase", f"--include={','.join(PACKAGES)}", suite, str(folder)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return Root(folder)


def install(root: Root, python: Path, wheel: Path, constraints: Path, torch: Sequence[str]) -> None:
    """Install a wheel and what it depends on into ``/env`` of a bare system, from files that this machine fetches.

    Args:
        root: The system.
        python: A Python of this machine, of the same version as the system's.
        wheel: The wheel.
        constraints: Versions of the dependencies.
        torch: Further arguments for fetching torch.
    """
    packages = root.folder / "packages"
    shutil.rmtree(packages, ignore_errors=True)
    # `wheel`, not `download`: one of Snakemake's dependencies is published as source only.
    fetch = [str(python), "-m", "pip", "wheel", "-q", "-c", str(constraints), "-w", str(packages)]
    if torch:
        subprocess.run([*fetch, *torch], check=True)
    subprocess.run([*fetch, "--find-links", str(packages), str(wheel)], check=True)
    pip = ("/env/bin/python", "-m", "pip", "install", "-q", "--no-index", "--find-links", "/packages")
    shutil.rmtree(root.folder / "env", ignore_errors=True)
    for words in (("python3", "-m", "venv", "/env"), (*pip, f"/packages/{wheel.name}")):
        if root.run(*words):
            raise subprocess.CalledProcessError(1, words)
    shutil.rmtree(packages)


def first_difference(expected: Path, found: Path) -> str:
    """Name the first part of an artifact, in the order of the stages, that differs between two runs; empty if none.

    Args:
        expected: OUT of one run.
        found: OUT of the other.
    """
    theirs = dict(_parts(found))
    for name, digest in _parts(expected):
        if theirs.get(name) != digest:
            return name
    return ""


def _parts(out: Path) -> list[tuple[str, str]]:
    """Full names and digests of all artifacts' parts, in the order in which their stages ended."""
    manifests: list[Mapping[str, object]] = [
        json.loads(path.read_text(encoding="utf-8")) for path in out.glob("**/manifest.json")
    ]
    stages = [each for each in manifests if "finished_s" in each]
    parts = []
    for manifest in sorted(stages, key=lambda each: float(str(each["finished_s"]))):
        of_stage = manifest["parts"]
        assert isinstance(of_stage, dict)
        parts += [(f"{manifest['stage']}.{name}", str(part["digest"])) for name, part in of_stage.items()]
    return parts
