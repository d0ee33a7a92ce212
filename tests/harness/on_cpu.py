"""The CUDA kernels, run on the CPU in place of a device."""

from __future__ import annotations

import functools

import torch
from building import build_on_cpu

from splatpipe.pipeline.raster.cuda.cuda import CudaKernels
from splatpipe.pipeline.raster.cuda.cuda_api import SplatShot
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary


@functools.cache
def library_on_cpu() -> CudaLibrary:
    """Return the library of all of the backend's sources, built once."""
    return CudaLibrary(build_on_cpu())


def kernels_on_cpu() -> CudaKernels:
    """Return kernels for ``cuda.use_kernels``, with their own forecast."""
    return CudaKernels(library_on_cpu(), torch.device("cpu"))


class ShortOfMemory(CudaKernels):
    """Kernels on a device with little memory for a frame, or for its backward pass."""

    most_bytes, most_frame_bytes = 1 << 40, 1 << 40

    def frame_bytes(self, shot: SplatShot, count: int, capacity: int) -> int:
        size = super().frame_bytes(shot, count, capacity)
        if size > self.most_frame_bytes:
            raise torch.OutOfMemoryError("out of memory")
        return size

    def back_bytes(self, shot: SplatShot, count: int, capacity: int) -> int:
        size = super().back_bytes(shot, count, capacity)
        if size > self.most_bytes:
            raise torch.OutOfMemoryError("out of memory")
        return size
