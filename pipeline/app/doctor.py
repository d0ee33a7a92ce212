"""The capabilities of this machine, for `splatpipe doctor` and for bug reports."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
from pathlib import Path

from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes, free_memory_bytes, mount_of
from splatpipe.pipeline.engine.runs.job_runner import versions
from splatpipe.pipeline.engine.runs.lock import is_locked, running_shards
from splatpipe.pipeline.engine.stage import JSON

SHARED_MEMORY = Path("/dev/shm")


def examine(place: Path) -> dict[str, JSON]:
    """Versions, cores, memory, disk, the rasterizer's instruction set, and whether CUDA is used.

    Args:
        place: An OUT, which need not exist yet.
    """
    from splatpipe.pipeline.raster.isa import isa_name, isa_names

    return {
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cores": _cores(),
        "memory": _memory(),
        "shared memory": f"{_free(SHARED_MEMORY) if SHARED_MEMORY.is_dir() else 'none'} (splatpipe needs none)",
        "results folder": str(place),
        "its file system": _file_system(place),
        "its free disk space": _free(place),
        "at work there": _running(place),
        **versions(),
        "rasterizer": f"native, {isa_name()} (of {', '.join(isa_names())})",
        "CUDA": _cuda(),
        "open3d": _version("open3d-cpu")
        or _version("open3d")
        or "not installed (optional; the pipeline does not need it)",
    }


def _cuda() -> str:
    """Whether training uses CUDA here; if not, why not and what to do about it."""
    from splatpipe.pipeline.raster.cuda.cuda_library import cannot_compute, load, unavailable_reason

    if missing := unavailable_reason() or cannot_compute():
        return f"not used. {missing.reason} {missing.hint}"
    _, device = load().device(0)
    return f"used: {device.described()}"


def _cores() -> str:
    """The cores that runs may use, and those of the machine if it has more."""
    usable, all_of_them = available_cores(), os.cpu_count() or 0
    return f"{usable} of {all_of_them}, limited for this process" if usable < all_of_them else str(usable)


def _free(place: Path) -> str:
    """The free space on the disk of a path, which need not exist."""
    there = next(folder for folder in (place.absolute(), *place.absolute().parents) if folder.exists())
    try:
        return f"{shutil.disk_usage(there).free / 1e9:.1f} GB"
    except OSError as error:
        return f"unknown: {error.strerror}"


def _file_system(place: Path) -> str:
    mount = mount_of(place)
    return "unknown" if mount is None else f"{mount.kind} at {mount.point}"


def _running(place: Path) -> str:
    if is_locked(place):
        return "a run"
    return ", ".join(running_shards(place)) or "nobody"


def _memory() -> str:
    usable, free = available_memory_bytes(), free_memory_bytes()
    return f"{usable / 1e9:.1f} GB for this process, {free / 1e9:.1f} GB of it free" if usable else "unknown"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""
