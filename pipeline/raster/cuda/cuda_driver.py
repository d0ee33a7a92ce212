"""NVIDIA's driver and cards as reported by the system, whether or not CUDA works."""

from __future__ import annotations

import contextlib
import ctypes
import re
from ctypes import c_int32
from pathlib import Path

ROOT = Path("/")
MAX_BYTES = 4096  # read of the driver's file: about 200 are usual
NVML_VERSION_BYTES = 80  # NVML_SYSTEM_DRIVER_VERSION_BUFFER_SIZE
RELEASE = re.compile(r"\b\d{3,4}\.\d{1,3}(\.\d{1,3})?\b")  # 580.65.06; years and times in the same line do not match
CARDS = ("dev/nvidia[0-9]*", "proc/driver/nvidia/gpus/*", "usr/lib/wsl/lib/libcuda.so.1")  # the last: Windows' driver
NVIDIA, DISPLAY = "0x10de", "0x03"  # PCI vendor, and prefix of the classes of graphics cards


def driver() -> tuple[int, int]:
    """The return code of the driver's initialization, and the CUDA version that it supports (0 without a driver)."""
    try:
        library = ctypes.CDLL("libcuda.so.1")
        version = c_int32()
        library.cuDriverGetVersion(ctypes.byref(version))
        return int(library.cuInit(0)), version.value
    except (OSError, AttributeError):
        return 0, 0


def driver_release(root: Path = ROOT) -> str:
    """The driver's own version, e.g. "580.65.06"; "" if neither the kernel nor NVML reports it.

    Args:
        root: Root of the file system.
    """
    first = _begin(root / "proc" / "driver" / "nvidia" / "version").split("\n")[0]
    found = RELEASE.search(first) or RELEASE.search(_nvml_version())
    return found[0] if found else ""


def has_card(root: Path = ROOT) -> bool:
    """Whether the system reports an NVIDIA graphics card, with or without a driver.

    Args:
        root: Root of the file system.
    """
    if any(next(root.glob(pattern), None) for pattern in CARDS):
        return True
    devices = root.glob("sys/bus/pci/devices/*")
    return any(_begin(d / "vendor").strip() == NVIDIA and _begin(d / "class").startswith(DISPLAY) for d in devices)


def _begin(path: Path) -> str:
    """The first bytes of a system file; "" if it does not exist."""
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES).decode(errors="replace")
    except OSError:
        return ""


def _nvml_version() -> str:
    """The driver version from NVML, which also exists with Windows' driver; "" without NVML."""
    text = ctypes.create_string_buffer(NVML_VERSION_BYTES)
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL("libnvidia-ml.so.1")
        if library.nvmlInit_v2() == 0:
            code = library.nvmlSystemGetDriverVersion(text, NVML_VERSION_BYTES)
            library.nvmlShutdown()
            return text.value.decode(errors="replace") if code == 0 else ""
    return ""
