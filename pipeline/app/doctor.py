"""What this machine can do, for `splatpipe doctor` and for a report of a problem."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
from pathlib import Path

from splatpipe.pipeline.engine.machine import available_cores, available_memory_bytes, free_memory_bytes
from splatpipe.pipeline.engine.runner import versions
from splatpipe.pipeline.engine.stage import JSON


def examine() -> dict[str, JSON]:
    """Versions, cores, memory, disk, the rasterizer's instruction set, and whether CUDA is used."""
    from splatpipe.pipeline.raster.rasterizer import isa_name, isa_names

    return {
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cores": _cores(),
        "memory": _memory(),
        "free disk here": f"{shutil.disk_usage(Path.cwd()).free / 1e9:.0f} GB",
        **versions(),
        "rasterizer": f"native, {isa_name()} (of {', '.join(isa_names())})",
        "CUDA": _cuda(),
        "open3d": _version("open3d-cpu") or _version("open3d") or "not installed (an extra; the line does not need it)",
    }


def _cuda() -> str:
    """Whether trainings take CUDA here; if not, why not and what to do about it."""
    from splatpipe.pipeline.raster.cuda_library import cannot_compute, load, why_not

    if missing := why_not() or cannot_compute():
        return f"not used. {missing.reason} {missing.hint}"
    _, device = load().device(0)
    return f"used: {device.described()}"


def _cores() -> str:
    """What runs may use, and what the machine has beyond that."""
    usable, all_of_them = available_cores(), os.cpu_count() or 0
    return f"{usable} of {all_of_them}, by a limit on this process" if usable < all_of_them else str(usable)


def _memory() -> str:
    usable, free = available_memory_bytes(), free_memory_bytes()
    return f"{usable / 1e9:.1f} GB for this process, {free / 1e9:.1f} GB of it free" if usable else "unknown"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""
