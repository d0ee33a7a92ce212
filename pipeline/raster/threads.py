"""Thread settings that change only a stage's speed, never its result."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import torch

from splatpipe.pipeline.raster.isa import _native


@contextmanager
def same_bits(threads: int) -> Iterator[None]:
    """Set the native kernels' threads, and one each for torch and OpenCV: torch's sums depend on the thread count.

    Args:
        threads: Number of threads of the native kernels, at least 1; not restored afterwards.
    """
    before, before_cv2 = torch.get_num_threads(), cv2.getNumThreads()
    _native.set_threads(threads)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)  # the reader's photos are resized on its one thread
    try:
        yield
    finally:
        torch.set_num_threads(before)
        cv2.setNumThreads(before_cv2)
