"""The process's heap: what the allocator and Python's garbage collector do with it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from collections.abc import Iterator

# Parameters of mallopt, from malloc.h. The limit is glibc's largest, to which it goes itself as such blocks are freed.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST_IN_HEAP = 32 << 20


def return_free_heap() -> None:
    """Return freed heap memory to the system; does nothing with C libraries other than glibc."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def keep_freed_heap() -> None:
    """Keep up to 64 MB of freed heap memory: getting its pages from the system again takes time in every iteration.

    ``return_free_heap`` returns it all the same. Does nothing with C libraries other than glibc.
    """
    with contextlib.suppress(OSError, AttributeError):
        allocator = ctypes.CDLL(None)
        allocator.mallopt(_MMAP_THRESHOLD, _LARGEST_IN_HEAP)
        allocator.mallopt(_TRIM_THRESHOLD, 2 * _LARGEST_IN_HEAP)


@contextlib.contextmanager
def imports_outside_gc() -> Iterator[None]:
    """Pause garbage collection while large libraries are imported: what they create stays, uncollected."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
