"""The kernels in C++ and CUDA, as one extension module: rasterizer, loss, optimiser, sky, surfaces, depths."""
