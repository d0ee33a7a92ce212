"""What the allocator keeps."""

import resource
import sys

import numpy as np
import pytest

from splatpipe.pipeline.engine.heap import keep_freed_heap


@pytest.mark.skipif(sys.platform != "linux", reason="needs glibc")
def test_freed_memory_is_used_again_without_new_pages() -> None:
    keep_freed_heap()
    for _ in range(3):
        np.ones(1 << 20)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        np.ones(1 << 20)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < 2048  # of 20,480 pages
