"""Threads that change only how fast a stage is, never its answer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import torch

from splatpipe.pipeline.raster import rasterizer


@contextmanager
def same_bits(threads: int) -> Iterator[None]:
    """Give the native kernels their threads, and torch and OpenCV one: torch's sums depend on how many there are.

    Args:
        threads: Of the native kernels, at least 1; they keep them.
    """
    before, before_cv2 = torch.get_num_threads(), cv2.getNumThreads()
    rasterizer.set_threads(threads)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)  # the reader's photos are resized on its one thread
    try:
        yield
    finally:
        torch.set_num_threads(before)
        cv2.setNumThreads(before_cv2)
