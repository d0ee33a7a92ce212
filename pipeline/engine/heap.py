"""Memory that a process has freed and the allocator keeps: glibc returns it on request only."""

from __future__ import annotations

import contextlib
import ctypes


def return_free_heap() -> None:
    """Give it back to the system; nothing where the C library is another."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
