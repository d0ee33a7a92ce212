"""The CUDA kernels, run on the CPU, in the place of a device."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

import torch

from splatpipe.pipeline.raster.cuda import CudaKernels
from splatpipe.pipeline.raster.cuda_library import CudaLibrary

sys.path.insert(0, str(Path(__file__).parent))
from building import build_on_cpu


@functools.cache
def library_on_cpu() -> CudaLibrary:
    """All of the backend's sources, built once."""
    return CudaLibrary(build_on_cpu())


def kernels_on_cpu() -> CudaKernels:
    """For ``cuda.use_kernels``, with a forecast of its own."""
    return CudaKernels(library_on_cpu(), torch.device("cpu"))
