"""The CUDA kernels' shared library, its C interface, and what torch needs to call it."""
