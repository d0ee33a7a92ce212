"""Peak memory of processes, as the kernel records it."""

from __future__ import annotations

import contextlib
import resource
import sys
from pathlib import Path

MAXRSS_BYTES = 1 if sys.platform == "darwin" else 1024  # the unit of ru_maxrss


def reset_peak_memory() -> None:
    """Start the record of this process's peak memory anew; does nothing where unsupported."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_bytes() -> int:
    """Peak resident memory of this process, bytes, since it was reset (where unsupported: since process start)."""
    peak_bytes = peak_memory_of("self")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * MAXRSS_BYTES if peak_bytes is None else peak_bytes


def peak_memory_of(process: int | str) -> int | None:
    """Peak resident memory of a process on this machine, bytes; None if it ended or the kernel does not report it."""
    return _reported(process, "VmHWM")


def resident_memory_bytes() -> int:
    """Resident memory of this process now, bytes; where the kernel does not report it, its peak."""
    now_bytes = _reported("self", "VmRSS")
    return peak_memory_bytes() if now_bytes is None else now_bytes


def _reported(process: int | str, name: str) -> int | None:
    with contextlib.suppress(OSError, StopIteration, ValueError, UnicodeDecodeError):
        lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
        return int(next(line for line in lines if line.startswith(name)).split()[1]) * 1024
    return None
