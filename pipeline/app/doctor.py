"""What this machine can do, for `splatpipe doctor` and for a report of a problem."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
from pathlib import Path

from splatpipe.pipeline.engine.runner import versions
from splatpipe.pipeline.engine.stage import JSON


def examine() -> dict[str, JSON]:
    """Versions, cores, memory, disk, the rasterizer's instruction set, and whether CUDA is used."""
    from splatpipe.pipeline.raster.rasterizer import isa_name, isa_names

    return {
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cores": os.cpu_count(),
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


def _memory() -> str:
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        return "unknown"
    return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 1e9:.1f} GB"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""
