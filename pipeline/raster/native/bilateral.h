// A picture's colours through a bilateral grid of affine maps, and back: a chunk's kernels, compiled once per ISA.
#pragma once

#include <cstdint>

#include "colour.h"
#include "isa.h"

namespace splat {

constexpr int kGridLevels = 16;           // at most: a block's maps of all levels stay in the L1 cache
constexpr int kGridSide = 64;             // nodes along a side at most
constexpr std::int64_t kGridWidth = 128;  // pixels of a chunk along a row, a multiple of every vector's

// Part of a picture between two rows of nodes. The nodes lie evenly from edge to edge of the picture, and of luminance
// from 0 to 1.
struct GridChunk {
    const float* maps;  // (levels, rows, columns, 12)
    int levels, rows, columns;
    std::int64_t width, height;                     // of the picture
    int cell;                                       // the row of nodes above
    std::int64_t first_x, last_x, first_y, last_y;  // pixels, the last ones not of it
    int first_node, nodes;                          // columns of nodes that they lie between
};

struct BilateralKernels {
    // out = in through the maps; (height, width, 3) floats each, of which only the chunk's are touched.
    void (*forward)(const GridChunk& chunk, const float* in, float* out);
    // dL/d(in) from dL/d(out), and the chunk's dL/d(maps), (2, levels, nodes, 12), added to `sums`.
    void (*backward)(const GridChunk& chunk, const float* in, const float* upstream, float* gradient, float* sums);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(BilateralKernels, bilateral_kernels)
