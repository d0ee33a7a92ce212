"""Contents of an image: sizes by package, compressed and unpacked, and tools that do not belong in it."""

from __future__ import annotations

import re
import shutil
import stat
import zlib
from dataclasses import dataclass
from pathlib import Path

from building import TAG, ImageTools

PACKAGES = Path("opt/splatpipe/lib")
FOREIGN = ("gcc", "g++", "c++", "cc", "make", "cmake", "ninja", "node", "npm", "pip", "pip3", "pytest", "ruff", "mypy")
SMALL = 3_000_000  # bytes; smaller packages are reported together
CHUNK = 1 << 20
GZIP_LEVEL = 6  # as in registries


@dataclass(frozen=True)
class Group:
    """A package, or the files that belong to none.

    Attributes:
        name: Its name.
        unpacked: Bytes of its files.
        compressed: Their size compressed with gzip.
    """

    name: str
    unpacked: int
    compressed: int


def pulled_bytes(tools: ImageTools, folder: Path) -> int:
    """Return the bytes of the image's compressed layers, as in a registry."""
    shutil.rmtree(folder, ignore_errors=True)
    tools.buildah("push", "-q", TAG, f"oci:{folder}:latest")
    size = sum(path.stat().st_size for path in (folder / "blobs").rglob("*") if path.is_file())
    shutil.rmtree(folder)
    return size


def sizes(root: Path) -> list[Group]:
    """Group an image's files by package, the largest first."""
    packers: dict[str, list] = {}
    for path in sorted(root.rglob("*")):
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode):
            continue
        packer = packers.setdefault(_package(path.relative_to(root)), [0, 0, zlib.compressobj(GZIP_LEVEL)])
        packer[0] += status.st_size
        with path.open("rb") as file:
            while chunk := file.read(CHUNK):
                packer[1] += len(packer[2].compress(chunk))
    groups = [Group(name, held, packed + len(rest.flush())) for name, (held, packed, rest) in packers.items()]
    small = [group for group in groups if group.unpacked < SMALL]
    others = Group(f"{len(small)} smaller packages", sum(g.unpacked for g in small), sum(g.compressed for g in small))
    large = sorted((group for group in groups if group.unpacked >= SMALL), key=lambda group: -group.unpacked)
    return [*large, *([others] if small else [])]


def foreign_tools(root: Path) -> list[str]:
    """List tools for building and testing that are on the image's PATH."""
    places = [root / place for place in ("usr/bin", "bin", "usr/local/bin", "opt/splatpipe/bin")]
    return sorted({name for place in places for name in FOREIGN if (place / name).exists()})


def _package(path: Path) -> str:
    if not path.is_relative_to(PACKAGES):
        return "Debian with Python"
    parts = path.relative_to(PACKAGES).parts[2:]  # below python3.11/site-packages
    if len(parts) < 2:
        return "single files"
    return re.split(r"\.libs$|-[\d.]+.*\.dist-info$|-[\d.]+.*\.data$", parts[0])[0].lower()
