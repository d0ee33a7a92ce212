// A whole picture's colours through a bilateral grid of affine maps: threads around the kernels. Not for kernel files.
#pragma once

#include <cstdint>

namespace splat {

struct ColourGrid {
    const float* maps;          // (levels, rows, columns, 12)
    int levels, rows, columns;  // 2 to kGridLevels, and to kGridSide
    std::int64_t size() const { return std::int64_t{12} * levels * rows * columns; }
};

// A (height, width, 3) picture through the maps between whose nodes its pixels and their luminances lie.
void bilateral_colour(const ColourGrid& grid, const float* in, std::int64_t height, std::int64_t width, float* out);

// dL/d(in) and, shaped as the maps, dL/d(maps) from dL/d(out); the same bits for any number of threads.
void bilateral_colour_backward(const ColourGrid& grid, const float* in, const float* upstream, std::int64_t height,
                               std::int64_t width, float* gradient, double* grid_gradient);

}  // namespace splat
