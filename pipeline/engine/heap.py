"""The process's heap: what the allocator and Python's garbage collector do with it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from collections.abc import Iterator


def return_free_heap() -> None:
    """Return freed heap memory to the system; does nothing with C libraries other than glibc."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@contextlib.contextmanager
def imports_outside_gc() -> Iterator[None]:
    """Pause garbage collection while large libraries are imported: what they create stays, uncollected."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
